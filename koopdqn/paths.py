"""Paths: arc length, resampling, smooth paths in space, and the distances of Fréchet and Hausdorff."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from koopdqn import pose
from koopdqn.pose import Array

# A turn of so little motion [m/rad] is one on the spot; it counts as so much of the way [m/rad]. Below the least angle
# [rad] it is rounding.
_ON_THE_SPOT, _TURN_LENGTH, _NO_TURN = 0.001, 0.1, 1e-6
# What a metre of the way counts beside one in space where the way begins, and the least share of it that is left.
_WAY_COUNTS, _LEAST_LEFT = 0.1, 0.005
# How many poses of a trajectory are told to places, of as many places as one.
_FINER = 4


@dataclass(frozen=True)
class SmoothPath:
    """A curve sampled evenly in arc length.

    Attributes:
        points: positions (M, 3) [m], evenly spaced along the curve.
        length: arc length of the whole curve [m].
    """

    points: Array
    length: float

    @classmethod
    def through(cls, waypoints: ArrayLike, spacing: float = 5e-4) -> "SmoothPath":
        """Return the centripetal cubic spline through waypoints (W, 3) [m], sampled every ``spacing`` [m].

        The centripetal parameter (the root of the chord length) keeps the spline free of loops and cusps.
        """
        from scipy.interpolate import CubicSpline

        waypoints = np.asarray(waypoints, dtype=float)
        chords = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        parameter = np.concatenate([[0.0], np.cumsum(np.sqrt(chords))])
        fine = CubicSpline(parameter, waypoints)(np.linspace(0.0, parameter[-1], 40 * len(waypoints) * 20))
        return cls.along(fine, spacing)

    @classmethod
    def along(cls, polyline: ArrayLike, spacing: float = 5e-4) -> "SmoothPath":
        """Return the polyline (P, 2 or 3) [m] sampled anew, evenly in arc length, about every ``spacing`` [m]."""
        polyline = np.asarray(polyline, dtype=float)
        arc = arc_lengths(polyline)
        count = max(2, int(np.ceil(arc[-1] / spacing)) + 1)
        return cls(at_arc_lengths(polyline, arc, np.linspace(0.0, arc[-1], count)), float(arc[-1]))

    @property
    def spacing(self) -> float:
        """Distance between neighbouring points [m]."""
        return self.length / (len(self.points) - 1)

    def nearest(self, positions: ArrayLike, *, alone: bool = False) -> np.ndarray:
        """Return the arc length (N,) [m] of the path's point nearest to each position (N, 3) [m].

        With ``alone`` no rounding hangs on how many positions there are.
        """
        # ‖p−c‖² without its constant ‖p‖²: a matrix product instead of an (N, M, 3) difference.
        products = row_products(2.0 * np.asarray(positions, dtype=float), self.points, alone=alone)
        squared = (self.points**2).sum(axis=1) - products
        return np.asarray(squared.argmin(axis=1) * self.spacing)

    def at(self, arc: ArrayLike) -> Array:
        """Return the positions (N, 3) [m] at arc lengths (N,) [m], clamped to the path's ends."""
        index = np.rint(np.asarray(arc) / self.spacing).astype(int)
        return np.asarray(self.points[np.clip(index, 0, len(self.points) - 1)], dtype=float)


def row_products(rows: Array, others: Array, *, alone: bool) -> Array:
    """Return the scalar products (N, M) of rows (N, d) with others (M, d).

    BLAS adds up those of a single row in another order than those of several: with ``alone`` each row's are to the last
    bit what they are without the others.
    """
    return np.array([row @ others.T for row in rows]) if alone else np.asarray(rows @ others.T)


