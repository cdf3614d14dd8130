"""The one goal of demonstrations that each end a little elsewhere."""

from collections.abc import Sequence

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.tasks.path import arc_lengths

# A demonstration is bent over ten times what its end is moved by, so that its direction changes by no more than
# some ten degrees; a short one over its later half.
_BENT = 10.0


def goal_of(items: Sequence[Demonstration]) -> Array:
    """Return the mean pose (7,) of the ends of demonstrations.

    The mean orientation is the largest eigenvector of Σ q qᵀ (Markley et al., Averaging quaternions, 2007).
    """
    ends = np.array([item.poses[-1] for item in items])
    quaternions = ends[:, pose.QUATERNION]
    _, vectors = np.linalg.eigh(quaternions.T @ quaternions)
    mean = vectors[:, -1]
    # Of its two signs that of the first end, so that nothing hangs on the eigenvector's.
    return pose.make(ends[:, pose.POSITION].mean(axis=0), mean * (1.0 if mean @ quaternions[0] >= 0 else -1.0))


def check_position(items: Sequence[Demonstration], goal: Array, most: float) -> float:
    """Return the largest distance [m] of an end from the goal (7,).

    Raises:
        BadInputError: it is more than ``most`` times the median way from start to end.
    """
    way = float(np.median([pose.position_distance(item.poses[0], item.poses[-1]) for item in items]))
    apart = [float(pose.position_distance(item.poses[-1], goal)) for item in items]
    worst = int(np.argmax(apart))
    if apart[worst] > most * way:
        raise BadInputError(
            f"demonstration {worst} must end within task.end_spread = {most:g} times the median way of {way:.3f} m of"
            f" the mean of all ends, found {apart[worst]:.3f} m: demonstrations of one task share their goal"
        )
    return apart[worst]


def check_orientation(items: Sequence[Demonstration], goal: Array, most: float) -> None:
    """Raise unless every end is turned from the goal (7,) by at most ``most`` [rad].

    Raises:
        BadInputError: one is turned more.
    """
    turned = [float(pose.rotation_distance(item.poses[-1], goal)) for item in items]
    worst = int(np.argmax(turned))
    if turned[worst] > most:
        raise BadInputError(
            f"demonstration {worst} must end within task.end_spread_rad = {most:g} rad of the mean orientation of all"
            f" ends, found {turned[worst]:.3f} rad; task.turning=free leaves orientation out"
        )


def to_goal(item: Demonstration, goal: Array) -> Demonstration:
    """Return a demonstration bent so that it ends at the goal (7,), without its joint angles.

    The later a pose, the more of the way from the demonstration's own end to the goal it is moved and turned: a
    smooth step over the last part of the path, which is ten times as long as that way or half the path.
    """
    offset = goal[pose.POSITION] - item.poses[-1, pose.POSITION]
    arc = arc_lengths(item.poses[:, pose.POSITION])
    length = max(min(_BENT * float(np.linalg.norm(offset)), 0.5 * arc[-1]), 1e-9)
    share = np.clip((arc - (arc[-1] - length)) / length, 0.0, 1.0)
    weight = share**2 * (3.0 - 2.0 * share)
    position = item.poses[:, pose.POSITION] + weight[:, None] * offset
    # A turn has no length on the path, so it is made up for over the later half.
    half = np.clip(2.0 * arc / max(arc[-1], 1e-9) - 1.0, 0.0, 1.0)
    turn = pose.to_rotation_vector(
        pose.multiply(goal[pose.QUATERNION], pose.conjugate(item.poses[-1, pose.QUATERNION]))
    )
    bend = pose.from_rotation_vector((half**2 * (3.0 - 2.0 * half))[:, None] * turn)
    poses = pose.make(position, pose.multiply(bend, item.poses[:, pose.QUATERNION]))
    # Exactly there, whatever rounding made of it.
    sign = 1.0 if poses[-1, pose.QUATERNION] @ goal[pose.QUATERNION] >= 0 else -1.0
    poses[-1] = pose.make(goal[pose.POSITION], sign * goal[pose.QUATERNION])
    return Demonstration(item.times, poses)
