"""The start frame: poses expressed as if every path had begun at the nominal start."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.paths import mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.start_regression import StartRegression

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
    (:class:`koopdqn.tasks.start_regression.StartRegression`) and subtracted too. Orientations stay: Table 1 turns
    toward the goal alone, whatever a start's orientation has been.

    Attributes:
        start: (3,) the nominal start [m].
        goal: (3,) where all paths end [m].
        follows: whether paths follow their start; if not, the frame is the identity.
        regression: of what else the start changes; None where that is not known.
    """

    start: Array
    goal: Array
    follows: bool
    regression: StartRegression | None = None

    def to_frame(self, poses: Array, starts: Array) -> Array:
        """Return poses (..., 7) of paths from ``starts`` (..., 7), in the frame."""
        if not self.follows:
            return poses
        place = poses[..., pose.POSITION] - self._fading(poses, starts) * self._off(starts)
        if self.regression is not None:
            place = self.regression.place(place, self.regression.offset(starts))
        return np.concatenate([place, poses[..., pose.QUATERNION]], axis=-1)

    def from_frame(self, local: Array, starts: Array, near: Array) -> Array:
        """Return the inverse of :meth:`to_frame` at ``local`` (..., 7), iterated from poses ``near`` (..., 7)."""
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

    def each(self, trajectories: Sequence[Array]) -> list[Array]:
        """Return trajectories (N, 7), each in the frame by its own start."""
        return [self.to_frame(rows, rows[:1]) for rows in trajectories]

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
        regression = {} if self.regression is None else self.regression.arrays()
        return {"start": self.start, "goal": self.goal, "follows": np.array(self.follows), **regression}

    def described(self) -> dict[str, Any]:
        """Return start, goal and whether paths follow their start, as JSON values."""
        return {"start": self.start.tolist(), "goal": self.goal.tolist(), "follows": self.follows}

    @classmethod
    def restore(cls, held: Mapping[str, Any]) -> "StartFrame":
        """Return the frame with these :meth:`arrays`, or what is :meth:`described` with its regression's."""
        start, goal = (np.array(held[name], dtype=float) for name in ("start", "goal"))
        return cls(start, goal, bool(held["follows"]), StartRegression.restore(held))

    @classmethod
    def following(cls, trajectories: Sequence[Array], start: Array, goal: Array) -> "StartFrame":
        """Return the frame that follows starts as trajectories do.

        Args:
            trajectories: demonstrated poses (N, 7) at the agent's step.
            start: the nominal start, a pose (7,).
            goal: where all end, a pose (7,).
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