def arc_lengths(points: ArrayLike) -> Array:
    """Return the arc length (N,) [m] of each point (N, 3) [m] of a polyline, from its start."""
    steps = np.linalg.norm(np.diff(np.asarray(points, dtype=float), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def way_lengths(poses: Array) -> Array:
    """Return the arc length (N,) [m] at each pose (N, 7), to which a turn on the spot adds 0.1 m a radian.

    On the spot is what turns by over a radian a millimetre.
    """
    moved = np.linalg.norm(np.diff(poses[:, pose.POSITION], axis=0), axis=1)
    turned = pose.rotation_distance(poses[1:], poses[:-1])
    on_the_spot = (moved < _ON_THE_SPOT * turned) & (turned > _NO_TURN)
    return np.concatenate([[0.0], np.cumsum(np.where(on_the_spot, _TURN_LENGTH * turned, moved))])


def at_arc_lengths(values: Array, arc: Array, wanted: Array) -> Array:
    """Return rows of values (N, D), known at arc lengths (N,), interpolated at the wanted arc lengths (W,)."""
    return np.stack([np.interp(wanted, arc, values[:, i]) for i in range(values.shape[1])], axis=1)


def hausdorff(points: Array, others: Array) -> float:
    """Return the Hausdorff distance of two sets of points (N, d) and (M, d): the farthest any is from the other set."""
    from scipy.spatial.distance import directed_hausdorff

    return float(max(directed_hausdorff(points, others)[0], directed_hausdorff(others, points)[0]))


def to_step(trajectories: Sequence[Array], step: float, turn: float) -> list[Array]:
    """Return trajectories of poses (M, 7) resampled so that neighbours are one agent's step apart.

    A new sample is taken when position has moved ``step`` [m] or rotation ``turn`` [rad] since the
    last, whichever is first, so that turning in place survives while idling and pauses vanish.
    The last pose of each of the trajectories (N, 7) is always kept. All are walked along side by side.
    """
    kept = [[rows[0]] for rows in trajectories]
    last = np.array([rows[0] for rows in trajectories])
    previous = last.copy()
    ends, place = np.array([len(rows) for rows in trajectories]), np.ones(len(trajectories), dtype=np.int64)
    while (under_way := np.flatnonzero(place < ends)).size:
        current = np.array([trajectories[i][place[i]] for i in under_way.tolist()])
        moved = pose.position_distance(current, last[under_way])
        turned = pose.rotation_distance(current, last[under_way])
        beyond = np.maximum(moved / step, turned / turn) >= 1.0
        # Several samples may fit between two recorded poses: where one is taken, the recorded pose stays the next.
        taken, passed = under_way[beyond], under_way[~beyond]
        previous[passed] = current[~beyond]
        place[passed] += 1
        if taken.size:
            distances = moved[beyond], turned[beyond]
            last[taken] = previous[taken] = _crossing(
                previous[taken], current[beyond], last[taken], *distances, step, turn
            )
            for i in taken.tolist():
                kept[i].append(last[i].copy())
    for rows, samples in zip(trajectories, kept, strict=True):
        # A stump much shorter than a step would teach the model to slow down at the end.
        moved, turned = pose.position_distance(rows[-1], samples[-1]), pose.rotation_distance(rows[-1], samples[-1])
        if max(moved / step, turned / turn) > 1e-6:
            samples.append(rows[-1])
    return [np.array(samples) for samples in kept]


def _crossing(before: Array, after: Array, last: Array, moved: Array, turned: Array, step: float, turn: float) -> Array:
    """Return the poses (N, 7) between two at which position first is a step, or rotation a turn, away from ``last``.

    The poses ``after`` have ``moved`` (N,) [m] and ``turned`` (N,) [rad] from ``last``, one of them at least that far.
    """
    share = np.ones(len(before))
    for row in np.flatnonzero(moved >= step):
        offset, motion = (a[row, pose.POSITION] - b[row, pose.POSITION] for a, b in ((before, last), (after, before)))
        share[row] = _sphere_crossing(offset, motion, step)
    turning = np.flatnonzero(turned >= turn)
    if turning.size:
        low, high = np.zeros(len(turning)), np.ones(len(turning))
        begin, end = before[turning], after[turning]
        way = pose.Geodesic.between(begin[:, pose.QUATERNION], end[:, pose.QUATERNION])
        angle, back = pose.rotation_distance(begin, end), pose.conjugate(last[turning][:, pose.QUATERNION])
        for _ in range(40):
            middle = 0.5 * (low + high)
            there = pose.normalized(way.turned(middle * angle))
            short = pose.angle_of(pose.multiply(there, back)) < turn
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        share[turning] = np.minimum(share[turning], high)
    return between(before, after, share)


def _sphere_crossing(offset: Array, motion: Array, radius: float) -> float:
    # The larger root of |offset + t motion|² = radius², as ``offset`` lies within the sphere.
    a, b, c = float(motion @ motion), float(offset @ motion), float(offset @ offset) - radius**2
    return float(np.clip((-b + np.sqrt(max(b * b - a * c, 0.0))) / a, 0.0, 1.0))


def between(a: Array, b: Array, share: ArrayLike) -> Array:
    """Return the poses (..., 7) a ``share`` (...) of the way from ``a`` (..., 7) to ``b`` (..., 7).

    Straight in position, geodesic in rotation.
    """
    part = np.asarray(share, dtype=float)
    position = a[..., pose.POSITION] + part[..., None] * (b[..., pose.POSITION] - a[..., pose.POSITION])
    angle = part * pose.rotation_distance(a, b)
    return pose.make(position, pose.turned_toward(a[..., pose.QUATERNION], b[..., pose.QUATERNION], angle))


def mean_poses(trajectories: Sequence[Array], count: int | None = None) -> Array:
    """Return ``count`` poses (count, 7) along the mean of pose trajectories (N, 7), aligned by their share of the way.

    They are as many as the longest has if that is None. The way is that of :func:`way_lengths`, so that turns on the
    spot are not skipped.
    """
    count = max(len(rows) for rows in trajectories) if count is None else count
    aligned = np.array([to_count(rows, count, way_lengths(rows)) for rows in trajectories])
    turns = pose.signed_as(aligned[..., pose.QUATERNION], aligned[0, :, pose.QUATERNION])
    return pose.make(aligned[..., pose.POSITION].mean(axis=0), pose.normalized(turns.mean(axis=0)))


def turned_as_shown(path: Array, trajectories: Sequence[Array]) -> Array:
    """Return poses (N, 7) evenly along the way of trajectories (M, 7), turned as these are where they pass each place.

    At equal shares of their ways paths are not at equal places, and the mean of orientations there smears a turn by
    as much. So every pose counts at the place nearest to it, and places that have none are interpolated. Near are what
    is near in space and has about as much of the way left, since all end together: a tenth of the way times the
    logarithm of what is left counts as a fourth coordinate. It tells passages of one place, and poses of a turn on the
    spot, from one another. What begins farther on is taken to have turned evenly until there, from the path's first
    pose.
    """
    from scipy.spatial import cKDTree

    places, length = np.arange(float(len(path))), way_lengths(path)[-1]
    tree = cKDTree(_with_way_left(path, length))
    shown = np.empty((len(trajectories), len(path), 4))
    for index, rows in enumerate(trajectories):
        fine = to_count(rows, _FINER * len(path), way_lengths(rows))
        nearest = tree.query(_with_way_left(fine, length))[1]
        turns = pose.signed_as(fine[:, pose.QUATERNION], path[nearest, pose.QUATERNION])
        known, place = np.unique(nearest, return_inverse=True)
        sums = np.zeros((len(known), 4))
        np.add.at(sums, place, turns)
        if known[0] > 0:
            known, sums = np.append(0, known), np.concatenate([path[:1, pose.QUATERNION], sums])
        shown[index] = at_arc_lengths(pose.normalized(sums), known.astype(float), places)
        # All end together, whatever passes that place before.
        shown[index, -1] = turns[-1]
    turns = pose.signed_as(pose.normalized(shown), path[:, pose.QUATERNION])
    return pose.make(path[:, pose.POSITION], pose.normalized(turns.sum(axis=0)))


def _with_way_left(poses: Array, length: float) -> Array:
    """Return the positions of poses (N, 7) evenly along a way [m], and what is left of it as a coordinate (N, 4)."""
    left = np.linspace(1.0, 0.0, len(poses))
    return np.column_stack([poses[:, pose.POSITION], _WAY_COUNTS * length * np.log(left + _LEAST_LEFT)])


def to_count(poses: Array, count: int, arc: Array | None = None) -> Array:
    """Return ``count`` poses (count, 7) evenly spaced along the path (N, 7).

    Where the path does not move at all, samples are spread evenly over the turn instead.

    Args:
        poses: the path.
        count: how many.
        arc: (N,) [m] the arc length of every pose, if it is not to be that of the positions themselves.
    """
    if arc is None:
        arc = arc_lengths(poses[:, pose.POSITION])
    if arc[-1] < 1e-9:
        arc = way_lengths(poses)
    # Equal arc lengths (turning in place) need an order for the interpolation.
    arc = arc + np.arange(len(arc)) * 1e-12
    values = at_arc_lengths(poses, arc, np.linspace(0.0, arc[-1], count))
    return pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION])


