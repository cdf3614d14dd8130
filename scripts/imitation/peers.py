"""DQN, PPO and SAC of Stable-Baselines3 on koopdqn's own environment: the same intent, reward, oracle and limits."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
import torch
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from koopdqn.envs.batch import EnvironmentParts
from koopdqn.envs.gym import KoopmanVectorEnv
from koopdqn.envs.sb3 import FourierFeatures, StableBaselinesVecEnv
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.pose import Array
from koopdqn.rl.network import observe

_EPISODES: Final = 64
# As in examples/stable_baselines.py, which chose them on the shelf with seeds 0 and 1.
_SHARED: Final[dict[str, Any]] = {"learning_rate": 1e-3, "gamma": 0.5}
_NETWORK: Final[dict[str, Any]] = {"net_arch": [128, 128], "features_extractor_class": FourierFeatures}
_KINDS: Final[dict[str, tuple[type[BaseAlgorithm], int, dict[str, Any]]]] = {
    "sb3-dqn": (DQN, 32_768, {"batch_size": 256, "gradient_steps": 8, "target_update_interval": 1000}),
    "sb3-ppo": (PPO, 49_152, {"batch_size": 512, "n_steps": 64, "n_epochs": 6, "gae_lambda": 0.8}),
    "sb3-sac": (
        SAC,
        20_000,
        {"batch_size": 256, "gradient_steps": 8, "learning_starts": 2000, "ent_coef": "auto_0.05"},
    ),
}


class _Counting(Oracle):
    """Another oracle, and how often it was asked."""

    def __init__(self, asked: Oracle) -> None:
        self._asked = asked
        self.questions = 0

    def answer(self, question: Question) -> Answer:
        self.questions += 1
        return self._asked.answer(question)


class Peer:
    """A learned policy of another library: the controller that takes its best action.

    Attributes:
        env_steps: actions tried.
        questions: asked of the oracle.
    """

    def __init__(self, name: str, parts: EnvironmentParts, seed: int, steps: int | None = None) -> None:
        """Learn by DQN, PPO or SAC, as ``imitate.py`` names them.

        SAC's parts must have continuous actions, the others' those of Table 1. ``steps`` are how many actions are
        tried; None for as many as the shelf needs.
        """
        kind, enough, settings = _KINDS[name]
        torch.set_num_threads(1)
        oracle = _Counting(parts.oracle)
        single = KoopmanVectorEnv(replace(parts, oracle=oracle), _EPISODES, autoreset_mode="SameStep")
        self._env = VecNormalize(StableBaselinesVecEnv(single), norm_reward=False)
        learner = kind("MlpPolicy", self._env, seed=seed, policy_kwargs=_NETWORK, **_SHARED, **settings)
        self._learner = learner.learn(steps or enough)
        self._task, self._frame = parts.workcell.task, parts.reward.model.start_frame
        self.env_steps, self.questions = int(learner.num_timesteps), oracle.questions

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions from poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        seen = np.asarray(self._env.normalize_obs(observe(self._frame.to_frame(poses, starts), self._task)))
        return np.asarray(self._learner.predict(seen, deterministic=True)[0])
