"""Letting a controller move the arm from given starts until each episode ends, with nothing undone."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.environment.actions import reached_poses
from koopdqn.environment.reachability import REASONS, Reachability
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

SUCCESS: Final = "success"
STEP_LIMIT: Final = "step_limit"
STUCK: Final = "stuck"
RULE_BROKEN: Final = "rule_broken"
FAILURES: Final = (*REASONS, RULE_BROKEN, STUCK, STEP_LIMIT)
"""Causes by which an episode can fail."""

Controller = Callable[[Array, Array], np.ndarray]
"""Chooses the actions (N,) from poses (N, 7) of episodes that began at starts (N, 7)."""


@dataclass(frozen=True)
class Episode:
    """One finished episode.

    Attributes:
        poses: (T + 1, 7) poses passed, the start first.
        joints: (T + 1, 6) joint angles [rad].
        outcome: :data:`SUCCESS` or one of :data:`FAILURES`.
        detail: more about a failure, for people.
    """

    poses: Array
    joints: Array
    outcome: str
    detail: str = ""

    @property
    def steps(self) -> int:
        """Number of steps made."""
        return len(self.poses) - 1


def roll_out(
    controller: Controller, task: Task, reachability: Reachability, starts: Array, joints: Array, limit: int
) -> list[Episode]:
    """Return the episodes of a controller from starts (N, 7) with joints (N, 6), at most ``limit`` steps each.

    An action that the arm cannot take ends its episode as a failure. So does one that leaves the pose
    unchanged: a controller without memory would choose it for ever.
    """
    runs = [_Run([start], [angles]) for start, angles in zip(starts, joints, strict=True)]
    active = list(range(len(runs)))
    for _ in range(limit):
        if not active:
            break
        poses = np.array([runs[i].poses[-1] for i in active])
        actions = controller(poses, starts[active])
        reached = reached_poses(poses, task)[np.arange(len(active)), actions]
        broken = task.rule_broken(reached)
        at_goal = task.reached(reached)
        for row, i in enumerate(active):
            runs[i].step(reached[row], reachability, bool(broken[row]), bool(at_goal[row]))
        active = [i for i in active if not runs[i].outcome]
    return [run.finished() for run in runs]


def follow(paths: list[Array], task: Task, reachability: Reachability, joints: Array) -> list[Episode]:
    """Return the episodes of following given paths (T, 7), each begun with its joints (6,), to end or failure."""
    runs = []
    for path, angles in zip(paths, joints, strict=True):
        run = _Run([path[0]], [angles])
        broken, at_goal = task.rule_broken(path), task.reached(path)
        for t in range(1, len(path)):
            run.step(path[t], reachability, bool(broken[t]), bool(at_goal[t]))
            if run.outcome:
                break
        runs.append(run)
    return [run.finished() for run in runs]


@dataclass
class _Run:
    poses: list[Array]
    joints: list[Array]
    outcome: str = ""
    detail: str = ""

    def step(self, reached: Array, reachability: Reachability, rule_broken: bool, at_goal: bool) -> None:
        motion = reachability.move(reached, self.joints[-1])
        if motion.joints is None:
            self.outcome, self.detail = motion.reason, motion.detail
            return
        stuck = not pose.position_distance(reached, self.poses[-1]) and not pose.rotation_distance(
            reached, self.poses[-1]
        )
        self.poses.append(reached)
        self.joints.append(motion.joints)
        if rule_broken:
            self.outcome = RULE_BROKEN
        elif at_goal:
            self.outcome = SUCCESS
        elif stuck:
            self.outcome = STUCK

    def finished(self) -> Episode:
        return Episode(np.array(self.poses), np.array(self.joints), self.outcome or STEP_LIMIT, self.detail)
