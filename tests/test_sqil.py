"""SQIL on the agent's DQN."""

import numpy as np
import pytest
import torch
from imitation.inferred import demonstrated_transitions
from imitation.sqil import Sqil
from imitation_parts import STEP_LIMIT, parameters, short, success

from koopdqn.rl.policy import Policy

GAMMA = 0.75


def begun(seed: int = 0, gamma: float = GAMMA) -> Sqil:
    known = short()
    return Sqil(known.cell, known.trajectories, known.agent, seed, STEP_LIMIT, gamma)


def test_half_of_a_batch_is_demonstrated_and_only_that_half_is_rewarded_for_its_steps() -> None:
    sqil = begun()
    sqil.run(800)
    shown = demonstrated_transitions(short().trajectories, short().cell.task)
    batch, half = sqil.batch(), short().agent.batch
    assert len(batch.actions) == 2 * half
    known = {(*observation, action) for observation, action in zip(shown.observations, shown.actions, strict=True)}
    first = list(zip(batch.observations[:half], batch.actions[:half], strict=True))
    assert all((*observation, action) in known for observation, action in first)
    np.testing.assert_allclose(batch.rewards[:half], np.where(batch.terminated[:half], 1.0, 1.0 - GAMMA))
    np.testing.assert_allclose(batch.rewards[half:], np.where(batch.terminated[half:], GAMMA, 0.0))


def test_it_comes_to_prefer_the_demonstrated_actions_where_they_were_taken() -> None:
    shown = demonstrated_transitions(short().trajectories, short().cell.task)
    agreed = (begun().run(6000).policy(shown.poses, shown.starts) == shown.actions).mean()
    assert agreed > np.bincount(shown.actions).max() / len(shown.actions) + 0.1


@pytest.mark.slow
def test_it_learns_a_short_way() -> None:
    learned = begun().run(9000, success, check_every=50)
    assert success(learned.policy) >= 0.6
    assert learned.env_steps >= 6000
    assert success(begun().run(16).policy) < 0.5


def test_of_the_best_policies_the_latest_is_kept_whatever_is_learned_later() -> None:
    scores, seen = iter([0.1, 0.7, 0.7, 0.2, 0.3]), list[Policy]()

    def check(policy: Policy) -> float:
        seen.append(policy)
        return next(scores)

    sqil = begun()
    kept = sqil.run(800, check, check_every=sqil_updates(800) // 4)
    assert len(seen) == 5
    weights = [list(policy.network.state_dict().values()) for policy in (kept.policy, seen[2], seen[4])]
    assert all(torch.equal(a, b) for a, b in zip(weights[0], weights[1], strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(weights[0], weights[2], strict=True))


def sqil_updates(actions: int) -> int:
    return begun().run(actions).updates


def test_the_seed_fixes_every_weight() -> None:
    torch.manual_seed(1)
    first = parameters(begun().run(600))
    torch.manual_seed(2)
    again, other = parameters(begun().run(600)), parameters(begun(seed=1).run(600))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not all(np.array_equal(a, b) for a, b in zip(first, other, strict=True))
