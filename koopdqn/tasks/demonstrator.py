"""The demonstrator: a state-feedback law that says where a person would go next from any pose."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.path import SmoothPath


@dataclass(frozen=True)
class Demonstrator:
    """Pursues a point that runs ahead on a path, so that offsets die out over the look-ahead distance.

    From position p the nearest point of the path is found, the point ``pull_back`` further along it is
    aimed at, and one step is made straight to it: for small offsets this contracts sideways like
    exp(−distance travelled / pull_back), and it comes to rest at the path's end. The law knows the task
    only; it knows nothing of the Koopman model.

    Attributes:
        path: where the person would pass.
        goal: pose (7,) at the end.
        step: distance of one step [m].
        pull_back: look-ahead distance [m].
    """

    path: SmoothPath
    goal: Array
    step: float
    pull_back: float

    def aim(self, poses: Array) -> Array:
        """Return the position (N, 3) [m] that the person looks at from poses (N, 7)."""
        position = poses[:, pose.POSITION]
        return self.path.at(self.path.nearest(position) + self.pull_back)

    def next_pose(self, poses: Array) -> Array:
        """Return where the person would be after one step from poses (N, 7), orientation held at the goal's."""
        aim = self.aim(poses)
        remaining = np.linalg.norm(self.goal[pose.POSITION] - poses[:, pose.POSITION], axis=1)
        position = pose.moved_toward(poses[:, pose.POSITION], aim, np.minimum(self.step, remaining))
        turned = pose.turned_toward(poses[:, pose.QUATERNION], self.goal[pose.QUATERNION], np.full(len(poses), np.inf))
        return pose.make(position, turned)

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) of the law from a start (7,) until the goal, at most ``limit`` steps."""
        poses = [start]
        for _ in range(limit):
            reached = self.next_pose(poses[-1][None])[0]
            poses.append(reached)
            if np.linalg.norm(reached[pose.POSITION] - self.goal[pose.POSITION]) < 1e-6:
                break
        return np.array(poses)
