"""TD3's targets, updates and exact state."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from koopdqn.app import api
from koopdqn.rl.actor_critic import ActorCritic, TwinCritics, best_actions, shortened, smoothed_targets
from koopdqn.rl.replay_buffer import Transitions
from koopdqn.rl.settings import ActorCriticSettings, NetworkSettings

NETWORK = NetworkSettings(hidden=(32, 32), fourier_features=32, length_scale_m=0.5, length_scale_rad=0.3)


@pytest.fixture(scope="module")
def settings() -> ActorCriticSettings:
    agent = api.load_config("actions=continuous").agent
    assert isinstance(agent, ActorCriticSettings)
    return agent.model_copy(update={"network": NETWORK, "critic_hidden": (32, 32)})


def batch(rng: np.random.Generator, count: int = 64, per_state: int = 6) -> Transitions:
    """States in a unit cube in which the right motion is to the first axis' side that the state is on."""
    states = np.repeat(rng.uniform(-1, 1, (count // per_state, 5)), per_state, axis=0).astype(np.float32)
    count = len(states)
    twists = rng.normal(size=(count, 3))
    twists /= np.linalg.norm(twists, axis=1, keepdims=True)
    wished = np.sign(states[:, :1]) * np.array([[1.0, 0, 0]])
    # A right one in every state, as the intent's suggestion is.
    twists[::per_state] = wished[::per_state]
    rewards = 1.0 - np.linalg.norm(twists - wished, axis=1)
    return Transitions(
        states,
        np.full(count, 11),
        rewards.astype(np.float32),
        states,
        terminated=np.zeros(count, bool),
        truncated=np.zeros(count, bool),
        undone=rewards < 0,
        poses=np.zeros((count, 7)),
        starts=np.zeros((count, 7)),
        steps=np.zeros(count, np.int64),
        sources=np.ones(count, np.int64),
        answers=np.full(count, -1),
        twists=twists.astype(np.float32),
    )


def test_targets_are_of_the_lesser_critic() -> None:
    first, second = torch.tensor([2.0, 1.0]), torch.tensor([3.0, -1.0])
    # 1 + 0.5·2, 0.5 + 0.5·(−1).
    assert smoothed_targets(torch.tensor([1.0, 0.5]), first, second, 0.5).tolist() == [2.0, 0.0]


def test_nothing_follows_what_ended_or_was_undone(settings: ActorCriticSettings) -> None:
    yes = np.ones(60, dtype=bool)

    def loss(**changed: np.ndarray) -> float:
        made = ActorCritic(5, np.ones(3), settings, np.random.default_rng(0))
        return made.update(replace(batch(np.random.default_rng(0)), **changed))

    assert (
        loss(undone=yes) == loss(terminated=yes) == loss(terminated=yes, next_observations=np.ones((60, 5), np.float32))
    )
    assert loss(undone=yes) != loss(undone=~yes)


def test_an_actors_outputs_are_shortened_to_the_balls() -> None:
    raw = torch.tensor([[3.0, 0, 4.0, 0.3, 0, 0.4], [0.1, 0.2, 0, 0, 0, 2.0]])
    expected = torch.tensor([[0.6, 0, 0.8, 0.3, 0, 0.4], [0.1, 0.2, 0, 0, 0, 1.0]])
    torch.testing.assert_close(shortened(raw), expected)


def test_twin_critics_are_two_networks_beside_each_other() -> None:
    critics = TwinCritics(4, 3, (5, 6), np.random.default_rng(0))
    features, twists, state_of = torch.randn(2, 4), torch.randn(3, 3), torch.tensor([0, 1, 1])
    together = critics(features, state_of, twists)
    for twin in range(2):
        values = torch.cat([features[state_of], twists], dim=1)
        for layer in ("1", "2", "3"):
            values = values @ getattr(critics, f"weight{layer}")[twin] + getattr(critics, f"bias{layer}")[twin]
            values = values.relu() if layer != "3" else values
        torch.testing.assert_close(together[twin], values[:, 0])
    assert not torch.equal(together[0], together[1])


def test_the_best_action_of_a_state_is_its_right_one_of_greatest_reward() -> None:
    rng = np.random.default_rng(0)
    made = replace(batch(rng, 12, 4), rewards=np.array([0, 1, -1, 0.5, -1, -1, -1, -1, 0.1, 0.2, 0, 0], np.float32))
    assert made.twists is not None
    best, known = best_actions(made, np.repeat([0, 1, 2], 4))
    np.testing.assert_array_equal(best[[0, 2]], made.twists[[1, 9]])
    assert known.tolist() == [True, False, True]


@pytest.mark.parametrize("imitation", [0.0, 1.0])
def test_the_actor_learns_where_to_go_from_labelled_twists(settings: ActorCriticSettings, imitation: float) -> None:
    chosen = settings.model_copy(update={"imitation": imitation, "actor_rate": 2e-3, "target_rate": 0.1})
    learner, rng = ActorCritic(5, np.ones(3), chosen, np.random.default_rng(0)), np.random.default_rng(1)
    for _ in range(400):
        learner.update(batch(rng))
    states = rng.uniform(-1, 1, (200, 5)).astype(np.float32)
    states[:, 0] = np.where(states[:, 0] < 0, states[:, 0] - 0.3, states[:, 0] + 0.3)
    twists = shortened(torch.from_numpy(learner.policy_network.values(states))).numpy()
    # Within 72° of the way to go.
    assert (twists[:, 0] * np.sign(states[:, 0]) > 0.3).mean() > 0.85


def test_the_actor_waits_for_the_critics(settings: ActorCriticSettings) -> None:
    learner = ActorCritic(5, np.ones(3), settings.model_copy(update={"actor_every": 3}), np.random.default_rng(0))
    before = learner.state()
    moved = []
    for _ in range(6):
        learner.update(batch(np.random.default_rng(2)))
        now = learner.state()
        moved.append(not np.array_equal(now["online.layers.0.weight"], before["online.layers.0.weight"]))
        assert not np.array_equal(now["critics.weight1"], before["critics.weight1"])
        before = now
    assert moved == [False, False, True, False, False, True]


def test_the_targets_wait_as_they_are_told(settings: ActorCriticSettings) -> None:
    learner = ActorCritic(5, np.ones(3), settings.model_copy(update={"target_every": 2}), np.random.default_rng(0))
    before = learner.state()
    moved = []
    for _ in range(4):
        learner.update(batch(np.random.default_rng(2)))
        now = learner.state()
        names = ("target.layers.0.weight", "target_critics.weight1")
        moved.append([not np.array_equal(now[name], before[name]) for name in names])
        before = now
    assert moved == [[False, False], [True, True]] * 2


def test_a_restored_learner_goes_on_as_one_never_stopped(settings: ActorCriticSettings) -> None:
    whole, other = (ActorCritic(5, np.ones(3), settings, np.random.default_rng(0)) for _ in range(2))
    batches = [batch(np.random.default_rng(index)) for index in range(6)]
    for each in batches[:3]:
        whole.update(each)
    other.restore(whole.state())
    for each in batches[3:]:
        assert whole.update(each) == other.update(each)
    for name, values in whole.state().items():
        np.testing.assert_array_equal(values, other.state()[name], err_msg=name)


def test_proposals_are_the_actors_own_first_and_stay_in_the_balls(settings: ActorCriticSettings) -> None:
    learner = ActorCritic(8, np.array([0.9, 0.9, 0.9, 0.2, 0.2, 0.2]), settings, np.random.default_rng(0))
    seen = np.random.default_rng(1).normal(size=(9, 8)).astype(np.float32)
    proposed = learner.propose(lambda: seen, np.random.default_rng(2))
    assert proposed.shape == (9, 1 + settings.near, 6)
    own = shortened(torch.from_numpy(learner.online.values(seen))).numpy()
    np.testing.assert_allclose(proposed[:, 0], own, atol=1e-6)
    assert np.linalg.norm(proposed.reshape(-1, 2, 3), axis=2).max() <= 1 + 1e-12
