"""How far paths are from their references: matched by arc length, to the nearest point, and after Fréchet."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.paths import arc_lengths, discrete_frechet, to_count
from koopdqn.pose import Array

SAMPLES = 200
"""Points at equal shares of arc length at which a path and its reference are compared."""

# A path of actions is a staircase of ten directions, which lengthens it by up to √3, here more and there less. Arc
# length is measured of the curve that the stairs follow: a parabola fitted to the poses around each, about 10 cm.
_WINDOW = 51
_ORDER = 2

# Pairs of paths handled together: their tables of differences (E, K, K, 3) then stay under 40 MB.
_TOGETHER = 40


@dataclass(frozen=True)
class Deviations:
    """Deviations of E paths from their references, at K = :data:`SAMPLES` points each.

    Attributes:
        matched: (E, K) [m] from the reference's point at the same share of arc length, of the curve without stairs.
        stairs: (E, K) [m] the same with the arc length of the stairs themselves.
        lateral: (E, K) [m] from the nearest point of the reference.
        rotation: (E, K) [rad] from the reference's orientation at the same share of arc length.
        frechet: (E,) [m] discrete Fréchet distance of the two rows of points.
    """

    matched: Array
    stairs: Array
    lateral: Array
    rotation: Array
    frechet: Array


def deviations(paths: list[Array], references: list[Array]) -> Deviations:
    """Return the deviations of pose paths (T, 7) from as many references (R, 7), of whatever lengths."""
    mine = np.array([resampled(path) for path in paths]).reshape(-1, SAMPLES, 7)
    # Both are treated alike, so that a path does not deviate from itself.
    theirs = np.array([resampled(path) for path in references]).reshape(-1, SAMPLES, 7)
    lateral, frechet = np.empty((len(mine), SAMPLES)), np.empty(len(mine))
    for begin in range(0, len(mine), _TOGETHER):
        part = slice(begin, begin + _TOGETHER)
        points = theirs[part, :, pose.POSITION]
        gap = np.linalg.norm(mine[part, :, None, pose.POSITION] - points[:, None], axis=3)  # (E, K, K)
        lateral[part], frechet[part] = _to_polyline(gap, points), discrete_frechet(gap)
    stairs = np.array([resampled(path, smooth=False) for path in paths]).reshape(-1, SAMPLES, 7)
    plain = np.array([resampled(path, smooth=False) for path in references]).reshape(-1, SAMPLES, 7)
    return Deviations(
        pose.position_distance(mine, theirs),
        pose.position_distance(stairs, plain),
        lateral,
        pose.rotation_distance(mine, theirs),
        frechet,
    )


def hausdorff_mm(path: Array, reference: Array) -> float:
    """Return the Hausdorff distance [mm] of two paths (T, 7) and (R, 7): the farthest any point is from the other."""
    there, back = (deviations([one], [other]).lateral for one, other in ((path, reference), (reference, path)))
    return float(max(there.max(), back.max())) * 1e3


def resampled(path: Array, *, smooth: bool = True) -> Array:
    """Return a path (T, 7) at :data:`SAMPLES` equal shares of its arc length, or of its turn if it does not move.

    With ``smooth`` the arc length is that of :func:`without_stairs`; the poses are the path's own either way.
    """
    path = np.array(path)
    # q and −q are one rotation, but half-way between them there is none to interpolate.
    flips = np.where((path[1:, pose.QUATERNION] * path[:-1, pose.QUATERNION]).sum(axis=1) < 0, -1.0, 1.0)
    path[1:, pose.QUATERNION] *= np.cumprod(flips)[:, None]
    return to_count(path, SAMPLES, arc_lengths(without_stairs(path[:, pose.POSITION])) if smooth else None)


def without_stairs(positions: Array) -> Array:
    """Return the curve (T, 3) that the stairs of positions (T, 3) follow, by Savitzky & Golay (1964)."""
    from scipy.signal import savgol_filter

    window = min(_WINDOW, len(positions) - 1 + len(positions) % 2)
    if window <= _ORDER:
        return positions
    return np.asarray(savgol_filter(positions, window, _ORDER, axis=0))


def _to_polyline(gap: Array, points: Array) -> Array:
    """Return distances (E, K) to polylines (E, M, 3), from the distances (E, K, M) to their points.

    Looked at are the two segments beside the nearest point.
    """
    squared = np.square(np.linalg.norm(np.diff(points, axis=1), axis=2))  # (E, M - 1)
    nearest = gap.argmin(axis=2)
    best = np.square(gap.min(axis=2))
    for first in (nearest - 1, nearest):
        first = np.clip(first, 0, squared.shape[1] - 1)
        a, b = (np.square(np.take_along_axis(gap, i[..., None], axis=2)[..., 0]) for i in (first, first + 1))
        length = np.take_along_axis(squared, first, axis=1)
        # The foot's share of the segment from the three sides of the triangle (law of cosines).
        share = np.clip((a - b + length) / np.where(length > 0, 2 * length, 1.0), 0.0, 1.0)
        best = np.minimum(best, a - share * (a - b + length) + share**2 * length)
    return np.asarray(np.sqrt(np.maximum(best, 0.0)))
