"""Behavioural cloning from observation."""

import numpy as np
import torch
from imitation_parts import parameters, short, success

from koopdqn.imitation.cloning import clone
from koopdqn.imitation.imitator import Imitator
from koopdqn.imitation.inferred import demonstrated_transitions


def cloned(seed: int = 0, updates: int = 400) -> Imitator:
    return clone(short().trajectories, short().cell.task, short().agent, seed, updates)


def test_it_takes_the_demonstrated_actions_where_they_were_taken() -> None:
    shown = demonstrated_transitions(short().trajectories, short().cell.task)
    agreed = (cloned().policy(shown.poses, shown.starts) == shown.actions).mean()
    commonest = np.bincount(shown.actions).max() / len(shown.actions)
    assert agreed > max(0.95, commonest + 0.1)


def test_it_learns_a_short_way_without_acting() -> None:
    learned = cloned()
    assert success(learned.policy) == 1.0
    assert (learned.updates, learned.env_steps) == (400, 0)


def test_the_seed_fixes_every_weight() -> None:
    torch.manual_seed(1)
    first = parameters(cloned(updates=20))
    torch.manual_seed(2)
    again, other = parameters(cloned(updates=20)), parameters(cloned(seed=1, updates=20))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))
