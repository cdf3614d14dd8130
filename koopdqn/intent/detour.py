"""The detour: the bend of an intent that keeps the whole arm clear of obstacles.

The intent's own path is followed up to an obstacle, around it and back. The way around is the cheapest of all on a grid
beside the path, found from the costs to come (Bellman 1957): it looks ahead of the tool, and of the arm's body too,
since a place counts as free where the whole arm is.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.intent.bend import Bend, BentIntent, BentTrust
from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import IntentReward
from koopdqn.paths import arc_lengths, at_arc_lengths, to_count
from koopdqn.pose import Array
from koopdqn.tasks.workcell import Workcell

# Distance of the grid's layers along the path, and of its places in a layer [m].
_LAYER_M, _CELL_M = 0.010, 0.0125
# Largest sideways motion from layer to layer [cells].
_SIDEWAYS = 2
# Room beyond the clearance [m] that a detour keeps where it can: ten actions stray from a path by as much.
_SLACK_M = 0.03
# Half width of the grid [cells], and how much of the path before the obstacle and behind it [m] the detour may take,
# tried in turn.
_REACHES = ((6, 0.10, 0.05), (12, 0.10, 0.05), (12, 0.20, 0.10), (18, 0.40, 0.40))
# How many ways that the arm cannot follow between the layers are given up before the next reach is tried, and how far
# around the place where it was refused [cells] the next way keeps away.
_GIVEN_UP, _AWAY = 10, 1.5
# Costs of a layer: each 20 mm aside, all of the slack missing, and a slope of 1.
_ASIDE_M, _NO_SLACK, _SLOPE = 0.02, 60.0, 1.0
# Missing share of the slack up to which no farther way is looked for.
_TIGHT = 0.5
# A layer's places may come no nearer together than this share of the path's own distance, where it bends.
_LEAST_PROGRESS = 0.2
# Distance of a bend's points [m]; the widths over which its corners are rounded off [m], the widest first; and the
# share of the room that must be left then.
_SPACING_M, _ROUNDED_M, _KEPT = 5e-4, (0.012, 0.008, 0.005, 0.003), 0.8
_LONGEST = 3000
# Of a bend every fourth point is followed, to see whether the arm can.
_FOLLOWED = 4


def around_obstacles(workcell: Workcell, reward: IntentReward, trajectories: list[Array]) -> IntentReward:
    """Return the reward function with its intent, shown by trajectories (N, 7), bent around obstacles of the task.

    Raises:
        BadInputError: there is no way around within reach.
    """
    bend = detour(workcell, reward.model, np.array([rows[0] for rows in trajectories]))
    if bend is None:
        return reward
    return replace(reward, model=BentIntent(reward.model, bend), trust=BentTrust.of(reward.trust, bend))


def detour(workcell: Workcell, model: IntentModel, starts: Array) -> Bend | None:
    """Return the bend that takes the intent's path around a task's obstacles; None where none is in the way.

    If paths follow their start, those from all of the demonstrations' ``starts`` (D, 7) are kept clear.

    Raises:
        BadInputError: there is no way around within reach, or the path passes itself.
    """
    task = workcell.task
    if not task.obstacles:
        return None
    if model.start_frame.unfolding is not None:
        raise BadInputError(f"task {task.name}: a path among obstacles must not pass itself, found one that does")
    begun = starts if model.start_frame.follows else task.nominal_start[None]
    grid = _Grid.along(workcell, model, begun)
    blocked = np.flatnonzero(grid.own_rooms[:, 0] < 0.0)
    if not len(blocked):
        return None
    best: tuple[Bend, float] | None = None
    for half, before, behind in _REACHES:
        first = max(0, int(blocked[0]) - round(before / _LAYER_M))
        last = min(grid.count - 1, int(blocked[-1]) + round(behind / _LAYER_M))
        way = grid.way(first, last, half)
        if way is not None and (best is None or way[1] < best[1]):
            best = way
        if best is not None and best[1] <= _TIGHT:
            break
    if best is None:
        reach = _REACHES[-1][0] * _CELL_M
        raise BadInputError(
            f"task {task.name}: obstacles must leave a way around within {reach:g} m of the intended path, found none"
        )
    return best[0]


@dataclass(frozen=True)
class _Grid:
    """Places beside the intent's path, in layers at right angles to it.

    Attributes:
        workcell: task, arm and scene.
        model: the intent.
        starts: (D, 7) of the paths that must be free.
        poses: (L, 7) the path, one pose a layer, in the start frame.
        normals: (L, 2, 3) unit vectors across the path.
        curvature: (L, 3) [1/m] of the path.
        joints: (D, L, 6) [rad] along each of the paths.
    """

    workcell: Workcell
    model: IntentModel
    starts: Array
    poses: Array
    normals: Array
    curvature: Array
    joints: Array

    @classmethod
    def along(cls, workcell: Workcell, model: IntentModel, starts: Array) -> "_Grid":
        task, arm = workcell.task, workcell.arm
        begun = task.nominal_start[None]
        step = max(task.step_m, _SPACING_M)
        path = model.start_frame.to_frame(model.intended_paths(begun, _LONGEST, step)[:, 0], begun)
        length = float(arc_lengths(path[:, pose.POSITION])[-1])
        poses = to_count(path, max(3, round(length / _LAYER_M) + 1))
        tangents = np.gradient(poses[:, pose.POSITION], axis=0)
        tangents /= np.maximum(pose.norm(tangents, keepdims=True), 1e-12)
        curvature = np.gradient(tangents, axis=0) / _LAYER_M
        joints = np.zeros((len(starts), len(poses), len(arm.joint_names)))
        for row, start in enumerate(starts):
            seed = workcell.reachability.posture
            for layer, place in enumerate(model.start_frame.from_frame(poses, start[None], poses)):
                joints[row, layer] = seed = arm.inverse(place, seed).joints
        return cls(workcell, model, starts, poses, _across(tangents), curvature, joints)

    @property
    def count(self) -> int:
        """Number of layers."""
        return len(self.poses)

    def rooms(self, offsets: Array, first: int = 0) -> Array:
        """Return the room (K, M, 2) [m] to obstacles and to the rest at offsets (K, M, 3) of layers from ``first``.

        It is at most the slack, and −∞ where the arm cannot reach.
        """
        layers, places, _ = offsets.shape
        found = np.full((layers, places, 2), _SLACK_M)
        scene = self.workcell.scene
        for row, start in enumerate(self.starts):
            for index in range(layers):
                layer = first + index
                moved = np.repeat(self.poses[layer][None], places, axis=0)
                moved[:, pose.POSITION] += offsets[index]
                world = self.model.start_frame.from_frame(moved, start[None], moved)
                joints = self.workcell.arm.inverse_batch(world, np.repeat(self.joints[row, layer][None], places, 0))
                for place in range(places):
                    here = joints[place]
                    room = (-np.inf, -np.inf) if np.isnan(here[0]) else scene.rooms(here, _SLACK_M)
                    found[index, place] = np.minimum(found[index, place], room)
        return found

    def way(self, first: int, last: int, half: int) -> tuple[Bend, float] | None:
        """Return the cheapest way that the arm can follow and that is off the path between two layers at most, if any.

        It is the bend that takes it, and the largest missing share of the slack. The grid reaches ``half`` cells to
        either side.
        """
        cells = np.arange(-half, half + 1)
        flat = np.stack(np.meshgrid(cells, cells, indexing="ij"), axis=-1).reshape(-1, 2) * _CELL_M
        offsets = np.einsum("mn,lnd->lmd", flat, self.normals[first : last + 1])
        progress = 1.0 - np.einsum("lmd,ld->lm", offsets, self.curvature[first : last + 1])
        missing = self._missing(offsets, first)
        cost = np.where(np.isfinite(missing), pose.norm(offsets) / _ASIDE_M + _NO_SLACK * missing**2, np.inf)
        cost[progress < _LEAST_PROGRESS] = np.inf
        # The way begins and ends on the path itself.
        middle = len(flat) // 2
        cost[0] = cost[-1] = np.inf
        cost[0, middle] = cost[-1, middle] = 0.0
        for _ in range(_GIVEN_UP):
            places = _cheapest(cost, len(cells))
            if places is None:
                return None
            layers = np.arange(len(cost))
            wanted = np.zeros((self.count, 3))
            wanted[first : last + 1] = offsets[layers, places]
            bend, refused = self._bend(wanted)
            if bend is not None:
                return bend, float(missing[layers, places][1:-1].max(initial=0.0))
            about = {int(np.floor(refused)), int(np.ceil(refused))} & set(range(first + 1, last))
            if not about:
                return None
            for layer in about:
                beside = pose.norm(offsets[layer - first] - wanted[layer])
                cost[layer - first, beside <= _AWAY * _CELL_M] = np.inf
        return None

    def _missing(self, offsets: Array, first: int) -> Array:
        """Return the missing share of the slack (K, M) at offsets (K, M, 3) of layers from ``first``.

        It is infinite where something touches. The path itself may pass furniture as near as it does.
        """
        rooms = self.rooms(offsets, first)
        missing = np.clip(1.0 - rooms / _SLACK_M, 0.0, 1.0)
        missing[..., 1] = np.where(pose.norm(offsets) > 0.0, missing[..., 1], 0.0)
        missing = missing.max(axis=2)
        return np.where((rooms < 0.0).any(axis=2), np.inf, missing)

    @cached_property
    def own_rooms(self) -> Array:
        """The room (L, 2) [m] on the path itself."""
        return self.rooms(np.zeros((self.count, 1, 3)))[:, 0]

    def _bend(self, offsets: Array) -> tuple[Bend | None, float]:
        """Return the bend with offsets (L, 3) [m] of the layers, its corners rounded off where that stays free.

        Returns:
            The bend, or None and the layer (with its fraction) near which the arm cannot follow it.
        """
        from scipy.ndimage import gaussian_filter1d

        arc = arc_lengths(self.poses[:, pose.POSITION])
        wanted = np.linspace(0.0, arc[-1], max(2, round(arc[-1] / _SPACING_M) + 1))
        path, sharp = (at_arc_lengths(rows, arc, wanted) for rows in (self.poses[:, pose.POSITION], offsets))
        least = _KEPT * min(self._least_room(offsets), _SLACK_M)
        for width in _ROUNDED_M:
            smooth = gaussian_filter1d(sharp, width / _SPACING_M, axis=0, mode="constant")
            if self._least_room(at_arc_lengths(smooth, wanted, arc)) >= least:
                bend = Bend(path, smooth)
                if self.refused(bend) is None:
                    return bend, 0.0
        bend = Bend(path, sharp)
        refused = self.refused(bend)
        return (bend, 0.0) if refused is None else (None, refused * (self.count - 1))

    def refused(self, bend: Bend) -> float | None:
        """Return at which share of a moved path the arm can follow no farther; None if it can follow all."""
        poses = to_count(self.poses, len(bend.path))
        poses[:, pose.POSITION] = bend.bent
        followed = np.append(np.arange(0, len(poses) - 1, _FOLLOWED), len(poses) - 1)
        for start in self.starts:
            world = self.model.start_frame.from_frame(poses[followed], start[None], poses[followed])
            reached, motion = self.workcell.reachability.follow_as_far(world)
            if motion.joints is None:
                return float(followed[len(reached)] / followed[-1])
        return None

    def _least_room(self, offsets: Array) -> float:
        """Return the least room [m] to obstacles at offsets (L, 3) of the layers."""
        return float(self.rooms(offsets[:, None])[..., 0].min())


def _cheapest(cost: Array, side: int) -> np.ndarray | None:
    """Return the place (K,) in each layer of the cheapest way from the first to the last; None if there is none.

    The costs are of places (K, side²) in a grid ``side`` cells wide, infinite where none may be.
    """
    shifts = [(i, j) for i in range(-_SIDEWAYS, _SIDEWAYS + 1) for j in range(-_SIDEWAYS, _SIDEWAYS + 1)]
    slopes = np.array([_SLOPE * (i * i + j * j) * (_CELL_M / _LAYER_M) ** 2 for i, j in shifts])
    total, came = cost[0].reshape(side, side), []
    for layer in range(1, len(cost)):
        padded = np.pad(total, _SIDEWAYS, constant_values=np.inf)
        each = np.array([_shifted(padded, *shift, side) for shift in shifts]) + slopes[:, None, None]
        came.append(each.argmin(axis=0))
        total = each.min(axis=0) + cost[layer].reshape(side, side)
    if not np.isfinite(total).any():
        return None
    i, j = np.unravel_index(total.argmin(), total.shape)
    places = np.empty(len(cost), dtype=np.int64)
    for layer in range(len(cost) - 1, -1, -1):
        places[layer] = i * side + j
        if layer:
            shift = shifts[came[layer - 1][i, j]]
            i, j = i + shift[0], j + shift[1]
    return places


def _shifted(padded: Array, i: int, j: int, side: int) -> Array:
    return padded[_SIDEWAYS + i : _SIDEWAYS + i + side, _SIDEWAYS + j : _SIDEWAYS + j + side]


def _across(tangents: Array) -> Array:
    """Return two unit vectors (L, 2, 3) at right angles to each tangent (L, 3), turned as little as possible."""
    axis = np.eye(3)[np.abs(tangents[0]).argmin()]
    found = []
    for tangent in tangents:
        axis = axis - (axis @ tangent) * tangent
        axis /= np.linalg.norm(axis)
        found.append([axis, np.cross(tangent, axis)])
    return np.array(found)
