"""One step of the agent toward a wished pose, with motion and turn scaled to what its actions can do."""

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array

IN_PLACE = 2.0
"""Rotation tolerances by which one action of Table 1 turns in place."""

TURNS_PER_STEP = 5.0
"""Rotation tolerances up to which one action matches a turn; a continuous one turns by as much."""

# Shares of a turn in place: the turn that needs no action, and the most that an action toward the goal matches. A
# little less than the tolerance allows (0.5 and 2.5), so that rounding makes no right action wrong.
_LITTLE, _ON_THE_WAY = 0.45, 2.4
# Cosine of 30°: within this angle of the goal's direction an action that moves and turns to the goal is close enough.
_TOWARD = 0.866


def one_step(poses: Array, wished: Array, goal: Array, room: Array, step: float, turn: float) -> Array:
    """Return the poses (N, 7) one step from poses (N, 7) toward wished ones (N, 7), at most as far as there is room.

    A step is ``step`` [m] far, or turns by ``turn`` [rad] in place; ``room`` (N,) [m] is what is left up to the goal
    (7,). Table 1 turns along the geodesic to the goal only, so only that part ω [rad] of the wished turn counts. With a
    small turn, or a motion toward the goal, the motion is a full step. Otherwise Table 1 turns in place only: motion v
    [m] and turn are scaled to (v/step)² + (ω/turn)² = 1, so that a larger turn means a shorter motion.
    """
    quaternion, toward = poses[:, pose.QUATERNION], goal[pose.QUATERNION]
    motion = wished[:, pose.POSITION] - poses[:, pose.POSITION]
    length = pose.norm(motion)
    to_goal = _turn_between(quaternion, toward)
    left = pose.norm(to_goal)
    angle = (_turn_between(quaternion, wished[:, pose.QUATERNION]) * to_goal).sum(axis=1) / np.maximum(left, 1e-12)
    angle = angle.clip(0.0, left)
    way = goal[pose.POSITION] - poses[:, pose.POSITION]
    direction = motion / np.maximum(length, 1e-12)[:, None]
    distance = pose.norm(way)
    toward_goal = (direction * way).sum(axis=1) >= _TOWARD * distance
    whole = (length > 0) & (toward_goal | (angle <= _LITTLE * turn))
    size = np.where(whole, length / step, np.hypot(length / step, angle / turn))
    size = np.maximum(size, 1e-12)
    angle = np.where(whole, np.minimum(angle, _ON_THE_WAY * turn) * size, angle)
    moved = np.minimum(length / size, room)
    position = poses[:, pose.POSITION] + moved[:, None] * direction
    turned = pose.turned_toward(quaternion, toward, np.minimum(angle / size, left))
    # Of q and −q the nearer, or paths made of such steps could not be interpolated.
    return pose.make(position, pose.signed_as(turned, quaternion))


def full_step(poses: Array, wished: Array, room: Array, step: float, turn: float) -> Array:
    """Return the poses (N, 7) one step from poses (N, 7) toward wished ones (N, 7), turned as these are.

    What a continuous action can do: the motion is a full step, at most as far as there is room, and the turn about any
    axis. Where that is larger than an action's largest, both are shortened alike. Arguments as of :func:`one_step`.
    """
    quaternion = poses[:, pose.QUATERNION]
    motion = wished[:, pose.POSITION] - poses[:, pose.POSITION]
    direction = motion / np.maximum(pose.norm(motion), 1e-12)[:, None]
    left = pose.rotation_distance(poses, wished)
    share = 1.0 / np.maximum(left / (TURNS_PER_STEP / IN_PLACE * turn), 1.0)
    moved = share * np.minimum(step, room)
    turned = pose.turned_toward(quaternion, wished[:, pose.QUATERNION], share * left)
    turned = pose.signed_as(turned, quaternion)
    return pose.make(poses[:, pose.POSITION] + moved[:, None] * direction, turned)


def _turn_between(quaternions: Array, others: Array) -> Array:
    """Return the rotation vectors (N, 3) [rad] from quaternions (N, 4) to others (N, 4) or (4,)."""
    return pose.to_rotation_vector(pose.multiply(pose.conjugate(quaternions), others))
