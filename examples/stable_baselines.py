"""Stable-Baselines3's DQN or PPO on the shelf, through Gymnasium, 64 episodes at once.

Run it with ``python examples/stable_baselines.py PPO 300000``: learner, steps, then overrides like ``seed=3``.
"""

import sys
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import VecNormalize

import koopdqn.gym  # noqa: F401 (registers the environments)
from koopdqn.envs.sb3 import StableBaselinesVecEnv

NETWORK = {"net_arch": [256, 256]}


def episodes(count: int, seed: int, overrides: list[str]) -> VecNormalize:
    """Return so many episodes at once, their observations normalised."""
    env = gymnasium.make_vec("koopdqn/Shelf-v0", count, autoreset_mode="SameStep", overrides=overrides)
    normalised = VecNormalize(StableBaselinesVecEnv(env), norm_reward=False)
    normalised.seed(seed)
    return normalised


def success_rate(learned: DQN | PPO, env: VecNormalize, steps: int) -> float:
    """Return the share of first episodes that the best actions bring to the goal; a wrong one repeats for ever."""
    seen: Any = env.reset()
    won, ended = np.zeros(env.num_envs, dtype=bool), np.zeros(env.num_envs, dtype=bool)
    for _ in range(steps):
        seen, _, now, infos = env.step(learned.predict(np.asarray(seen), deterministic=True)[0])
        won |= ~ended & np.array([info.get("is_success", False) for info in infos])
        ended |= now
    return float(won.mean())


if __name__ == "__main__":
    name, steps, overrides = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    torch.set_num_threads(1)
    env = episodes(64, 0, overrides)
    learner: DQN | PPO
    if name == "PPO":
        learner = PPO(
            "MlpPolicy", env, learning_rate=1e-3, n_steps=64, batch_size=1024, gamma=0.5, policy_kwargs=NETWORK
        )
    else:
        learner = DQN(
            "MlpPolicy", env, learning_rate=1e-3, gamma=0.5, gradient_steps=3, batch_size=256, policy_kwargs=NETWORK
        )
    learner.learn(steps)
    held_out = episodes(100, 1, overrides)
    held_out.training, held_out.obs_rms = False, env.obs_rms
    share = success_rate(learner, held_out, 400)
    print(f"{name} after {learner.num_timesteps} steps: {share:.0%} of 100 starts reach the goal")
