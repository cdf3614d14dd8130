"""Stable-Baselines3's DQN or PPO on the shelf, through Gymnasium, 64 episodes at once.

Run it with ``python examples/stable_baselines.py DQN 50000``: learner, steps, then overrides like ``seed=3``.
"""

import sys
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import VecNormalize

import koopdqn.gym
from koopdqn.envs.sb3 import StableBaselinesVecEnv
from koopdqn.pose import Array
from koopdqn.rl.network import observe
from koopdqn.tasks.rollout import SUCCESS, roll_out

SETTINGS: dict[str, Any] = {"learning_rate": 1e-3, "gamma": 0.5, "seed": 0, "policy_kwargs": {"net_arch": [256, 256]}}


def episodes(count: int, seed: int, overrides: list[str]) -> VecNormalize:
    """Return so many episodes at once, their observations normalised."""
    env = gymnasium.make_vec("koopdqn/Shelf-v0", count, autoreset_mode="SameStep", overrides=overrides)
    normalised = VecNormalize(StableBaselinesVecEnv(env), norm_reward=False)
    normalised.seed(seed)
    return normalised


def success_rate(learned: DQN | PPO, env: VecNormalize, overrides: list[str]) -> float:
    """Return the share of 100 held-out starts from which the best actions reach the goal, with nothing undone."""
    parts = koopdqn.gym.environment_parts("shelf", overrides)
    task, reachability = parts.workcell.task, parts.workcell.reachability
    begun, joints, _ = reachability.draw_starts(task, np.random.default_rng(2000), 100)

    def best(poses: Array, starts: Array) -> np.ndarray:
        seen = observe(parts.reward.model.start_frame.to_frame(poses, starts), task)
        return learned.predict(np.asarray(env.normalize_obs(seen)), deterministic=True)[0]

    episodes = roll_out(best, task, reachability, begun, joints, parts.step_limit)
    return float(np.mean([episode.outcome == SUCCESS for episode in episodes]))


if __name__ == "__main__":
    name, steps, overrides = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    torch.set_num_threads(1)
    env = episodes(64, 0, overrides)
    learner: DQN | PPO
    if name == "PPO":
        learner = PPO("MlpPolicy", env, n_steps=64, batch_size=1024, **SETTINGS)
    else:
        learner = DQN("MlpPolicy", env, batch_size=256, gradient_steps=8, target_update_interval=1000, **SETTINGS)
    learner.learn(steps)
    share = success_rate(learner, env, overrides)
    print(f"{name} after {learner.num_timesteps} steps: {share:.0%} of 100 starts reach the goal")
