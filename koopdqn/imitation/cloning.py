"""Behavioural cloning from observation: the action that a demonstrated step stands for, as a classification."""

import numpy as np
import torch
from torch import nn

from koopdqn.dqn.network import QNetwork
from koopdqn.dqn.observation import size
from koopdqn.dqn.policy import Policy
from koopdqn.dqn.settings import AgentSettings
from koopdqn.imitation.imitator import Imitator
from koopdqn.imitation.inferred import demonstrated_transitions
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

# Sets its random numbers apart from those of demonstrations (1), training (2), checks (3) and evaluation (4).
_STREAM = 6


def clone(trajectories: list[Array], task: Task, agent: AgentSettings, seed: int, updates: int = 2000) -> Imitator:
    """Return the agent's network trained to take the demonstrations' own actions where they were taken.

    Actions are inferred from poses (:func:`demonstrated_transitions`; cf. Torabi et al. 2018, who learn the
    inverse dynamics that are known here). The ten values are logits, and the loss is their cross-entropy.

    Args:
        trajectories: demonstrated poses (N, 7) at the agent's step.
        task: gives actions and observations.
        agent: its network, learning rate and batch.
        seed: fixes everything.
        updates: how many are made.
    """
    weights, batches = (np.random.default_rng([seed, _STREAM, part]) for part in range(2))
    shown = demonstrated_transitions(trajectories, task)
    network = QNetwork(size(task), agent.network, weights)
    network.normalise_to(shown.observations)
    observations, actions = torch.from_numpy(shown.observations), torch.from_numpy(shown.actions)
    optimizer = torch.optim.Adam(network.parameters(), lr=agent.learning_rate)
    for _ in range(updates):
        rows = torch.from_numpy(batches.integers(len(actions), size=agent.batch))
        loss = nn.functional.cross_entropy(network(observations[rows]), actions[rows])
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        optimizer.step()
    return Imitator(Policy(network, task), updates, env_steps=0)
