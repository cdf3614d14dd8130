"""Poses told as if every path had begun at one start, where paths keep beside one another what their starts do."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.paths import mean_poses
from koopdqn.pose import Array

# Moving must bring demonstrations that much nearer [m]; less is rounding.
_LEAST_GAIN_M = 1e-6
# Of the fixed point that takes a placed pose back: its error shrinks by the share of the way that a start is off.
_ITERATIONS = 12


@dataclass(frozen=True)
class StartFrame:
    """Where poses of paths from different starts are, told as from one start.

    People who begin elsewhere keep beside each other's paths for much of the way. As movement primitives do, the
    offset of the start then fades on the way to the goal: a position p is told as p − w·(start − nominal start) with
    w = min(1, ‖p − goal‖ / ‖start − goal‖). Orientations stay as they are.

    Attributes:
        start: (3,) the nominal start [m].
        goal: (3,) where all paths end [m].
        follows: whether paths follow their start; if not, poses are told as they are.
    """

    start: Array
    goal: Array
    follows: bool

    def placed(self, poses: Array, starts: Array) -> Array:
        """Return poses (..., 7) of paths from ``starts`` (..., 7), told as from the nominal start."""
        return self._moved(poses, starts, poses, -1.0) if self.follows else poses

    def unplaced(self, placed: Array, starts: Array, near: Array) -> Array:
        """Return the poses (..., 7) near others that :meth:`placed` takes to ``placed`` (..., 7)."""
        if not self.follows:
            return placed
        for _ in range(_ITERATIONS):
            near = self._moved(placed, starts, near, 1.0)
        return near

    def each(self, trajectories: Sequence[Array]) -> list[Array]:
        """Return trajectories (N, 7), each placed by its own start."""
        return [self.placed(rows, rows[:1]) for rows in trajectories]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything held, as arrays."""
        return {"start": self.start, "goal": self.goal, "follows": np.array(self.follows)}

    def described(self) -> dict[str, Any]:
        """Return everything held, as JSON values."""
        return {"start": self.start.tolist(), "goal": self.goal.tolist(), "follows": self.follows}

    @classmethod
    def restore(cls, held: dict[str, Any]) -> "StartFrame":
        """Return the frame whose :meth:`arrays` or :meth:`described` these are."""
        return cls(np.array(held["start"], dtype=float), np.array(held["goal"], dtype=float), bool(held["follows"]))

    @classmethod
    def chosen(cls, trajectories: Sequence[Array], start: Array, goal: Array) -> "StartFrame":
        """Return the frame in which the mean of all trajectories (N, 7) but one is nearer to that one.

        Of a single demonstration nobody can tell, and paths stay where they are.

        Args:
            trajectories: demonstrated poses at the agent's step.
            start: the nominal start, a pose (7,).
            goal: where all end, a pose (7,).
        """
        places = start[pose.POSITION], goal[pose.POSITION]
        still, moved = cls(*places, follows=False), cls(*places, follows=True)
        if len(trajectories) == 1:
            return still
        gain = still._left_out_gap(trajectories) - moved._left_out_gap(trajectories)
        return moved if gain > _LEAST_GAIN_M else still

    def _left_out_gap(self, trajectories: Sequence[Array]) -> float:
        """Return the mean distance [m] of trajectories from the mean of the others, moved to their start."""
        from scipy.spatial import cKDTree

        placed = self.each(trajectories)
        gaps = []
        for index, rows in enumerate(trajectories):
            mean = mean_poses(placed[:index] + placed[index + 1 :], len(rows))
            path = self.unplaced(mean, rows[:1], mean)
            gaps.append(cKDTree(path[:, pose.POSITION]).query(rows[:, pose.POSITION])[0].mean())
        return float(np.mean(gaps))

    def _moved(self, poses: Array, starts: Array, weighed: Array, sign: float) -> Array:
        """Return poses (..., 7) moved by what starts (..., 7) are off, as far as it counts at ``weighed`` (..., 7)."""
        left = pose.norm(weighed[..., pose.POSITION] - self.goal, keepdims=True)
        whole = pose.norm(starts[..., pose.POSITION] - self.goal, keepdims=True)
        offset = starts[..., pose.POSITION] - self.start
        position = poses[..., pose.POSITION] + sign * np.minimum(left / np.maximum(whole, 1e-9), 1.0) * offset
        return np.concatenate([position, poses[..., pose.QUATERNION]], axis=-1)


STILL = StartFrame(np.zeros(3), np.zeros(3), follows=False)
"""The frame that tells every pose as it is."""
