"""The environment as dm_env knows it: one episode, one action at a time."""

from typing import Any

import dm_env
import numpy as np
from dm_env import specs

from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.base import Oracle
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.network import observe, size
from koopdqn.rl.starts import StartSampler
from koopdqn.rl.vector_env import VectorEnv
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.workcell import Workcell

ANSWERS_ALONE = FeedbackSettings(remember_m=0.0, remember_rad=0.05, extend=False, reach_m=0.07)
"""An answer is the reward of the action asked about and nothing more."""


class KoopmanEnvironment(dm_env.Environment):  # type: ignore[misc]  # dm_env is untyped
    """Algorithm 1's environment: rewards from the intent model where trusted, from the oracle elsewhere.

    A wrong action is rewarded negatively and undone: the next observation is that of the pose before it, and
    the agent can try another. An action that the arm cannot take counts as wrong without asking. An episode
    ends with discount 0 at the goal, and with discount 1 when it is cut at its step limit. It is one episode of
    :class:`~koopdqn.rl.vector_env.VectorEnv`, which training uses.
    """

    def __init__(
        self,
        workcell: Workcell,
        reward: IntentReward,
        oracle: Oracle,
        step_limit: int,
        seed: int,
        feedback: FeedbackSettings = ANSWERS_ALONE,
    ) -> None:
        """Make the environment.

        Args:
            workcell: task, arm and scene.
            reward: the task's reward function.
            oracle: who answers where the intent model is not trusted.
            step_limit: actions tried after which an episode is cut.
            seed: of the starts.
            feedback: what is made of answers beyond the reward of the action asked about.
        """
        starts = StartSampler(workcell, reward.model.start_frame, [], step_limit)
        rng = np.random.default_rng([seed, 5])
        self._task = workcell.task
        self._frame = reward.model.start_frame
        self._oracle = oracle
        self._env = VectorEnv(workcell, Feedback(reward, oracle, feedback), starts, 1, rng)
        self._step_limit = step_limit
        self._tries = 0
        self._running = False

    @property
    def pose(self) -> np.ndarray:
        """The flange's present pose (7,)."""
        return np.array(self._env.episodes.poses[0])

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode somewhere in the start region."""
        if self._running or self._tries:
            self._env.begin(0)
        self._tries = 0
        self._running = True
        return dm_env.restart(self._observation())

    def step(self, action: Any) -> dm_env.TimeStep:
        """Try an action (an index in Table 1, from 0); a skipped question brings reward 0 and moves nothing.

        Raises:
            ValueError: the action is none of the ten.
            PauseRequested: who answers wants to go on another time.
        """
        if not self._running:
            return self.reset()
        index = int(action)
        if not 0 <= index < COUNT:
            raise ValueError(f"action must be from 0 to {COUNT - 1}, found {index}")
        attempt = self._env.try_action(0, index, self._env.evaluate_actions())
        self._tries += 1
        reward = attempt.reward or 0.0
        if attempt.at_goal:
            self._running = False
            return dm_env.termination(reward, self._observation())
        if attempt.truncated or self._tries >= self._step_limit:
            self._running = False
            return dm_env.truncation(reward, self._observation())
        return dm_env.transition(reward, self._observation())

    def observation_spec(self) -> specs.Array:
        """Return the observation's shape: (5,) with orientation held, (8,) otherwise."""
        return specs.Array((size(self._task),), np.float32, name="observation")

    def action_spec(self) -> specs.DiscreteArray:
        """Return the ten actions."""
        return specs.DiscreteArray(COUNT, name="action")

    def close(self) -> None:
        """Close the oracle."""
        self._oracle.close()

    def _observation(self) -> np.ndarray:
        episodes = self._env.episodes
        return np.array(observe(self._frame.to_frame(episodes.poses, episodes.starts), self._task)[0])
