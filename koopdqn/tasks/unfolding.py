"""Unfolding: a path that passes itself, spread out along one direction so that it no longer does.

Where a path comes over the same place twice, the place alone does not say how it goes on. Every place is lifted, the
higher the more of the path is left, as a helix lifts a circle; intent, trust and policy then know it as they know any
other path. Where it turns back and goes back the way it came, what comes before lies above what comes after as one
floor above the next. Which passage a pose belongs to is known from the leg that its episode is on: the path is cut
between its passages, and where it turns back; where an episode passes a cut, it counts as having started there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise

import numpy as np

from koopdqn import pose
from koopdqn.paths import arc_lengths, between, mean_poses, to_count, way_lengths
from koopdqn.pose import Array
from koopdqn.tasks.passages import APART, cuts_between, passages, turns_of

# Distance of the path's points [m], more where they would be more than so many.
_SPACING_M, _MOST_POINTS = 0.002, 1500
# Two passages are one place if nearer together than so many spreads of the demonstrations, and than so many steps.
_SPREADS, _STEPS = 2.0, 4.0
# Each passage is lifted above the next by so many of that distance, where that is no steeper than this [m/m].
_LIFTED, _STEEPEST = 3.0, 0.5
# Iterations of the inverse.
_ITERATIONS = 3
# Places of a leg, between which something is nearest.
_LEAST_LEG = 2
# Positions that differ by less [m] are the same; starts of legs differ by more.
_SAME, _HAIR = 1e-9, 1e-6


@dataclass(frozen=True)
class Unfolding:
    """How a path that passes itself is spread out.

    Attributes:
        path: (P, 7) poses along the mean of the demonstrations, evenly spaced.
        axis: (3,) the direction in which places are lifted, a unit vector.
        lifts: (P,) by how much each place is lifted [m]; 0 at the goal.
        cuts: (K,) places of the path at which its legs end, in order; the last one ends at the goal.
        back: (K,) whether the path turns back at each cut, and goes back the way it came.
        overlap: by how many places a leg is known beyond its ends, but where the path turns back.
    """

    path: Array
    axis: Array
    lifts: Array
    cuts: np.ndarray
    back: np.ndarray
    overlap: np.ndarray

    @classmethod
    def of(cls, trajectories: Sequence[Array], step: float, by_goal: float) -> "Unfolding | None":
        """Return the unfolding of trajectories (N, 7) with steps of ``step`` [m].

        A path that begins nearer to the goal than ``by_goal`` [m] is closed, and passes itself there.

        None if their mean does not pass itself, or if they are too far from it to tell which passage they are on.
        """
        count = max(len(rows) for rows in trajectories)
        mean = mean_poses(trajectories, count)
        aligned = np.array([to_count(rows, count, way_lengths(rows))[:, pose.POSITION] for rows in trajectories])
        spread = float(np.sqrt(((aligned - mean[:, pose.POSITION]) ** 2).sum(axis=2).mean()))
        near = max(_SPREADS * spread, _STEPS * step)
        found = cls._along(mean, near, by_goal)
        if found is None or not all(map(found._tells, trajectories)):
            return None
        # Aligned leg by leg, places where the path turns back are not cut short.
        legs = [found._leg(found.begun(rows, hindsight=True)) for rows in trajectories]
        means = []
        for leg in range(len(found.cuts) + 1):
            parts = [rows[on == leg] for rows, on in zip(trajectories, legs, strict=True)]
            means.append(mean_poses(parts))
        again = cls._along(np.concatenate(means), near, by_goal)
        told = again is not None and len(again.cuts) == len(found.cuts) and all(map(again._tells, trajectories))
        return again if told else found

    @classmethod
    def _along(cls, mean: Array, near: float, by_goal: float) -> "Unfolding | None":
        """Return the unfolding of a path of poses (N, 7), on which what is nearer than ``near`` [m] is one place."""
        length = float(arc_lengths(mean[:, pose.POSITION])[-1])
        path = to_count(mean, min(max(3, round(length / _SPACING_M) + 1), _MOST_POINTS))
        spacing = length / (len(path) - 1)
        pairs, opened = passages(path[:, pose.POSITION], near, by_goal, spacing)
        if not len(pairs):
            return None
        overlap = max(1, round(near / spacing))
        turns = turns_of(path[:, pose.POSITION], pairs[~opened], overlap)
        # Passages between which the path turns back are on two floors already.
        around = pairs[np.searchsorted(turns, pairs[:, 0]) == np.searchsorted(turns, pairs[:, 1])]
        cuts = cuts_between(around[:, 0] + overlap + 1, around[:, 1] - overlap - 1)
        if cuts is None:
            return None
        way = spacing * np.arange(len(path))[::-1]
        lifts = min(_STEEPEST, _LIFTED * near / (way[around[:, 0]] - way[around[:, 1]]).min(initial=np.inf)) * way
        lifts += _LIFTED * near * (len(turns) - np.searchsorted(turns, np.arange(len(path))))
        away = path[:, pose.POSITION] - path[:, pose.POSITION].mean(axis=0)
        axis = np.linalg.svd(away, full_matrices=False)[2][-1]
        every = np.union1d(cuts, turns)
        # A leg that is over before it can be told from its neighbours is none.
        if np.diff([0, *every, len(path) - 1]).min() <= overlap:
            return None
        return cls(path, axis, lifts, every, np.isin(every, turns), np.array(overlap))

    def to_frame(self, poses: Array, starts: Array) -> Array:
        """Return poses (..., 7) of legs that began at ``starts`` (..., 7), lifted."""
        legs = np.broadcast_to(self._leg(starts), poses.shape[:-1])
        return self._moved(poses, self._lift(self._progress(poses, legs)))

    def from_frame(self, local: Array) -> Array:
        """Return the inverse of :meth:`to_frame` at ``local`` (..., 7)."""
        place = _nearest(local[..., pose.POSITION].reshape(-1, 3), self._lifted).reshape(local.shape[:-1])
        legs = (place[..., None] > self.cuts + 0.5).sum(axis=-1)
        for _ in range(_ITERATIONS):
            place = self._progress(self._moved(local, -self._lift(place)), legs)
        return self._moved(local, -self._lift(place))

    def whole(self, poses: Array) -> Array:
        """Return the poses (N, 7) of one path, lifted, with what leads from floor to floor between them, (M, 7) in all.

        It goes on beyond where the path turns back, and comes back there on the next floor: so all states near the end
        of a leg lead to that end, and none aside.
        """
        starts = self.begun(poses, hindsight=True)
        lifted, legs = self.to_frame(poses, starts), self._leg(starts)
        parts, done = [], 0
        for row in np.flatnonzero(np.diff(legs) * np.append(self.back, False)[legs[:-1]]).tolist():
            above, below = lifted[row], lifted[row + 1]
            out, back = self._beyond[legs[row]]
            corners = [above, self._moved(above, out), self._moved(below, back), below]
            parts.append(lifted[done:row])
            for corner, following in pairwise(corners):
                count = max(1, round(float(pose.position_distance(corner, following)) / self._spacing))
                parts.append(between(corner, following, np.arange(count) / count))
            done = row + 1
        return np.concatenate([*parts, lifted[done:]])

    def laid(self, whole: Array) -> Array:
        """Return the poses (N, 7) of which :meth:`whole` gives these (M, 7), or of a path like them."""
        return self.from_frame(whole[~self.between_floors(whole[:, pose.POSITION])])

    def between_floors(self, lifted: Array) -> np.ndarray:
        """Return whether lifted positions (N, 3) [m] lie on what leads from floor to floor, as booleans (N,)."""
        place, turns = _nearest(lifted, self._lifted), self.cuts[self.back]
        return np.asarray(((place[:, None] >= turns) & (place[:, None] <= turns + 1)).any(axis=1))

    def onward(self, poses: Array, starts: Array) -> Array:
        """Return the starts (N, 7) of the legs on which poses (N, 7) are, of legs that began at ``starts`` (N, 7)."""
        legs = self._leg(starts)
        under_way = legs < len(self.cuts)
        passed = under_way & (self._progress(poses, legs) >= np.append(self._passed, len(self.path))[legs])
        if not passed.any():
            return starts
        after = starts.copy()
        after[passed] = self.starts[legs[passed]]
        return after

    def begun(self, poses: Array, *, hindsight: bool = False) -> Array:
        """Return the starts (N, 7) of the legs on which the poses (N, 7) of one path are.

        They are those that :meth:`onward` tells from pose to pose. With ``hindsight``, as of a demonstration, a leg
        ends where the path itself turns back, a little before the place or beyond.
        """
        starts = np.repeat(poses[:1], len(poses), axis=0)
        row = 1
        for leg, (least, back) in enumerate(zip(self._passed, self.back, strict=True)):
            progress = self._progress(poses[row:], np.full(len(poses[row:]), leg))
            turned = self._turned_back(leg, poses[row:], progress) if hindsight and back else None
            passed = progress >= least
            if turned is None and not passed.any():
                break
            row += int(passed.argmax()) if turned is None else turned
            starts[row:] = self.starts[leg]
            row += 1
        return starts

    def on_last_leg(self, starts: Array) -> np.ndarray:
        """Return whether the leg that began at each of ``starts`` (N, 7) ends at the goal, as booleans (N,)."""
        return np.asarray(self._leg(starts) == len(self.cuts))

    @cached_property
    def starts(self) -> Array:
        """The poses (K, 7) at which all legs but the first begin, apart by a hair where the path is there again."""
        hair = _HAIR * np.arange(len(self.cuts))[:, None] * self.axis
        return self._moved(self.path[self.cuts], hair)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the unfolding as arrays; of a path that nowhere turns back without :attr:`back`."""
        names = [each.name for each in fields(self) if each.name != "back" or self.back.any()]
        return {f"unfolding_{name}": np.asarray(getattr(self, name)) for name in names}

    @classmethod
    def restore(cls, held: Mapping[str, np.ndarray]) -> "Unfolding | None":
        """Return the unfolding with these :meth:`arrays`; None where there are none.

        Raises:
            ValueError: a number is not finite, the path is no path, or a cut leaves no leg.
        """
        if "unfolding_path" not in held:
            return None
        held = {"unfolding_back": np.zeros(np.shape(held["unfolding_cuts"]), dtype=bool), **held}
        path, axis, lifts, cuts, back, overlap = (np.asarray(held[f"unfolding_{each.name}"]) for each in fields(cls))
        count = len(path) if path.ndim == 2 else 0
        if count < 3 or path.shape[1] != 7 or lifts.shape != (count,) or axis.shape != (3,):
            raise ValueError(f"the unfolding must have a path of three poses at least, found {path.shape}")
        if not all(np.isfinite(each).all() for each in (path, axis, lifts)):
            raise ValueError("the unfolding must be of finite numbers")
        inside = cuts.ndim == 1 and len(cuts) > 0 and bool((np.diff([0, *cuts, count - 1]) >= _LEAST_LEG).all())
        if not inside or back.shape != cuts.shape or overlap.shape != () or overlap < 1:
            raise ValueError(f"the unfolding must be cut on its path, in order, found {cuts.tolist()}")
        whole = cuts.astype(int), back.astype(bool), overlap.astype(int)
        return cls(path.astype(float), axis.astype(float), lifts.astype(float), *whole)

    def _tells(self, poses: Array) -> bool:
        """Return whether the poses (N, 7) of one path are on leg after leg, and skip no passage."""
        legs = self._leg(self.begun(poses, hindsight=True))
        jumps = np.abs(np.diff(self._progress(poses, legs)))
        return bool(legs[-1] == len(self.cuts) and (jumps < APART * self.overlap).all())

    def _turned_back(self, leg: int, poses: Array, progress: Array) -> int | None:
        """Return the row of poses (N, 7) of progress (N,) that is farthest out where they turn back at a leg's end.

        They turn back where they come as near to it as the overlap, and then go back by as much; None if they do not.
        """
        far = float(self.overlap)
        most = np.maximum.accumulate(progress)
        near = most >= self.cuts[leg] - far
        back = near & (progress < most - far)
        if not back.any():
            return None
        first, until = int(near.argmax()), int(back.argmax())
        return first + int((poses[first:until, pose.POSITION] @ self._beyond[leg, 0]).argmax())

    def _leg(self, starts: Array) -> np.ndarray:
        """Return the leg (...) that began at each start (..., 7); the first unless that is a cut."""
        apart = np.abs(starts[..., None, pose.POSITION] - self.starts[:, pose.POSITION]).max(axis=-1)
        return np.where(apart.min(axis=-1) < _SAME, apart.argmin(axis=-1) + 1, 0)

    def _progress(self, poses: Array, legs: np.ndarray) -> Array:
        """Return the place (...), with its fraction, of the leg nearest to each pose (..., 7)."""
        positions, of_leg = poses[..., pose.POSITION].reshape(-1, 3), legs.reshape(-1)
        found = np.empty(len(positions))
        for leg in np.unique(of_leg):
            first, last = self._reach[leg]
            rows = of_leg == leg
            found[rows] = first + _nearest(positions[rows], self.path[first:last, pose.POSITION])
        return found.reshape(poses.shape[:-1])

    def _lift(self, place: Array) -> Array:
        """Return how far (..., 3) [m] places (...) of the path are moved."""
        return np.asarray(np.interp(place, np.arange(len(self.path)), self.lifts)[..., None] * self.axis)

    @staticmethod
    def _moved(poses: Array, offset: Array) -> Array:
        return np.concatenate([poses[..., pose.POSITION] + offset, poses[..., pose.QUATERNION]], axis=-1)

    @cached_property
    def _reach(self) -> list[tuple[int, int]]:
        """The first place of each leg and the one after its last."""
        beyond = np.where(self.back, 0, self.overlap)
        first = np.where(self.back, self.cuts + 1, np.maximum(0, self.cuts - beyond))
        last = np.minimum(self.cuts + beyond + 1, len(self.path))
        return list(zip([0, *first.tolist()], [*last.tolist(), len(self.path)], strict=True))

    @cached_property
    def _beyond(self) -> Array:
        """By how far (K, 2, 3) [m] what leads to the next floor goes on from a leg, and comes from before the next one.

        Nothing where the path does not turn back.
        """
        places, far = self.path[:, pose.POSITION], int(self.overlap)
        ends = np.stack([self.cuts, np.minimum(self.cuts + 1, len(places) - 1)], axis=1)
        within = np.stack([np.maximum(0, self.cuts - far), np.minimum(self.cuts + 1 + far, len(places) - 1)], axis=1)
        way = places[ends] - places[within]
        size = np.maximum(pose.norm(way, keepdims=True), 1e-9)
        return np.asarray(self.back[:, None, None] * far * self._spacing * way / size)

    @cached_property
    def _passed(self) -> Array:
        """The places (K,) from which on legs have ended: those of the cuts, or just before where it turns back."""
        return np.asarray(self.cuts - self.back.astype(float))

    @cached_property
    def _spacing(self) -> float:
        return float(arc_lengths(self.path[:, pose.POSITION])[-1] / (len(self.path) - 1))

    @cached_property
    def _lifted(self) -> Array:
        """The path's positions (P, 3) [m], lifted."""
        return np.asarray(self.path[:, pose.POSITION] + self.lifts[:, None] * self.axis)


def _nearest(positions: Array, path: Array) -> Array:
    """Return the place (N,), with its fraction, of a path (P, 3) nearest to each position (N, 3)."""
    squared = (path**2).sum(axis=1) - 2.0 * positions @ path.T
    at = squared.argmin(axis=1)
    best, far = at.astype(float), np.full(len(positions), np.inf)
    for begin in (np.maximum(at - 1, 0), np.minimum(at, len(path) - 2)):
        one, along = path[begin], path[begin + 1] - path[begin]
        share = ((positions - one) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-18)
        share = np.clip(share, 0.0, 1.0)
        off = ((positions - one - share[:, None] * along) ** 2).sum(axis=1)
        best, far = np.where(off < far, begin + share, best), np.minimum(off, far)
    return np.asarray(best)
