"""skrl's double DQN on the shelf with koopdqn's own network; run it with steps, seed, then overrides: ``60000 0``."""

import sys
from typing import Any

import gymnasium
import numpy as np
import torch
from skrl.agents.torch.ddqn import DDQN
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, Model
from skrl.trainers.torch import SequentialTrainer
from skrl.utils import set_seed

import koopdqn.gym
from koopdqn import load_config
from koopdqn.rl.network import QNetwork

STARTS = ["agent.exploring_starts=0.95", "agent.exploring_in_region=0.2"]
LEARNING: dict[str, Any] = {"learning_rate": 1e-3, "discount_factor": 0.5, "batch_size": 256, "gradient_steps": 8}
LEARNING |= {"polyak": 0.05, "exploration_scheduler": lambda step, steps: max(0.1, 1.0 - 10.0 * step / steps)}
LEARNING |= {"experiment": {"write_interval": 0, "checkpoint_interval": 0}}


class Values(DeterministicMixin, Model):  # type: ignore[misc]  # skrl is untyped
    """A network as skrl knows it."""

    def __init__(self, network: QNetwork, spaces: dict[str, Any]) -> None:
        """Wrap the network."""
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.network = network

    def compute(self, inputs: dict[str, Any], role: str = "") -> tuple[torch.Tensor, dict[str, Any]]:
        """Return the values of the actions (N, 10)."""
        return self.network(inputs["observations"]), {}


if __name__ == "__main__":
    steps, seed, overrides = int(sys.argv[1]), int(sys.argv[2]), [*STARTS, f"seed={sys.argv[2]}", *sys.argv[3:]]
    torch.set_num_threads(1)
    set_seed(seed)
    made: dict[str, Any] = {"overrides": overrides, "exploring_starts": True, "autoreset_mode": "SameStep"}
    env = wrap_env(gymnasium.make_vec("koopdqn/Shelf-v0", 64, **made))
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space, "device": "cpu"}
    settings = load_config("task=shelf", *overrides).agent.network
    online, target = (QNetwork(5, settings, np.random.default_rng(seed)) for _ in range(2))
    online.normalise_to(env.reset()[0].numpy())
    target.load_state_dict(online.state_dict())
    models = {"q_network": Values(online, spaces), "target_q_network": Values(target, spaces)}
    agent = DDQN(models=models, memory=RandomMemory(memory_size=1500, num_envs=64), cfg=LEARNING, **spaces)
    trained = {"timesteps": steps // 64, "headless": True, "close_environment_at_exit": False}
    SequentialTrainer(env=env, agents=agent, cfg=trained).train()
    parts = koopdqn.gym.environment_parts("shelf", overrides)
    share = parts.success_rate(lambda seen: online(torch.from_numpy(seen)).argmax(dim=1).numpy())
    print(f"double DQN after {steps // 64 * 64} steps: {share:.0%} of 100 starts reach the goal")
