"""What demonstrations do with orientation: hold it, turn along the geodesic to the goal, or neither."""

from collections.abc import Sequence

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.demonstrated import Turning

LEAST_TURN_RAD = 0.2
"""A smaller turn from start to goal is none that a person means [rad]."""
STRAY = 0.25
"""How far, as a share of its own turn, a demonstration may stray from the geodesic, or turn back."""


def turning_of(trajectories: Sequence[Array], goal: Array, held_limit: float) -> Turning:
    """Return what pose trajectories (N, 7) do with orientation on their way to the goal (7,).

    Held: no pose is turned from the goal by more than ``held_limit`` [rad]. Geodesic: each trajectory begins at
    least :data:`LEAST_TURN_RAD` from the goal's orientation, and strays from the geodesic and turns back by at most
    :data:`STRAY` of that. Free: anything else.
    """
    if all(pose.rotation_distance(trajectory, goal).max() <= held_limit for trajectory in trajectories):
        return "held"
    return "geodesic" if all(_along_geodesic(trajectory, goal) for trajectory in trajectories) else "free"


def largest_turn_from(trajectories: Sequence[Array], goal: Array) -> float:
    """Return the largest angle [rad] by which a pose of the trajectories (N, 7) is turned from the goal (7,)."""
    return max(float(pose.rotation_distance(trajectory, goal).max()) for trajectory in trajectories)


def _along_geodesic(trajectory: Array, goal: Array) -> bool:
    turn = pose.to_rotation_vector(pose.multiply(pose.conjugate(goal[pose.QUATERNION]), trajectory[:, pose.QUATERNION]))
    total = float(np.linalg.norm(turn[0]))
    if total < LEAST_TURN_RAD:
        return False
    along = turn @ (turn[0] / total)
    aside = np.linalg.norm(turn - along[:, None] * turn[0] / total, axis=1)
    back = along - np.minimum.accumulate(along)
    return bool(max(aside.max(), back.max()) <= STRAY * total)
