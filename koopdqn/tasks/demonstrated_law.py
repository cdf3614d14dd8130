"""The law of a task made from demonstrations: go on as the demonstration nearest by was going."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks import law

# Rows a step of the agent: half a step between neighbours keeps the nearest row within a quarter of a step.
_ROWS_PER_STEP = 2
# Of places about as near, to this share of a step, the one with less of the way to go is taken.
_AS_NEAR = 0.25
# A demonstration that moves less than this share of a step while it turns, by at least that share of the largest
# turn, is turning in place.
_IN_PLACE, _TURNING = 0.5, 0.1


@dataclass(frozen=True)
class DemonstratedLaw:
    """Pursues a point that runs ahead on the nearest demonstration.

    Of all points of all demonstrations the nearest one is found; where the orientation is followed too, nearness
    counts a turn as the distance that a step makes meanwhile. Of points about as near, the one with the least of
    its way to go is taken: the law knows no past, and where a path crosses itself that choice makes it end. The
    point ``pull_back`` further along the same demonstration is aimed at, and one step is made straight to it.

    Attributes:
        points: positions (M, 3) [m] of all demonstrations, one after the other.
        quaternions: orientations (M, 4) there.
        arc: (M,) way gone [m] from the first row of all to each, within its demonstration and those before.
        last: (M,) index of the last row of each row's demonstration.
        goal: pose (7,) at which every demonstration ends.
        step: distance of one step [m].
        pull_back: look-ahead distance [m].
        largest_turn: turn of a step [rad] at most, in place two fifths of it; 0 where the goal's orientation is
            held.
    """

    points: Array
    quaternions: Array
    arc: Array
    last: np.ndarray
    goal: Array
    step: float
    pull_back: float
    largest_turn: float

    @classmethod
    def of(
        cls, trajectories: Sequence[Array], goal: Array, step: float, pull_back: float, largest_turn: float
    ) -> "DemonstratedLaw":
        """Return the law of pose trajectories (N, 7), at least one, which all end at the goal.

        Args:
            trajectories: at the agent's step.
            goal: pose (7,).
            step: distance of one step [m].
            pull_back: look-ahead distance [m].
            largest_turn: turn of a step [rad] at most; 0 holds the goal's orientation.
        """
        finer = [_finer(trajectory) for trajectory in trajectories]
        ends = np.cumsum([len(rows) for rows in finer]) - 1
        rows = np.concatenate(finer)
        moved = np.linalg.norm(np.diff(rows[:, pose.POSITION], axis=0), axis=1)
        # From the end of one demonstration to the start of the next nobody went.
        moved[ends[:-1]] = 0.0
        last = np.repeat(ends, [len(part) for part in finer])
        arc = np.concatenate([[0.0], np.cumsum(moved)])
        return cls(rows[:, :3], rows[:, 3:], arc, last, goal, step, pull_back, largest_turn)

    def next_pose(self, poses: Array) -> Array:
        """Return where the person would be after one step from poses (N, 7)."""
        row = self._nearest(poses)
        # Within the demonstration; ties of arc length (turning in place) resolve to the last such row.
        ahead = np.searchsorted(self.arc, self.arc[row] + self.pull_back, side="right") - 1
        aim = self.points[np.minimum(ahead, self.last[row])]
        remaining = np.linalg.norm(self.goal[pose.POSITION] - poses[:, pose.POSITION], axis=1)
        distance = np.minimum(self.step, remaining)
        if not self.largest_turn:
            position = pose.moved_toward(poses[:, pose.POSITION], aim, distance)
            return pose.make(position, np.tile(self.goal[pose.QUATERNION], (len(poses), 1)))
        after = np.minimum(row + _ROWS_PER_STEP, self.last[row])
        left = pose.rotation_distance(poses, self.goal)
        wanted = 2.0 * np.arccos(np.clip(np.abs(self.quaternions[after] @ self.goal[pose.QUATERNION]), 0.0, 1.0))
        hardly_moves = np.minimum(self.arc[after] - self.arc[row], distance) < _IN_PLACE * self.step
        in_place = hardly_moves & (left - wanted > _TURNING * self.largest_turn)
        position = pose.moved_toward(poses[:, pose.POSITION], aim, np.where(in_place, 0.0, distance))
        turn = np.clip(left - wanted, 0.0, np.where(in_place, 0.4, 1.0) * self.largest_turn)
        return pose.make(position, pose.turned_toward(poses[:, pose.QUATERNION], self.goal[pose.QUATERNION], turn))

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) of the law from a start (7,) until the goal, at most ``limit`` steps."""
        return law.roll_out(self, start, limit)

    def _nearest(self, poses: Array) -> np.ndarray:
        """Return the index (N,) of the row that each pose (N, 7) goes on from."""
        position = poses[:, pose.POSITION]
        squared = ((self.points**2).sum(axis=1) - 2.0 * position @ self.points.T) + (position**2).sum(axis=1)[:, None]
        if self.largest_turn:
            cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ self.quaternions.T), 0.0, 1.0)
            squared += (2.0 * np.arccos(cosine) * self.step / self.largest_turn) ** 2
        distance = np.sqrt(np.maximum(squared, 0.0))
        near = distance <= distance.min(axis=1, keepdims=True) + _AS_NEAR * self.step
        # Counted in rows, since turning in place is no way.
        way = self.last - np.arange(len(self.last))
        return np.asarray(np.where(near, way, np.inf).argmin(axis=1))


def _finer(trajectory: Array) -> Array:
    """Return a trajectory (N, 7) with rows put between its own, evenly."""
    share = np.arange(1, _ROWS_PER_STEP)[:, None, None] / _ROWS_PER_STEP
    between = trajectory[:-1] + share * np.diff(trajectory, axis=0)[None]  # (R - 1, N - 1, 7)
    rows = np.concatenate([trajectory[None, :-1], between]).swapaxes(0, 1).reshape(-1, 7)
    rows = np.concatenate([rows, trajectory[-1:]])
    return pose.make(rows[:, pose.POSITION], rows[:, pose.QUATERNION])
