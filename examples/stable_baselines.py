"""Stable-Baselines3's DQN, PPO or SAC on the shelf, through Gymnasium, 64 episodes at once.

Run it with ``python examples/stable_baselines.py PPO 50000 0``: learner, steps, seed, then overrides.
"""

import sys
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN, PPO, SAC
from stable_baselines3.common.vec_env import VecNormalize

import koopdqn.gym
from koopdqn.envs.sb3 import FourierFeatures, StableBaselinesVecEnv

STARTS = ["agent.exploring_starts=0.95", "agent.exploring_in_region=0.2"]
SETTINGS: dict[str, tuple[Any, dict[str, Any]]] = {
    "DQN": (DQN, {"batch_size": 256, "gradient_steps": 8, "target_update_interval": 1000}),
    "PPO": (PPO, {"batch_size": 512, "n_steps": 64, "n_epochs": 6, "gae_lambda": 0.8}),
    "SAC": (SAC, {"batch_size": 256, "gradient_steps": 8, "learning_starts": 2000, "ent_coef": "auto_0.05"}),
}


def learn(name: str, steps: int, seed: int, overrides: list[str]) -> tuple[int, float]:
    """Return how many steps were made, nearly all in short episodes along demonstrations, and the success rate."""
    overrides = [*STARTS, f"seed={seed}", *overrides]
    actions, task = ("continuous", "ShelfContinuous") if name == "SAC" else ("table1", "Shelf")
    made: dict[str, Any] = {"overrides": overrides, "exploring_starts": True, "autoreset_mode": "SameStep"}
    env = VecNormalize(StableBaselinesVecEnv(gymnasium.make_vec(f"koopdqn/{task}-v0", 64, **made)), norm_reward=False)
    kind, settings = SETTINGS[name]
    network = {"net_arch": [128, 128], "features_extractor_class": FourierFeatures}
    shared = {"learning_rate": 1e-3, "gamma": 0.5, "seed": seed, "policy_kwargs": network}
    learner = kind("MlpPolicy", env, **shared, **settings).learn(steps)
    parts = koopdqn.gym.environment_parts("shelf", overrides, actions=actions)
    share = parts.success_rate(lambda seen: learner.predict(np.asarray(env.normalize_obs(seen)), deterministic=True)[0])
    return learner.num_timesteps, share


if __name__ == "__main__":
    torch.set_num_threads(1)
    steps, share = learn(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:])
    print(f"{sys.argv[1]} after {steps} steps: {share:.0%} of 100 starts reach the goal")
