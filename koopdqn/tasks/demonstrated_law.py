"""The law of a task made from demonstrations: along their mean, as it was shown."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.resample import mean_poses, to_count
from koopdqn.pose import Array
from koopdqn.tasks import law
from koopdqn.tasks.path import SmoothPath
from koopdqn.tasks.step import one_step

if TYPE_CHECKING:
    from scipy.spatial import KDTree

# Of places about as near, to this share of a step, the latest is taken.
_AS_NEAR = 0.25


@dataclass(frozen=True)
class DemonstratedLaw:
    """Pursues a point that runs ahead on the mean of the demonstrations, and turns as that does there.

    It stands in for the person who demonstrated and knows nothing of the Koopman model: of what demonstrations alone
    tell, the mean of them, moved to the start, was found to be nearest to those left out. The nearest place on it is
    found, of places about as near the last: the law knows no past, and where a path crosses itself that choice makes
    it end. The point ``pull_back`` further along is aimed at.

    Attributes:
        path: the mean's positions.
        quaternions: (P, 4) the mean's orientations at the path's points.
        goal: pose (7,) at which every demonstration ends.
        step: distance of one step [m].
        pull_back: look-ahead distance [m].
        turn: turn of one step in place [rad]; 0 where the goal's orientation is held.
    """

    path: SmoothPath
    quaternions: Array
    goal: Array
    step: float
    pull_back: float
    turn: float

    @classmethod
    def of(
        cls, trajectories: Sequence[Array], goal: Array, step: float, pull_back: float, turn: float
    ) -> "DemonstratedLaw":
        """Return the law of pose trajectories (N, 7), at least one, which all end at the goal.

        Args:
            trajectories: at the agent's step.
            goal: pose (7,).
            step: distance of one step [m].
            pull_back: look-ahead distance [m].
            turn: turn of one step in place [rad]; 0 holds the goal's orientation.
        """
        mean = mean_poses(list(trajectories), max(len(rows) for rows in trajectories))
        path = SmoothPath.along(mean[:, pose.POSITION])
        return cls(path, to_count(mean, len(path.points))[:, pose.QUATERNION], goal, step, pull_back, turn)

    def next_pose(self, poses: Array) -> Array:
        """Return where the person would be after one step from poses (N, 7)."""
        position = poses[:, pose.POSITION]
        arc = self._nearest(position)
        aim = self.path.at(arc + self.pull_back)
        remaining = pose.position_distance(poses, self.goal)
        moved = pose.moved_toward(position, aim, np.minimum(self.step, remaining))
        if not self.turn:
            return pose.make(moved, np.tile(self.goal[pose.QUATERNION], (len(poses), 1)))
        index = np.rint((arc + self.step) / self.path.spacing).astype(int)
        wished = pose.make(moved, self.quaternions[np.minimum(index, len(self.quaternions) - 1)])
        return one_step(poses, wished, self.goal, self.step, self.turn)

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) of the law from a start (7,) until the goal, at most ``limit`` steps."""
        return law.roll_out(self, start, limit)

    def _nearest(self, positions: Array) -> Array:
        """Return the arc length (N,) [m] of the place that each position (N, 3) goes on from."""
        distance, _ = self._tree.query(positions)
        near = self._tree.query_ball_point(positions, distance + _AS_NEAR * self.step)
        return np.array([max(places) for places in near]) * self.path.spacing

    @cached_property
    def _tree(self) -> "KDTree":
        from scipy.spatial import KDTree

        return KDTree(self.path.points)
