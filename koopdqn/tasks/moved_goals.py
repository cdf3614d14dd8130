"""Moved goals: what was demonstrated moves with the goal, and everything is told as seen from it.

Seen from the goal nothing has changed but where the paths begin. Only the arm is in the world: what it can reach
depends on where the goal is, which nobody who sees from the goal can know. So a policy is trained with the flange
alone, and checked and evaluated with the arm.
"""

from dataclasses import dataclass, replace

import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.tasks.demonstrated import CLEAR_OF_GOAL
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Motion, Reachability, Workcell

# Draws of a goal for a start before the start is drawn again, and before it is given up.
_DRAWS_A_START, _MOST_DRAWS = 20, 1000


@dataclass(frozen=True)
class DrawnStarts:
    """Starts of episodes.

    Attributes:
        starts: (N, 7) as seen from their goals.
        joints: (N, 6) [rad] there.
        moved: (N, 3) [m] by which the goals are moved; zeros unless the task's goal moves.
        redrawn: how many draws were drawn again.
    """

    starts: Array
    joints: Array
    moved: Array
    redrawn: int


def draw_starts(
    workcell: Workcell, task: Task, rng: np.random.Generator, count: int, goal: Array | None = None
) -> DrawnStarts:
    """Return ``count`` starts from a task's region, and by how much its goal is moved, if it moves.

    All goals are moved by ``goal`` (3,) [m]; None draws them. A start that lies at its goal is drawn again.

    Raises:
        BadInputError: the arm cannot take the given goal, or hardly any start of the region or any goal in its range.
    """
    still = task.with_still_goal()
    starts, joints, redrawn = workcell.reachability.draw_starts(still, rng, count)
    moved = np.zeros((count, 3)) if goal is None else np.tile(goal, (count, 1))
    half = None if goal is not None or task.goal_half_range_m is None else np.array(task.goal_half_range_m)
    if goal is not None:
        found = workcell.reachability.enter(_moved(workcell.task.goal, goal))
        if found.joints is None:
            raise BadInputError(f"goal: must be one that the arm can take, found {found.reason}: {found.detail}")
    for row in range(count if goal is not None or half is not None else 0):
        for tried in range(_MOST_DRAWS):
            if half is not None:
                moved[row] = rng.uniform(-half, half)
            if _can_go(workcell, starts[row], moved[row]):
                break
            redrawn += 1
            # Where no goal will do, the start is to blame.
            if half is None or tried % _DRAWS_A_START == _DRAWS_A_START - 1:
                (starts[row],), (joints[row],), refused = workcell.reachability.draw_starts(still, rng, 1)
                redrawn += refused
        else:
            raise BadInputError(
                f"task {task.name}: goals must lie where the arm can take them, clear of the start, found none in"
                f" {_MOST_DRAWS} draws"
            )
    starts = starts.copy()
    starts[:, pose.POSITION] -= moved
    return DrawnStarts(starts, joints, moved, redrawn)


def _moved(goal: Array, by: Array) -> Array:
    """Return a goal (7,) moved by (3,) [m]."""
    return np.asarray(goal + np.concatenate([by, np.zeros(4)]))


def _can_go(workcell: Workcell, start: Array, moved: Array) -> bool:
    """Return whether the arm can take the goal moved by (3,) [m], and a start (7,) is not at it already."""
    goal = _moved(workcell.task.goal, moved)
    clear = float(pose.position_distance(start, goal)) > CLEAR_OF_GOAL * workcell.task.goal_tolerance_m
    return (clear or workcell.task.unfolds) and workcell.reachability.enter(goal).joints is not None


class FlangeAlone(Reachability):
    """A flange without an arm: it can go anywhere, and the joints stay what they are."""

    def move(self, pose: Array, joints: Array) -> Motion:
        """Return the joints (6,) [rad] as they are."""
        return Motion(joints)

    def move_batch(self, poses: Array, joints: Array) -> list[Motion]:
        """Return the joints (N, 6) [rad] as they are."""
        return [Motion(row) for row in joints]

    def enter(self, pose: Array) -> Motion:
        """Return the posture."""
        return Motion(self.posture.copy())


def trained_in(workcell: Workcell) -> Workcell:
    """Return the workcell in which a policy is trained: with the flange alone where the task's goal moves."""
    if workcell.task.goal_half_range_m is None:
        return workcell
    with_arm = workcell.reachability
    alone = FlangeAlone(with_arm.arm, with_arm.scene, with_arm.posture)
    return replace(workcell, reachability=alone)
