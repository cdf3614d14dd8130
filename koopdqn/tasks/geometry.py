"""Distances between line segments, for capsules."""

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array


def segment_distance(first: Array, second: Array, start: Array, end: Array) -> Array:
    """Return the distances (...) [m] between segments first–second and start–end, (..., 3) each; they broadcast.

    The closest points of two lines are clamped to the segments in turn (Ericson, Real-Time Collision
    Detection, §5.1.9).
    """
    u, v, w = second - first, end - start, first - start
    a, b, c = (u * u).sum(axis=-1), (u * v).sum(axis=-1), (v * v).sum(axis=-1)
    d, e = (u * w).sum(axis=-1), (w * v).sum(axis=-1)
    determinant = a * c - b * b
    parallel = determinant < 1e-12
    s = np.clip(np.where(parallel, 0.0, (b * e - c * d) / np.where(parallel, 1.0, determinant)), 0.0, 1.0)
    t = np.clip((b * s + e) / c, 0.0, 1.0)
    s = np.clip((b * t - d) / a, 0.0, 1.0)
    gap = w + s[..., None] * u - t[..., None] * v
    return pose.norm(gap)
