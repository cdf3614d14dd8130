"""A smooth path in space, measured by its arc length."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from koopdqn.pose import Array


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
        """Return the polyline (P, 3) [m] sampled anew, evenly in arc length, about every ``spacing`` [m]."""
        polyline = np.asarray(polyline, dtype=float)
        arc = arc_lengths(polyline)
        count = max(2, int(np.ceil(arc[-1] / spacing)) + 1)
        return cls(at_arc_lengths(polyline, arc, np.linspace(0.0, arc[-1], count)), float(arc[-1]))

    @property
    def spacing(self) -> float:
        """Distance between neighbouring points [m]."""
        return self.length / (len(self.points) - 1)

    def nearest(self, positions: ArrayLike) -> np.ndarray:
        """Return the arc length (N,) [m] of the path's point nearest to each position (N, 3) [m]."""
        positions = np.asarray(positions, dtype=float)
        # ‖p−c‖² without its constant ‖p‖²: a matrix product instead of an (N, M, 3) difference.
        squared = (self.points**2).sum(axis=1) - 2.0 * positions @ self.points.T
        return np.asarray(squared.argmin(axis=1) * self.spacing)

    def at(self, arc: ArrayLike) -> Array:
        """Return the positions (N, 3) [m] at arc lengths (N,) [m], clamped to the path's ends."""
        index = np.rint(np.asarray(arc) / self.spacing).astype(int)
        return np.asarray(self.points[np.clip(index, 0, len(self.points) - 1)], dtype=float)


def arc_lengths(points: ArrayLike) -> Array:
    """Return the arc length (N,) [m] of each point (N, 3) [m] of a polyline, from its start."""
    steps = np.linalg.norm(np.diff(np.asarray(points, dtype=float), axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def at_arc_lengths(values: Array, arc: Array, wanted: Array) -> Array:
    """Return rows of values (N, D), known at arc lengths (N,), interpolated at the wanted arc lengths (W,)."""
    return np.stack([np.interp(wanted, arc, values[:, i]) for i in range(values.shape[1])], axis=1)


def hausdorff(points: Array, others: Array) -> float:
    """Return the Hausdorff distance of two sets of points (N, d) and (M, d): the farthest any is from the other set."""
    from scipy.spatial.distance import directed_hausdorff

    return float(max(directed_hausdorff(points, others)[0], directed_hausdorff(others, points)[0]))