def discrete_frechet(gap: Array) -> Array:
    """Return the discrete Fréchet distances (E,) of curve pairs from the distances (E, N, M) between their points.

    It is the least leash with which two walkers can go along the two rows of points, neither ever
    going back (Eiter & Mannila 1994). The recursion c(i, j) = max(min(c(i−1, j), c(i−1, j−1), c(i, j−1)),
    d(i, j)) is run along anti-diagonals, whose entries do not depend on one another.

    Raises:
        ValueError: a curve has no points, or the shape is another.
    """
    if gap.ndim != 3 or 0 in gap.shape[1:]:
        raise ValueError(f"distances must have shape (E, N, M) with N, M >= 1, found {gap.shape}")
    count, n, m = gap.shape
    # Column i + 1 of a diagonal holds row i of the table; column 0 stands for the row before the first.
    before = np.full((count, n + 1), np.inf)
    last = before.copy()
    for diagonal in range(n + m - 1):
        rows = np.arange(max(0, diagonal - m + 1), min(n, diagonal + 1))
        if diagonal:
            # from (i−1, j), (i, j−1) on the last diagonal and (i−1, j−1) on the one before
            least = np.minimum(np.minimum(last[:, rows], last[:, rows + 1]), before[:, rows])
        else:
            least = np.zeros((count, 1))
        before, last = last, np.full((count, n + 1), np.inf)
        last[:, rows + 1] = np.maximum(least, gap[:, rows, diagonal - rows])
    return np.asarray(last[:, n])
