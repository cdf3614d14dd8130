"""Stable-Baselines3's DQN on our environment: same reward, same check, same network width, one thread."""

import time

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.learning import Learned, Prepared
from koopdqn.envs.batch import EnvironmentParts
from koopdqn.envs.gym import KoopmanEnv, Observations
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.checks import Check, Checker, Progress
from koopdqn.rl.network import observe

# Actions between two checks, and the most that are tried.
_CHECK_EVERY = 1000
_MOST = 100_000


def environment(
    prepared: Prepared, step_limit: int, mean: Array, spread: Array
) -> gymnasium.Env[Observations, np.int64]:
    """Return our environment, its observations normalised as our network does."""
    config = prepared.config
    parts = EnvironmentParts(
        prepared.workcell, prepared.reward, ScriptedOracle(config.task), step_limit, config.feedback
    )
    space = gymnasium.spaces.Box(-np.inf, np.inf, mean.shape, np.float32)
    return TransformObservation(KoopmanEnv(parts), lambda seen: ((seen - mean) / spread).astype(np.float32), space)


class PeerPolicy:
    """The argmax of the peer's network."""

    def __init__(self, model: DQN, prepared: Prepared, mean: Array, spread: Array) -> None:
        """Take the network as it is; it goes on changing while the model learns."""
        self._model, self._task = model, prepared.config.task
        self._frame, self._mean, self._spread = prepared.reward.model.start_frame, mean, spread

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions (N,) from poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        observations = observe(self._frame.to_frame(poses, starts), self._task)
        normalised = ((observations - self._mean) / self._spread).astype(np.float32)
        return np.asarray(self._model.predict(normalised, deterministic=True)[0])


class _Checks(BaseCallback):
    """Checks as our trainer does, and stops when they say that the task is learned."""

    def __init__(self, prepared: Prepared, policy: PeerPolicy, step_limit: int) -> None:
        super().__init__()
        self._settings, self._policy = prepared.config.train, policy
        self._nearest = prepared.reward.nearest_actions
        self._checker = Checker(prepared.workcell, prepared.reward.model.fitted, self._settings, step_limit)
        self.progress = Progress()

    def _on_step(self) -> bool:
        if self.n_calls % _CHECK_EVERY == 0:
            measured = self._checker.measure(self._policy)
            check = Check(self.n_calls, self.n_calls, 0, *measured)
            if self.progress.astray(check, self._settings):
                return True
            self.progress.add(check, self._settings, best=self.progress.better(check))
            if self.progress.settled(self._settings):
                rate, another_way = self._checker.confirm(self._policy, self._nearest)
                self.progress.confirm(check, self._settings, rate, another_way=another_way)
        return not self.progress.learned


def learn(prepared: Prepared, step_limit: int) -> Learned:
    """Learn a task by Stable-Baselines3's DQN with its own defaults but for what must be the same."""
    torch.set_num_threads(1)
    agent = prepared.config.agent
    seen = observe(np.concatenate(prepared.reward.model.start_frame.each(prepared.shown)), prepared.config.task)
    mean, spread = seen.mean(axis=0), np.maximum(seen.std(axis=0), 0.02)
    began = time.perf_counter()
    model = DQN(
        "MlpPolicy",
        environment(prepared, step_limit, mean, spread),
        learning_rate=1e-3,
        buffer_size=agent.replay,
        learning_starts=1000,
        batch_size=agent.batch,
        gamma=agent.gamma,
        target_update_interval=500,
        exploration_fraction=0.1,
        policy_kwargs={"net_arch": list(agent.network.hidden)},
        seed=prepared.config.inputs.seed,
        device="cpu",
    )
    policy = PeerPolicy(model, prepared, mean, spread)
    checks = _Checks(prepared, policy, step_limit)
    model.learn(_MOST, callback=checks)
    return Learned(policy, checks.progress.learned, time.perf_counter() - began, int(model.num_timesteps))
