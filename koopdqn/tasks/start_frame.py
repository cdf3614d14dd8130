"""The start frame: poses expressed as if every path had begun at the nominal start."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.paths import mean_poses
from koopdqn.pose import Array

# The frame must bring demonstrations nearer by more than this [m]; less is rounding.
_LEAST_GAIN_M = 1e-6
# Fixed-point iterations of the inverse; each shrinks the error by the start's offset as a share of the way.
_ITERATIONS = 12


@dataclass(frozen=True)
class StartFrame:
    """The frame in which paths from different starts begin at one start.

    Paths from different starts often keep their offset for much of the way. As with movement primitives, the start's
    offset is subtracted and fades toward the goal: position p becomes p − w·(start − nominal start) with
    w = min(1, ‖p − goal‖ / ‖start − goal‖). Orientations stay.

    Attributes:
        start: (3,) the nominal start [m].
        goal: (3,) where all paths end [m].
        follows: whether paths follow their start; if not, the frame is the identity.
    """

    start: Array
    goal: Array
    follows: bool

    def to_frame(self, poses: Array, starts: Array) -> Array:
        """Return poses (..., 7) of paths from ``starts`` (..., 7), in the frame."""
        return self._moved(poses, starts, poses, -1.0) if self.follows else poses

    def from_frame(self, local: Array, starts: Array, near: Array) -> Array:
        """Return the inverse of :meth:`to_frame` at ``local`` (..., 7), iterated from poses ``near`` (..., 7)."""
        if not self.follows:
            return local
        for _ in range(_ITERATIONS):
            near = self._moved(local, starts, near, 1.0)
        return near

    def each(self, trajectories: Sequence[Array]) -> list[Array]:
        """Return trajectories (N, 7), each in the frame by its own start."""
        return [self.to_frame(rows, rows[:1]) for rows in trajectories]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the frame as arrays."""
        return {"start": self.start, "goal": self.goal, "follows": np.array(self.follows)}

    def described(self) -> dict[str, Any]:
        """Return the frame as JSON values."""
        return {"start": self.start.tolist(), "goal": self.goal.tolist(), "follows": self.follows}

    @classmethod
    def restore(cls, held: dict[str, Any]) -> "StartFrame":
        """Return the frame with these :meth:`arrays` or :meth:`described` values."""
        return cls(np.array(held["start"], dtype=float), np.array(held["goal"], dtype=float), bool(held["follows"]))

    @classmethod
    def chosen(cls, trajectories: Sequence[Array], start: Array, goal: Array) -> "StartFrame":
        """Return the frame in which the mean of the other trajectories (N, 7) is nearer to the one left out.

        For a single demonstration it is the identity.

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
        """Return the mean distance [m] of trajectories from the mean of the others, transformed to their start."""
        from scipy.spatial import cKDTree

        local = self.each(trajectories)
        gaps = []
        for index, rows in enumerate(trajectories):
            mean = mean_poses(local[:index] + local[index + 1 :], len(rows))
            path = self.from_frame(mean, rows[:1], mean)
            gaps.append(cKDTree(path[:, pose.POSITION]).query(rows[:, pose.POSITION])[0].mean())
        return float(np.mean(gaps))

    def _moved(self, poses: Array, starts: Array, weighed: Array, sign: float) -> Array:
        """Return poses (..., 7) moved by the offset of starts (..., 7), weighted as at ``weighed`` (..., 7)."""
        left = pose.norm(weighed[..., pose.POSITION] - self.goal, keepdims=True)
        whole = pose.norm(starts[..., pose.POSITION] - self.goal, keepdims=True)
        offset = starts[..., pose.POSITION] - self.start
        position = poses[..., pose.POSITION] + sign * np.minimum(left / np.maximum(whole, 1e-9), 1.0) * offset
        return np.concatenate([position, poses[..., pose.QUATERNION]], axis=-1)


STILL = StartFrame(np.zeros(3), np.zeros(3), follows=False)
"""The identity."""
