"""Moved goals: what was demonstrated moves with the goal, and everything is told as seen from it.

Seen from the goal nothing has changed but where the paths begin. Only the arm is in the world: what it can reach
depends on where the goal is, which nobody who sees from the goal can know. So a policy is trained with the flange
alone, and checked and evaluated with the arm.
"""

from dataclasses import dataclass, replace

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.demonstrated import CLEAR_OF_GOAL
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Motion, Reachability, Workcell


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

    All goals are moved by ``goal`` (3,) [m]; None draws them.

    Raises:
        BadInputError: hardly any start of the region can be taken.
    """
    starts, joints, redrawn = workcell.reachability.draw_starts(task.with_still_goal(), rng, count)
    moved = np.zeros((count, 3))
    if goal is not None:
        moved += goal
    elif task.goal_half_range_m is not None:
        half = np.array(task.goal_half_range_m)
        for row, start in enumerate(starts):
            moved[row] = rng.uniform(-half, half)
            while not _can_go(workcell, start, moved[row]):
                moved[row], redrawn = rng.uniform(-half, half), redrawn + 1
    starts = starts.copy()
    starts[:, pose.POSITION] -= moved
    return DrawnStarts(starts, joints, moved, redrawn)


def _can_go(workcell: Workcell, start: Array, moved: Array) -> bool:
    """Return whether the arm can take the goal moved by (3,) [m], and a start (7,) is not at it already."""
    goal = workcell.task.goal.copy()
    goal[pose.POSITION] += moved
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
