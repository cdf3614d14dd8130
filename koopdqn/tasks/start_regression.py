"""Regression on the start: what a path's start changes along the path, beyond its own fading offset."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from koopdqn import pose
from koopdqn.paths import mean_poses, to_count, way_lengths
from koopdqn.pose import Array

# Places along the path at which the slopes are known, and the width of the kernel between them in their distance.
_PLACES, _WIDTH = 40, 1.0
# The fading offset weighs as much as so many demonstrations that say nothing else.
_PRIOR = 2.0
# Fixed-point iterations to find a place from what it was moved to.
_ITERATIONS = 3
# Starts nearer together than this [m] tell nothing.
_LEAST_SPREAD_M = 1e-6


@dataclass(frozen=True)
class StartRegression:
    """Linear regression of what is left of a path's offset on its start, at every place of the mean path.

    As a conditioned ProMP (Paraschos et al. 2013) it tells how people who began elsewhere went on. Between places the
    slopes are means weighted by a Gaussian kernel (Nadaraya & Watson 1964), so that they vary smoothly and are those of
    the nearest place far from the path. Beyond the demonstrated starts they are not extrapolated.

    Attributes:
        path: (P, 3) places along the mean path, in the start frame [m].
        shifts: (P, 3, 3) the motion at each place for each metre that the start is off [m/m].
        centre: (3,) the mean of the demonstrated starts [m].
        reach: the farthest that one of them lies from it [m].
    """

    path: Array
    shifts: Array
    centre: Array
    reach: Array

    def offset(self, starts: Array) -> Array:
        """Return how far (..., 3) [m] starts (..., 7) lie from the centre, at most as far as demonstrated ones."""
        away = starts[..., pose.POSITION] - self.centre
        return np.asarray(away * np.minimum(1.0, self.reach / np.maximum(pose.norm(away, keepdims=True), 1e-12)))

    def shift(self, places: Array, offset: Array) -> Array:
        """Return the motion (..., 3) [m] at places (..., 3) [m] of the start frame, of starts off by ``offset``."""
        rows = places.reshape(-1, 3)
        apart = rows @ self._twice - self._squares
        weight = np.exp((apart - apart.max(axis=1, keepdims=True)) / self._kernel)
        # The kernel reaches over the goal, where all paths meet.
        near = np.minimum(1.0, pose.norm(rows - self.path[-1]) / np.sqrt(2.0 * self._kernel))
        slope = (weight @ self.shifts.reshape(-1, 9)) * (near / weight.sum(axis=1))[:, None]
        return np.asarray((slope.reshape(*places.shape, 3) * offset[..., None, :]).sum(axis=-1))

    def place(self, shifted: Array, offset: Array) -> Array:
        """Return the places (..., 3) [m] of the start frame that :meth:`shift` moves to ``shifted`` (..., 3) [m]."""
        place = shifted
        for _ in range(_ITERATIONS):
            place = shifted - self.shift(place, offset)
        return place

    def arrays(self) -> dict[str, Array]:
        """Return the regression as arrays."""
        return {each.name: np.asarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def restore(cls, held: Mapping[str, np.ndarray]) -> "StartRegression | None":
        """Return the regression with these :meth:`arrays`; None where there are none.

        Raises:
            ValueError: one is not finite, or the path is no path.
        """
        if "path" not in held:
            return None
        arrays = [np.asarray(held[each.name], dtype=float) for each in fields(cls)]
        if len(arrays[0]) < 2 or not all(np.isfinite(each).all() for each in arrays):
            raise ValueError("the start frame's path must have at least two places, and all of it be finite")
        return cls(*arrays)

    @classmethod
    def fitted(cls, starts: Array, local: Sequence[Array]) -> "StartRegression | None":
        """Return the regression of trajectories on their starts; None where they all begin at one place.

        Args:
            starts: (D, 3) where D trajectories begin [m].
            local: their poses (N, 7) each, in the frame in which their own offset fades.
        """
        centre = starts.mean(axis=0)
        off = starts - centre
        spread = float(np.sqrt((off**2).sum(axis=1).mean()))
        if spread < _LEAST_SPREAD_M:
            return None
        mean = mean_poses(list(local), _PLACES)[:, pose.POSITION]
        left = np.array([to_count(rows, _PLACES, way_lengths(rows))[:, pose.POSITION] for rows in local]) - mean
        scaled = off / spread
        inverse = np.linalg.solve(scaled.T @ scaled + _PRIOR * np.eye(3), scaled.T) / spread
        # (P, 3, 3): at every place three outputs of three inputs.
        shifts = np.einsum("id,dpo->poi", inverse, left)
        return cls(mean, shifts, centre, np.asarray(pose.norm(off).max(), dtype=float))

    @cached_property
    def _twice(self) -> Array:
        return np.ascontiguousarray(2.0 * self.path.T)

    @cached_property
    def _squares(self) -> Array:
        return np.asarray((self.path**2).sum(axis=1))

    @cached_property
    def _kernel(self) -> float:
        """Twice the kernel's squared width [m²]."""
        apart = float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).mean())
        return 2.0 * (_WIDTH * max(apart, 1e-9)) ** 2
