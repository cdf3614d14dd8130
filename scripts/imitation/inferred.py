"""What imitating begins with, the actions that demonstrated poses stand for, and what it ends with."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from koopdqn import pose
from koopdqn.intent.reward import NO_ANSWER, RULE
from koopdqn.pose import Array
from koopdqn.rl.network import observe
from koopdqn.rl.policy import Policy
from koopdqn.rl.replay_buffer import Transitions
from koopdqn.tasks.actions import nearest_actions
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.step import IN_PLACE, one_step
from koopdqn.tasks.task import Task


@dataclass(frozen=True)
class Imitator:
    """A policy learned without intent model and reward.

    Attributes:
        policy: the argmax of its network.
        updates: updates of the network.
        env_steps: actions tried in the environment.
        questions: labels that an expert was asked for.
    """

    policy: Policy
    updates: int
    env_steps: int = 0
    questions: int = 0


class BestOf:
    """Keeps, of policies that are checked on the way, the latest of those with most successes.

    The default's training takes of these the nearest to its intent, which others lack.

    Attributes:
        policy: that one; None before the first check.
    """

    def __init__(self, check: Callable[[Policy], float]) -> None:
        """Begin without a policy; ``check`` says how good one is."""
        self.policy: Policy | None = None
        self._check, self._score = check, -np.inf

    def offer(self, policy: Policy) -> Policy:
        """Check a policy as it is now, and return the best so far."""
        policy = replace(policy, network=deepcopy(policy.network))
        found = self._check(policy)
        if self.policy is None or found >= self._score:
            self.policy, self._score = policy, found
        return self.policy


def labels(before: Array, wished: Array, task: Task) -> np.ndarray:
    """Return the actions (M,) of Table 1 that the way from poses (M, 7) to wished ones (M, 7) stands for.

    They are the nearest as greedy and the reward measure it: to the wished pose scaled to what an action can do, since
    Table 1 turns in place or on its way to the goal and no other way (D4).
    """
    if task.orientation == "learned":
        room = pose.position_distance(before, task.goal)
        turn = IN_PLACE * task.rotation_tolerance_rad
        wished = one_step(before, wished, task.goal, room, task.step_m, turn)
    return nearest_actions(before, wished, task)


def demonstrated_steps(trajectories: list[Array], task: Task) -> tuple[Array, Array, Array, np.ndarray]:
    """Return every demonstrated step: poses (M, 7) before and after, the demonstration's first (M, 7), number (M,).

    A demonstration ends at its first pose that counts as the goal, or else at its last.

    Args:
        trajectories: demonstrated poses (N, 7) at the agent's step, each of at least two.
        task: gives the goal.
    """
    ended = [trajectory[: _end(trajectory, task) + 1] for trajectory in trajectories]
    before = np.concatenate([trajectory[:-1] for trajectory in ended])
    after = np.concatenate([trajectory[1:] for trajectory in ended])
    starts = np.concatenate([np.repeat(trajectory[:1], len(trajectory) - 1, axis=0) for trajectory in ended])
    return before, after, starts, np.concatenate([np.arange(len(trajectory) - 1) for trajectory in ended])


def demonstrated_transitions(trajectories: list[Array], task: Task, frame: StartFrame = STILL) -> Transitions:
    """Return every demonstrated step as a transition with its nearest action and reward 0.

    The last of a demonstration (:func:`demonstrated_steps`) is terminated.

    Args:
        trajectories: demonstrated poses (N, 7) at the agent's step, each of at least two.
        task: gives actions, tolerances and goal.
        frame: in which poses are observed.
    """
    before, after, starts, steps = demonstrated_steps(trajectories, task)
    count = len(before)
    return Transitions(
        observations=observe(frame.to_frame(before, starts), task),
        actions=labels(before, after, task),
        rewards=np.zeros(count, dtype=np.float32),
        next_observations=observe(frame.to_frame(after, starts), task),
        # The next step is the first of another demonstration, or there is none.
        terminated=np.append(steps[1:] == 0, True),
        truncated=np.zeros(count, dtype=bool),
        undone=np.zeros(count, dtype=bool),
        poses=before,
        starts=starts,
        steps=steps,
        sources=np.full(count, RULE),
        answers=np.full(count, NO_ANSWER),
    )


def _end(trajectory: Array, task: Task) -> int:
    """Return the index of a trajectory's first pose after its start that counts as the goal, or else of its last."""
    reached = np.flatnonzero(task.arrived(trajectory[1:], task.begun(trajectory, hindsight=True)[:-1]))
    return int(reached[0]) + 1 if len(reached) else len(trajectory) - 1
