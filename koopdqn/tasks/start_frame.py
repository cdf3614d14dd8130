"""The start frame: poses expressed as if every path had begun at the nominal start; what a start changes, regressed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.paths import mean_poses, to_count, way_lengths
from koopdqn.pose import Array
from koopdqn.tasks.unfolding import Unfolding

# Places along the path at which the slopes are known, and the width of the kernel between them in their distance.
_PLACES, _WIDTH = 40, 1.0
# The fading offset weighs as much as so many demonstrations that say nothing else.
_PRIOR = 2.0
# Fixed-point iterations to find a place from what it was moved to.
_PLACE_ITERATIONS = 3
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
        for _ in range(_PLACE_ITERATIONS):
            place = shifted - self.shift(place, offset)
        return place

    def arrays(self) -> dict[str, Array]:
        """Return the regression as arrays."""
        return {each.name: np.asarray(getattr(self, each.name)) for each in fields(self)}

    @classmethod
    def restore(cls, held: Mapping[str, np.ndarray]) -> "StartRegression | None":
        """Return the regression with these :meth:`arrays`; None where there are none.

        Raises:
            ValueError: one is not finite or of another shape, or the path is no path.
        """
        if "path" not in held:
            return None
        arrays = [np.asarray(held[each.name], dtype=float) for each in fields(cls)]
        count = len(arrays[0]) if arrays[0].ndim else 0
        if count < 2 or not all(np.isfinite(each).all() for each in arrays):
            raise ValueError("the start frame's path must have at least two places, and all of it be finite")
        expected, found = [(count, 3), (count, 3, 3), (3,), ()], [each.shape for each in arrays]
        if found != expected:
            raise ValueError(f"the start frame's arrays must be of shapes {expected}, found {found}")
        return cls(*arrays)

    @classmethod
    def fitted(cls, starts: Array, local: Sequence[Array]) -> "StartRegression | None":
        """Return the regression of D trajectories on where they begin, ``starts`` (D, 3) [m]; None where all are one.

        Their poses ``local`` (N, 7) each are told in the frame in which their own offset fades.
        """
        centre = starts.mean(axis=0)
        off = starts - centre
        spread = float(np.sqrt((off**2).sum(axis=1).mean()))
        if spread < _LEAST_SPREAD_M:
            return None
        mean = mean_poses(local, _PLACES)[:, pose.POSITION]
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


# The frame must bring demonstrations nearer by more than this [m]; less is rounding.
_LEAST_GAIN_M = 1e-6
# Fixed-point iterations of the inverse; each shrinks the error by the start's offset as a share of the way.
_ITERATIONS = 12
# Where that share is larger they are slow, or come to another solution: the equation is solved instead.
_LARGEST_SHARE = 0.5


@dataclass(frozen=True)
class StartFrame:
    """The frame in which paths from different starts begin at one start.

    Paths from different starts often keep their offset for much of the way. As with movement primitives, the start's
    offset is subtracted and fades toward the goal: position p becomes p − w·(start − nominal start) with
    w = min(1, ‖p − goal‖ / ‖start − goal‖). What demonstrations show beyond that is regressed on the start
    (:class:`StartRegression`) and subtracted too. Orientations stay: Table 1 turns
    toward the goal alone, whatever a start's orientation has been.

    Or the frame unfolds a path that passes itself (:class:`koopdqn.tasks.unfolding.Unfolding`): then starts are those
    of the legs, which :meth:`onward` and :meth:`begun` tell, and paths follow no start.

    Attributes:
        start: (3,) the nominal start [m].
        goal: (3,) where all paths end [m].
        follows: whether paths follow their start; if not, the frame is the identity.
        regression: of what else the start changes; None where that is not known.
        unfolding: of a path that passes itself; None where it does not.
    """

    start: Array
    goal: Array
    follows: bool
    regression: StartRegression | None = None
    unfolding: Unfolding | None = None

    def to_frame(self, poses: Array, starts: Array) -> Array:
        """Return poses (..., 7) of paths from ``starts`` (..., 7), in the frame."""
        if self.unfolding is not None:
            return self.unfolding.to_frame(poses, starts)
        if not self.follows:
            return poses
        place = poses[..., pose.POSITION] - self._fading(poses, starts) * self._off(starts)
        if self.regression is not None:
            place = self.regression.place(place, self.regression.offset(starts))
        return np.concatenate([place, poses[..., pose.QUATERNION]], axis=-1)

    def from_frame(self, local: Array, starts: Array, near: Array) -> Array:
        """Return the inverse of :meth:`to_frame` at ``local`` (..., 7), iterated from poses ``near`` (..., 7)."""
        if self.unfolding is not None:
            return self.unfolding.from_frame(local)
        if not self.follows:
            return local
        place, off = local[..., pose.POSITION], self._off(starts)
        if self.regression is not None:
            place = place + self.regression.shift(place, self.regression.offset(starts))
        there = near
        for _ in range(_ITERATIONS):
            there = place + self._fading(there, starts) * off
        large = pose.norm(off) > _LARGEST_SHARE * pose.norm(starts[..., pose.POSITION] - self.goal)
        if large.any():
            fading = self._fading_at(place, off, starts, self._fading(near, starts)[..., 0])
            there = np.where(large[..., None], place + fading[..., None] * off, there)
        return np.concatenate([there, local[..., pose.QUATERNION]], axis=-1)

    def _fading_at(self, place: Array, off: Array, starts: Array, now: Array) -> Array:
        """Return the shares w (...) of offsets (..., 3) that are left at places + w·offset, nearest to ``now``.

        With l the place from the goal, o the offset and d the start's distance from the goal, ‖l + w·o‖ = w·d, which
        may have two solutions.
        """
        away, whole = place - self.goal, pose.norm(starts[..., pose.POSITION] - self.goal)
        along, squared = (away * off).sum(axis=-1), (away**2).sum(axis=-1)
        root = np.sqrt(np.maximum(along**2 + (whole**2 - (off**2).sum(axis=-1)) * squared, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            found = [np.where(squared > 0.0, squared / (sign * root - along), 0.0) for sign in (1.0, -1.0)]
        # At first all of the offset is left, wherever that still is farther than the start.
        found.append(np.where(pose.norm(away + off) >= whole, 1.0, np.nan))
        every = np.array(np.broadcast_arrays(*found))
        gap = np.where((every >= 0.0) & (every <= 1.0), np.abs(every - now), np.inf)
        nearest = np.take_along_axis(every, gap.argmin(axis=0)[None], axis=0)[0]
        return np.where(np.isfinite(gap).any(axis=0), nearest, 1.0)

    def onward(self, poses: Array, starts: Array) -> Array:
        """Return the starts (N, 7) that count from poses (N, 7) on, of paths from ``starts`` (N, 7)."""
        return starts if self.unfolding is None else self.unfolding.onward(poses, starts)

    def begun(self, poses: Array, *, hindsight: bool = False) -> Array:
        """Return the starts (N, 7) that count at the poses (N, 7) of one path; with ``hindsight``, of a whole one."""
        if self.unfolding is None:
            return np.repeat(poses[:1], len(poses), axis=0)
        return self.unfolding.begun(poses, hindsight=hindsight)

    def on_last_leg(self, starts: Array) -> np.ndarray:
        """Return whether the leg that began at each of ``starts`` (N, 7) ends at the goal, as booleans (N,)."""
        return np.ones(len(starts), dtype=bool) if self.unfolding is None else self.unfolding.on_last_leg(starts)

    def along(self, poses: Array) -> Array:
        """Return the poses (N, 7) of one path in the frame."""
        return self.to_frame(poses, poses[:1] if self.unfolding is None else self.begun(poses, hindsight=True))

    def laid(self, path: Array, start: Array) -> Array:
        """Return poses (N, 7) of a path of the frame where they lie, from a start (7,) on.

        What leads from floor to floor of an unfolded path is left out.
        """
        return self.from_frame(path, start[None], path) if self.unfolding is None else self.unfolding.laid(path)

    def between_floors(self, positions: Array) -> np.ndarray:
        """Return whether positions (N, 3) [m] of the frame lead from floor to floor of an unfolded path, as (N,)."""
        none = np.zeros(len(positions), dtype=bool)
        return none if self.unfolding is None else self.unfolding.between_floors(positions)

    def folded(self, positions: Array) -> Array:
        """Return positions (N, 3) [m] of the frame for pictures: where they lie, told as from the nominal start."""
        if self.unfolding is None:
            return positions
        return self.unfolding.from_frame(pose.make(positions, pose.IDENTITY[pose.QUATERNION]))[:, pose.POSITION]

    def each(self, trajectories: Sequence[Array]) -> list[Array]:
        """Return trajectories (N, 7), each in the frame by its own start, with what leads from one leg to the next."""
        unfolding = self.unfolding
        if unfolding is None:
            return [self.to_frame(rows, rows[:1]) for rows in trajectories]
        return [unfolding.whole(rows) for rows in trajectories]

    def each_unseen(self, trajectories: Sequence[Array]) -> list[Array]:
        """Return the trajectories (N, 7) that the frame was fitted to, each in the frame fitted to the others.

        What differs between them is so what differs from one that the frame has not seen (a jackknife).
        """
        if self.regression is None:
            return self.each(trajectories)
        placed = []
        for index, rows in enumerate(trajectories):
            frame = self.fitted([*trajectories[:index], *trajectories[index + 1 :]])
            placed.append(frame.to_frame(rows, rows[:1]))
        return placed

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the frame as arrays."""
        return {"start": self.start, "goal": self.goal, "follows": np.array(self.follows), **self.learned()}

    def learned(self) -> dict[str, np.ndarray]:
        """Return what was learned of the demonstrations, as arrays: the regression and the unfolding."""
        return {} if (held := self.regression or self.unfolding) is None else held.arrays()

    def described(self) -> dict[str, Any]:
        """Return start, goal and whether paths follow their start, as JSON values."""
        return {"start": self.start.tolist(), "goal": self.goal.tolist(), "follows": self.follows}

    @classmethod
    def restore(cls, held: Mapping[str, Any]) -> "StartFrame":
        """Return the frame with these :meth:`arrays`, or what is :meth:`described` with those :meth:`learned`."""
        start, goal = (np.array(held[name], dtype=float) for name in ("start", "goal"))
        return cls(start, goal, bool(held["follows"]), StartRegression.restore(held), Unfolding.restore(held))

    @classmethod
    def following(cls, trajectories: Sequence[Array], start: Array, goal: Array) -> "StartFrame":
        """Return the frame that follows starts as trajectories (N, 7) at the agent's step do.

        The nominal start and the goal, where all end, are poses (7,).
        """
        return cls(start[pose.POSITION], goal[pose.POSITION], follows=True).fitted(trajectories)

    @classmethod
    def chosen(cls, trajectories: Sequence[Array], start: Array, goal: Array) -> "StartFrame":
        """Return the frame in which the mean of the other trajectories is nearer to the one left out.

        It is that of :meth:`following`, which has the same arguments, or the identity; for a single demonstration the
        identity.
        """
        still = cls(start[pose.POSITION], goal[pose.POSITION], follows=False)
        if len(trajectories) == 1:
            return still
        moved = cls.following(trajectories, start, goal)
        gain = still._left_out_gap(trajectories) - moved._left_out_gap(trajectories)
        return moved if gain > _LEAST_GAIN_M else still

    def fitted(self, trajectories: Sequence[Array]) -> "StartFrame":
        """Return the frame with the regression of trajectories (N, 7); itself if it follows nothing."""
        if not self.follows:
            return self
        fading = replace(self, regression=None)
        starts = np.array([rows[0, pose.POSITION] for rows in trajectories])
        return replace(self, regression=StartRegression.fitted(starts, fading.each(trajectories)))

    def _left_out_gap(self, trajectories: Sequence[Array]) -> float:
        """Return the mean distance [m] of trajectories from the mean of the others, transformed to their start."""
        from scipy.spatial import cKDTree

        gaps = []
        for index, rows in enumerate(trajectories):
            others = [*trajectories[:index], *trajectories[index + 1 :]]
            frame = self.fitted(others)
            mean = mean_poses(frame.each(others), len(rows))
            path = frame.from_frame(mean, rows[:1], mean)
            gaps.append(cKDTree(path[:, pose.POSITION]).query(rows[:, pose.POSITION])[0].mean())
        return float(np.mean(gaps))

    def _off(self, starts: Array) -> Array:
        return np.asarray(starts[..., pose.POSITION] - self.start)

    def _fading(self, poses: Array, starts: Array) -> Array:
        """Return the share (..., 1) of the offset of starts (..., 7) that is left at poses (..., 3 or more)."""
        left = pose.norm(poses[..., pose.POSITION] - self.goal, keepdims=True)
        whole = pose.norm(starts[..., pose.POSITION] - self.goal, keepdims=True)
        return np.minimum(left / np.maximum(whole, 1e-9), 1.0)


STILL = StartFrame(np.zeros(3), np.zeros(3), follows=False)
"""The identity."""
