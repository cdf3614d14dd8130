"""What demonstrations do with orientation: hold it, or turn on the way to the goal."""

from collections.abc import Sequence

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.demonstrated import Turning


def turning_of(trajectories: Sequence[Array], goal: Array, held_limit: float) -> Turning:
    """Return what pose trajectories (N, 7) do with orientation on their way to the goal (7,).

    Held: no pose is turned from the goal by more than ``held_limit`` [rad]. Geodesic: anything else. People turn a
    little off the geodesic; of their turn the part toward the goal is what Table 1 can follow.
    """
    return "held" if largest_turn_from(trajectories, goal) <= held_limit else "geodesic"


def largest_turn_from(trajectories: Sequence[Array], goal: Array) -> float:
    """Return the largest angle [rad] by which a pose of the trajectories (N, 7) is turned from the goal (7,)."""
    return max(float(pose.rotation_distance(trajectory, goal).max()) for trajectory in trajectories)
