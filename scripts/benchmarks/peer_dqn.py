"""Stable-Baselines3's DQN on our environment: same reward, same check, same network width, one thread."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback

from koopdqn.envs.dm import KoopmanEnvironment
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.checks import Checker, Progress
from koopdqn.rl.history import Check
from koopdqn.rl.network import observe
from koopdqn.tasks.actions import COUNT

if TYPE_CHECKING:
    from benchmarks.learning import Prepared

# Actions between two checks, and the most that are tried.
_CHECK_EVERY = 1000
_MOST = 100_000


@dataclass(frozen=True)
class Learned:
    """What came of learning.

    Attributes:
        policy: chooses actions as :data:`koopdqn.tasks.rollout.Controller` says.
        learned: whether the checks say that the task is learned.
        seconds: how long it took.
        steps: actions tried.
    """

    policy: "PeerPolicy"
    learned: bool
    seconds: float
    steps: int


class PeerEnvironment(gymnasium.Env):  # type: ignore[misc]  # the peer is not followed
    """Our environment as Gymnasium knows it, its observations normalised as our network does."""

    def __init__(self, prepared: "Prepared", step_limit: int, mean: Array, spread: Array) -> None:
        """Make the environment."""
        oracle = ScriptedOracle(prepared.config.task)
        feedback = prepared.config.feedback
        self._env = KoopmanEnvironment(prepared.workcell, prepared.reward, oracle, step_limit, 0, feedback)
        self._mean, self._spread = mean, spread
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, mean.shape, np.float32)
        self.action_space = gymnasium.spaces.Discrete(COUNT)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        return self._normalised(self._env.reset().observation), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Try an action."""
        after = self._env.step(action)
        over, arrived = after.last(), after.discount == 0.0
        observation, reward = self._normalised(after.observation), float(after.reward)
        return observation, reward, over and arrived, over and not arrived, {}

    def _normalised(self, observation: Array) -> Any:
        return ((observation - self._mean) / self._spread).astype(np.float32)


class PeerPolicy:
    """The argmax of the peer's network."""

    def __init__(self, model: DQN, prepared: "Prepared", mean: Array, spread: Array) -> None:
        """Take the network as it is; it goes on changing while the model learns."""
        self._model, self._task = model, prepared.config.task
        self._frame, self._mean, self._spread = prepared.reward.model.start_frame, mean, spread

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions (N,) from poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        observations = observe(self._frame.placed(poses, starts), self._task)
        normalised = ((observations - self._mean) / self._spread).astype(np.float32)
        return np.asarray(self._model.predict(normalised, deterministic=True)[0])


class _Checks(BaseCallback):  # type: ignore[misc]  # the peer is not followed
    """Checks as our trainer does, and stops when they say that the task is learned."""

    def __init__(self, prepared: "Prepared", policy: PeerPolicy, step_limit: int) -> None:
        super().__init__()
        self._settings, self._policy = prepared.config.train, policy
        self._checker = Checker(prepared.workcell, prepared.reward.model.fitted, self._settings, step_limit)
        self.progress = Progress()

    def _on_step(self) -> bool:
        if self.n_calls % _CHECK_EVERY == 0:
            measured = self._checker.measure(self._policy)
            self.progress.take(Check(self.n_calls, self.n_calls, 0, *measured), self._settings)
        return not self.progress.learned


def learn(prepared: "Prepared", step_limit: int) -> Learned:
    """Learn a task by Stable-Baselines3's DQN with its own defaults but for what must be the same."""
    torch.set_num_threads(1)
    agent = prepared.config.agent
    seen = observe(np.concatenate(prepared.reward.model.start_frame.each(prepared.shown)), prepared.config.task)
    mean, spread = seen.mean(axis=0), np.maximum(seen.std(axis=0), 0.02)
    began = time.perf_counter()
    model = DQN(
        "MlpPolicy",
        PeerEnvironment(prepared, step_limit, mean, spread),
        learning_rate=1e-3,
        buffer_size=agent.replay,
        learning_starts=1000,
        batch_size=agent.batch,
        gamma=agent.gamma,
        target_update_interval=500,
        exploration_fraction=0.1,
        policy_kwargs={"net_arch": list(agent.network.hidden)},
        seed=0,
        device="cpu",
    )
    policy = PeerPolicy(model, prepared, mean, spread)
    checks = _Checks(prepared, policy, step_limit)
    model.learn(_MOST, callback=checks)
    return Learned(policy, checks.progress.learned, time.perf_counter() - began, int(model.num_timesteps))
