"""Predictions of a person's next pose that fit nothing: what K is replaced by, to show what K adds."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.resample import mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.shown_path import ShownPath
from koopdqn.tasks.step import IN_PLACE
from koopdqn.tasks.task import Task

if TYPE_CHECKING:
    from scipy.spatial import KDTree

NextPose = Callable[[Array], Array]
"""Gives the next poses (N, 7) of poses (N, 7), both told in the intent's start frame."""


@dataclass(frozen=True)
class NearestVelocity:
    """Moves as the nearest demonstrated pose moved: the same displacement, and the same turn in the tool's own frame.

    Nearest is by position in steps of the agent and by orientation in its turns in place, added as squares. Nothing
    leads back to the demonstrations. Where a demonstration's last pose is nearest, which has no velocity, the goal is
    next.

    Attributes:
        before: (M, 7) demonstrated poses but the last ones.
        after: (M, 7) those that follow them.
        last: (D, 7) the last pose of each demonstration.
        task: gives goal, step and turn.
    """

    before: Array
    after: Array
    last: Array
    task: Task

    @classmethod
    def of(cls, trajectories: list[Array], task: Task) -> "NearestVelocity":
        """Return the prediction from demonstrated poses (N, 7) at the agent's step, told in the start frame."""
        before = np.concatenate([rows[:-1] for rows in trajectories])
        after = np.concatenate([rows[1:] for rows in trajectories])
        return cls(before, after, np.array([rows[-1] for rows in trajectories]), task)

    def __call__(self, poses: Array) -> Array:
        """Return the next poses (N, 7) of poses (N, 7)."""
        count = len(self.before) + len(self.last)
        nearest = self._tree.query(self._coordinates(poses))[1] % count
        moving = np.minimum(nearest, len(self.before) - 1)
        here, there = self.before[moving], self.after[moving]
        turn = pose.multiply(pose.conjugate(here[:, pose.QUATERNION]), there[:, pose.QUATERNION])
        onward = pose.make(
            poses[:, pose.POSITION] + there[:, pose.POSITION] - here[:, pose.POSITION],
            pose.multiply(poses[:, pose.QUATERNION], turn),
        )
        return np.where((nearest < len(self.before))[:, None], onward, self.task.goal)

    @cached_property
    def _tree(self) -> "KDTree":
        from scipy.spatial import KDTree

        known = np.concatenate([self.before, self.last])
        # q and −q are the same rotation.
        opposite = pose.make(known[:, pose.POSITION], -known[:, pose.QUATERNION])
        return KDTree(self._coordinates(np.concatenate([known, opposite])))

    def _coordinates(self, poses: Array) -> Array:
        # Twice the distance of two unit quaternions is the angle between them, to 3 % up to a right angle.
        scale = 2.0 / (IN_PLACE * self.task.rotation_tolerance_rad)
        return np.concatenate([poses[:, pose.POSITION] / self.task.step_m, scale * poses[:, pose.QUATERNION]], axis=1)


@dataclass(frozen=True)
class MeanTangent:
    """Moves along the mean demonstration's direction at its nearest place and turns as that is turned a step further.

    Nearest is by position. Nothing leads back to the mean: from beside it the way runs beside it. Where its end is
    nearest, it has no direction left, and the goal is next.

    Attributes:
        mean: the mean demonstration.
        task: gives goal and step.
    """

    mean: ShownPath
    task: Task

    @classmethod
    def of(cls, trajectories: list[Array], task: Task) -> "MeanTangent":
        """Return the prediction from demonstrated poses (N, 7) at the agent's step, told in the start frame."""
        return cls(ShownPath.along(mean_poses(trajectories, max(len(rows) for rows in trajectories))), task)

    def __call__(self, poses: Array) -> Array:
        """Return the next poses (N, 7) of poses (N, 7)."""
        places = self.mean.places
        position, last = poses[:, pose.POSITION], len(places.points) - 1
        nearest = self._tree.query(position)[1]
        direction = places.points[np.minimum(nearest + 1, last)] - places.points[nearest]
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        # Of a turn in place the path has no length.
        ahead = np.minimum(nearest + round(self.task.step_m / max(places.spacing, 1e-6)), last)
        onward = pose.make(position + self.task.step_m * direction, self.mean.quaternions[ahead])
        return np.where((nearest < last)[:, None], onward, self.task.goal)

    @cached_property
    def _tree(self) -> "KDTree":
        from scipy.spatial import KDTree

        return KDTree(self.mean.places.points)
