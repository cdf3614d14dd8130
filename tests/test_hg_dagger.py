"""HG-DAgger with the scripted person."""

import numpy as np
import torch
from imitation.cloning import Cloning
from imitation.hg_dagger import corrected
from imitation.inferred import Imitator
from imitation_parts import STEP_LIMIT, parameters, short


def begun(seed: int = 0) -> Cloning:
    return Cloning(short().trajectories, short().cell.task, short().agent, seed)


def taught(questions: int, seed: int = 0) -> Imitator:
    return corrected(begun(seed), short().cell, seed, STEP_LIMIT, questions, updates=20, updates_per_label=5)


def test_no_more_labels_are_asked_for_than_allowed_and_learning_follows_each() -> None:
    learned = taught(questions=6)
    assert learned.questions == 6
    assert learned.updates == 20 + 6 * 5
    assert learned.env_steps >= 6


def test_without_questions_it_is_cloning_and_the_arm_stays_where_it_is() -> None:
    learned = taught(questions=0)
    assert (learned.questions, learned.updates, learned.env_steps) == (0, 20, 0)


def test_the_labels_are_what_the_expert_would_do_where_the_policy_was_wrong() -> None:
    cloning = begun()
    corrected(cloning, short().cell, 0, STEP_LIMIT, 6, updates=20, updates_per_label=200)
    observations, actions = map(np.array, zip(*cloning.labels, strict=True))
    values = cloning.policy.network.values(observations)
    assert len(actions) == 6
    assert np.array_equal(values.argmax(axis=1), actions)


def test_the_seed_fixes_every_weight() -> None:
    torch.manual_seed(1)
    first = parameters(taught(questions=4))
    torch.manual_seed(2)
    again, other = parameters(taught(questions=4)), parameters(taught(questions=4, seed=1))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))
