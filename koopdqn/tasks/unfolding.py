"""Unfolding: a path that passes itself, spread out along one direction so that it no longer does.

Where a path comes over the same place twice, the place alone does not say how it goes on. Every place is lifted, the
higher the more of the path is left, as a helix lifts a circle; intent, trust and policy then know it as they know any
other path. Which passage a pose belongs to is known from the leg that its episode is on: the path is cut between its
passages, and where an episode passes a cut, it counts as having started there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from koopdqn import pose
from koopdqn.paths import arc_lengths, mean_poses, to_count, way_lengths
from koopdqn.pose import Array

# Distance of the path's points [m], more where they would be more than so many.
_SPACING_M, _MOST_POINTS = 0.002, 1500
# Two passages are one place if nearer together than so many spreads of the demonstrations, and than so many steps. They
# are two if the path between them is so many times longer, and opens so many times farther; where it does not, it goes
# back the way it came if it is nearer to itself than so many times that distance.
_SPREADS, _STEPS, _APART, _OPENS, _BESIDE = 2.0, 4.0, 3.0, 2.0, 1.5
# Each passage is lifted above the next by so many of that distance, where that is no steeper than this [m/m].
_LIFTED, _STEEPEST = 3.0, 0.5
# Iterations of the inverse.
_ITERATIONS = 3
# Positions that differ by less [m] are the same.
_SAME = 1e-9


@dataclass(frozen=True)
class Unfolding:
    """How a path that passes itself is spread out.

    Attributes:
        path: (P, 7) poses along the mean of the demonstrations, evenly spaced.
        axis: (3,) the direction in which places are lifted, a unit vector.
        lifts: (P,) by how much each place is lifted [m]; 0 at the goal.
        cuts: (K,) places of the path at which its legs end, in order; the last one ends at the goal.
        overlap: by how many places a leg is known beyond its ends.
    """

    path: Array
    axis: Array
    lifts: Array
    cuts: np.ndarray
    overlap: np.ndarray

    @classmethod
    def of(cls, trajectories: Sequence[Array], step: float) -> "Unfolding | None":
        """Return the unfolding of trajectories (N, 7) with steps of ``step`` [m].

        None if their mean does not pass itself, or if they are too far from it to tell which passage they are on.
        """
        count = max(len(rows) for rows in trajectories)
        mean = mean_poses(list(trajectories), count)
        aligned = np.array([to_count(rows, count, way_lengths(rows))[:, pose.POSITION] for rows in trajectories])
        spread = float(np.sqrt(((aligned - mean[:, pose.POSITION]) ** 2).sum(axis=2).mean()))
        near = max(_SPREADS * spread, _STEPS * step)
        length = float(arc_lengths(mean[:, pose.POSITION])[-1])
        path = to_count(mean, min(max(3, round(length / _SPACING_M) + 1), _MOST_POINTS))
        spacing = length / (len(path) - 1)
        pairs, back = _passages(path[:, pose.POSITION], near, spacing)
        if not len(pairs):
            return None
        overlap = max(1, round(near / spacing))
        cuts = _cuts(pairs[:, 0] + overlap + 1, pairs[:, 1] - overlap - 1)
        if cuts is None:
            return None
        rising = np.append(np.cumsum(~back[::-1])[::-1][1:], 0) * spacing
        least = float((rising[pairs[:, 0]] - rising[pairs[:, 1]]).min())
        if least <= 0.0:
            return None
        away = path[:, pose.POSITION] - path[:, pose.POSITION].mean(axis=0)
        axis = np.linalg.svd(away, full_matrices=False)[2][-1]
        lifts = min(_STEEPEST, _LIFTED * near / least) * rising
        found = cls(path, axis, lifts, cuts, np.array(overlap))
        return found if all(found._tells(rows, least) for rows in trajectories) else None

    def to_frame(self, poses: Array, starts: Array) -> Array:
        """Return poses (..., 7) of legs that began at ``starts`` (..., 7), lifted."""
        legs = np.broadcast_to(self._leg(starts), poses.shape[:-1])
        return self._moved(poses, self._lift(self._progress(poses, legs)))

    def from_frame(self, local: Array) -> Array:
        """Return the inverse of :meth:`to_frame` at ``local`` (..., 7)."""
        place = _nearest(local[..., pose.POSITION].reshape(-1, 3), self._lifted).reshape(local.shape[:-1])
        legs = np.searchsorted(self.cuts, place, side="right")
        for _ in range(_ITERATIONS):
            place = self._progress(self._moved(local, -self._lift(place)), legs)
        return self._moved(local, -self._lift(place))

    def onward(self, poses: Array, starts: Array) -> Array:
        """Return the starts (N, 7) of the legs on which poses (N, 7) are, of legs that began at ``starts`` (N, 7)."""
        legs = self._leg(starts)
        under_way = legs < len(self.cuts)
        passed = under_way & (self._progress(poses, legs) >= np.append(self.cuts, len(self.path))[legs])
        if not passed.any():
            return starts
        after = starts.copy()
        after[passed] = self.path[self.cuts[legs[passed]]]
        return after

    def begun(self, poses: Array) -> Array:
        """Return the starts (N, 7) of the legs on which the poses (N, 7) of one path are."""
        starts = np.repeat(poses[:1], len(poses), axis=0)
        row = 0
        for leg, cut in enumerate(self.cuts):
            passed = self._progress(poses[row:], np.full(len(poses) - row, leg)) >= cut
            if not passed.any():
                break
            row += int(passed.argmax())
            starts[row:] = self.path[cut]
        return starts

    def start_of(self, local: Array, start: Array) -> Array:
        """Return the start (7,) of the leg on which a lifted pose (7,) is, of an episode that begins at ``start``."""
        place = _nearest(local[None, pose.POSITION], self._lifted)[0]
        leg = int(np.searchsorted(self.cuts, place, side="right"))
        return start if leg == 0 else np.asarray(self.path[self.cuts[leg - 1]])

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the unfolding as arrays."""
        return {f"unfolding_{each.name}": np.asarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def restore(cls, held: Mapping[str, np.ndarray]) -> "Unfolding | None":
        """Return the unfolding with these :meth:`arrays`; None where there are none.

        Raises:
            ValueError: a number is not finite, the path is no path, or a cut lies beyond it.
        """
        if "unfolding_path" not in held:
            return None
        path, axis, lifts, cuts, overlap = (np.asarray(held[f"unfolding_{each.name}"]) for each in fields(cls))
        count = len(path) if path.ndim == 2 else 0
        if count < 3 or path.shape[1] != 7 or lifts.shape != (count,) or axis.shape != (3,):
            raise ValueError(f"the unfolding must have a path of three poses at least, found {path.shape}")
        if not all(np.isfinite(each).all() for each in (path, axis, lifts)):
            raise ValueError("the unfolding must be of finite numbers")
        inside = cuts.ndim == 1 and len(cuts) > 0 and bool(((cuts > 0) & (cuts < count - 1)).all())
        if not inside or (np.diff(cuts) <= 0).any() or overlap.shape != () or overlap < 1:
            raise ValueError(f"the unfolding must be cut on its path, in order, found {cuts.tolist()}")
        return cls(path.astype(float), axis.astype(float), lifts.astype(float), cuts.astype(int), overlap.astype(int))

    def _tells(self, poses: Array, least: float) -> bool:
        """Return whether the poses (N, 7) of one path are on leg after leg, and skip no loop of ``least`` [m]."""
        legs = self._leg(self.begun(poses))
        jumps = np.abs(np.diff(self._progress(poses, legs))) * self._spacing
        return bool(legs[-1] == len(self.cuts) and (jumps < least).all())

    def _leg(self, starts: Array) -> np.ndarray:
        """Return the leg (...) that began at each start (..., 7); the first unless that is a cut."""
        apart = np.abs(starts[..., None, pose.POSITION] - self.path[self.cuts, pose.POSITION]).max(axis=-1)
        return np.where(apart.min(axis=-1) < _SAME, apart.argmin(axis=-1) + 1, 0)

    def _progress(self, poses: Array, legs: np.ndarray) -> Array:
        """Return the place (...), with its fraction, of the leg nearest to each pose (..., 7)."""
        positions, of_leg = poses[..., pose.POSITION].reshape(-1, 3), legs.reshape(-1)
        found = np.empty(len(positions))
        for leg in np.unique(of_leg):
            first = 0 if leg == 0 else max(0, int(self.cuts[leg - 1]) - int(self.overlap))
            last = len(self.path) if leg == len(self.cuts) else int(self.cuts[leg]) + int(self.overlap) + 1
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
    def _spacing(self) -> float:
        return float(arc_lengths(self.path[:, pose.POSITION])[-1] / (len(self.path) - 1))

    @cached_property
    def _lifted(self) -> Array:
        """The path's positions (P, 3) [m], lifted."""
        return np.asarray(self.path[:, pose.POSITION] + self.lifts[:, None] * self.axis)


def _passages(path: Array, near: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs (M, 2) of places of a path (P, 3) [m] that are one place, by the second of them.

    Where the path goes back the way it came it encloses nothing, and does not pass itself: returned too is which places
    (P,) lie there, and one of them is told from another no better than before.
    """
    pairs, turns = [np.empty((0, 2), dtype=int)], np.zeros(len(path) + 1, dtype=int)
    # By how far the path between two places opens that are one and two points nearer together along it.
    last, before = pose.norm(path[1:] - path[:-1]), np.zeros(len(path))
    for gap in range(2, len(path)):
        across, within = pose.norm(path[gap:] - path[:-gap]), before[1:-1]
        if gap * spacing > _APART * near:
            opened = within > _OPENS * near
            first = np.flatnonzero((across < near) & opened)
            pairs.append(np.stack([first, first + gap], axis=1))
            beside = np.flatnonzero((across < _BESIDE * near) & ~opened)
            turns[beside] += 1
            turns[beside + gap + 1] -= 1
        last, before = np.maximum(across, within), last
    found = np.concatenate(pairs)
    return found[np.argsort(found[:, 1], kind="stable")], np.cumsum(turns[:-1]) > 0


def _cuts(first: np.ndarray, last: np.ndarray) -> np.ndarray | None:
    """Return as few places (K,) as can be, one at least from ``first`` (M,) to ``last`` (M,); None if one is empty."""
    if (first > last).any():
        return None
    cuts: list[int] = []
    low, high = first[0], last[0]
    for begin, end in zip(first[1:], last[1:], strict=True):
        if begin <= high:
            low = max(low, begin)
        else:
            cuts.append(int(low + high) // 2)
            low, high = begin, end
    return np.array([*cuts, int(low + high) // 2])


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
