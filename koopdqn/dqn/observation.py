"""What the agent observes (Appendix 7.1): its pose and the two distances to the goal."""

import numpy as np
from numpy.typing import NDArray

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.task import Task


def size(task: Task) -> int:
    """Return the number of observed values: 5 with orientation held, 8 otherwise."""
    return 5 if task.orientation == "held" else 8


def observe(poses: Array, task: Task) -> NDArray[np.float32]:
    """Return observations (N, 5) or (N, 8) of poses (N, 7), told as from the task's nominal start.

    Position [m], with orientation learned also the rotation vector from the goal's orientation [rad], then
    the distances to the goal in position [m] and rotation [rad].
    """
    columns = [poses[:, pose.POSITION]]
    if task.orientation == "learned":
        columns.append(
            pose.to_rotation_vector(
                pose.multiply(poses[:, pose.QUATERNION], pose.conjugate(task.goal[pose.QUATERNION]))
            )
        )
    columns.append(pose.position_distance(poses, task.goal)[:, None])
    columns.append(pose.rotation_distance(poses, task.goal)[:, None])
    return np.concatenate(columns, axis=1).astype(np.float32)
