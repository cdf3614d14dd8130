"""The environment as dm_env knows it: one episode, one action at a time."""

from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.base import Oracle, Question
from koopdqn.rl.network import observe, size
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.workcell import Workcell


class KoopmanEnvironment(dm_env.Environment):  # type: ignore[misc]  # dm_env is untyped
    """Algorithm 1's environment: rewards from the intent model where trusted, from the oracle elsewhere.

    A wrong action is rewarded negatively and undone: the next observation is that of the pose before it, and
    the agent can try another. An action that the arm cannot take counts as wrong without asking. An episode
    ends with discount 0 at the goal, and with discount 1 when it is cut at its step limit.
    """

    def __init__(self, workcell: Workcell, reward: IntentReward, oracle: Oracle, step_limit: int, seed: int) -> None:
        """Make the environment.

        Args:
            workcell: task, arm and scene.
            reward: the task's reward function.
            oracle: who answers where the intent model is not trusted.
            step_limit: tries after which an episode is cut.
            seed: of the starts.
        """
        self._workcell = workcell
        self._reward = reward
        self._oracle = oracle
        self._step_limit = step_limit
        self._rng = np.random.default_rng([seed, 5])
        self._pose = self._start = workcell.task.nominal_start
        self._joints = np.array(workcell.arm.home)
        self._episode = -1
        self._step = 0
        self._tries = 0
        self._running = False

    @property
    def pose(self) -> np.ndarray:
        """The flange's present pose (7,)."""
        return np.array(self._pose)

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode somewhere in the start region."""
        poses, joints, _ = self._workcell.reachability.draw_starts(self._workcell.task, self._rng, 1)
        self._pose = self._start = poses[0]
        self._joints = joints[0]
        self._episode += 1
        self._step = self._tries = 0
        self._running = True
        return dm_env.restart(self._observation())

    def step(self, action: Any) -> dm_env.TimeStep:
        """Try an action (an index in Table 1, from 0).

        Raises:
            ValueError: the action is none of the ten.
        """
        if not self._running:
            return self.reset()
        index = int(action)
        if not 0 <= index < COUNT:
            raise ValueError(f"action must be from 0 to {COUNT - 1}, found {index}")
        reward, reached, joints, at_goal = self._try(index)
        self._tries += 1
        if reward >= 0 and joints is not None:
            self._pose, self._joints = reached, joints
            self._step += 1
            if at_goal:
                self._running = False
                return dm_env.termination(reward, self._observation())
        if self._tries >= self._step_limit:
            self._running = False
            return dm_env.truncation(reward, self._observation())
        return dm_env.transition(reward, self._observation())

    def observation_spec(self) -> specs.Array:
        """Return the observation's shape: (5,) with orientation held, (8,) otherwise."""
        return specs.Array((size(self._workcell.task),), np.float32, name="observation")

    def action_spec(self) -> specs.DiscreteArray:
        """Return the ten actions."""
        return specs.DiscreteArray(COUNT, name="action")

    def close(self) -> None:
        """Close the oracle."""
        self._oracle.close()

    def _observation(self) -> np.ndarray:
        return np.array(
            observe(self._reward.model.start_frame.placed(self._pose[None], self._start[None]), self._workcell.task)[0]
        )

    def _try(self, action: int) -> tuple[float, np.ndarray, np.ndarray | None, bool]:
        judgement = self._reward.judge(self._pose[None], np.array([self._step]), self._start[None])
        reached = judgement.reached[0, action]
        at_goal = bool(judgement.at_goal[0, action])
        motion = self._workcell.reachability.move(reached, self._joints)
        if motion.joints is None:
            return self._reward.value(False, False), reached, None, at_goal
        if judgement.known[0, action]:
            return float(judgement.reward[0, action]), reached, motion.joints, at_goal
        trust = self._reward.trust
        placed = judgement.placed_reached[0, action]
        reason = trust.outside(placed, self._step + 1) or trust.outside(judgement.placed[0], self._step)
        places = self._pose.copy(), self._start.copy()
        question = Question(self._episode, self._step, *places, action, reached.copy(), judgement.predicted[0], reason)
        answer = self._oracle.answer(question)
        if answer.right is None:
            # A skip is not a no, but nothing moves either.
            return 0.0, reached, None, False
        return self._reward.value(answer.right, at_goal), reached, motion.joints, at_goal
