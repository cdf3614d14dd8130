import numpy as np
import pytest
import torch
from parts import Parts

from koopdqn.errors import BadInputError
from koopdqn.rl.dqn import Adam, Learner, load_arrays, q_targets
from koopdqn.rl.network import QNetwork
from koopdqn.rl.replay_buffer import FIELDS, Transitions
from koopdqn.rl.settings import AgentSettings, check_device

ONLINE = torch.tensor([[1.0, 5.0, 2.0], [7.0, 0.0, 1.0], [3.0, 2.0, 9.0]])
TARGET = torch.tensor([[10.0, 20.0, 30.0], [40.0, 50.0, 60.0], [70.0, 80.0, 90.0]])
REWARDS = torch.tensor([0.5, -1.0, 2.0])


@pytest.fixture(scope="module")
def agent(parts: Parts) -> AgentSettings:
    network = parts.agent.network.model_copy(update={"hidden": (16,), "fourier_features": 0})
    return parts.agent.model_copy(
        update={"network": network, "learning_rate": 0.01, "target_every": 1, "target_rate": 0.1, "gamma": 0.5}
    )


def batch(seed: int, count: int = 32, **changes: np.ndarray) -> Transitions:
    rng = np.random.default_rng(seed)
    fields: dict[str, np.ndarray] = {
        "observations": rng.normal(size=(count, 5)).astype(np.float32),
        "actions": rng.integers(10, size=count),
        "rewards": rng.choice([-1.0, 1.0], size=count).astype(np.float32),
        "next_observations": rng.normal(size=(count, 5)).astype(np.float32),
        "terminated": np.zeros(count, dtype=bool),
        "truncated": np.zeros(count, dtype=bool),
        "undone": np.zeros(count, dtype=bool),
        "poses": rng.normal(size=(count, 7)),
        "starts": rng.normal(size=(count, 7)),
        "steps": np.arange(count),
        "sources": np.ones(count, dtype=np.int64),
        "answers": np.full(count, -1),
    }
    return Transitions(**(fields | changes))


def learner(agent: AgentSettings, seed: int = 0) -> Learner:
    return Learner(5, agent, np.random.default_rng(seed))


def test_double_targets_choose_online_and_value_by_the_target_network() -> None:
    """By hand: the online argmaxes are 1, 0, 2, which the target values at 20, 40, 90."""
    found = q_targets(REWARDS, ONLINE, TARGET, gamma=0.5, double=True)
    torch.testing.assert_close(found, torch.tensor([0.5 + 10.0, -1.0 + 20.0, 2.0 + 45.0]))


def test_eq_3_takes_the_targets_own_maximum() -> None:
    """By hand: the target's maxima are 30, 60, 90."""
    found = q_targets(REWARDS, ONLINE, TARGET, gamma=0.5, double=False)
    torch.testing.assert_close(found, torch.tensor([0.5 + 15.0, -1.0 + 30.0, 2.0 + 45.0]))


def loss_of(agent: AgentSettings, transitions: Transitions) -> float:
    return learner(agent).update(transitions)


def test_a_loss_is_the_mean_squared_error_to_the_targets(agent: AgentSettings) -> None:
    made, data = learner(agent), batch(0)
    values, following = made.online.values(data.observations), made.online.values(data.next_observations)
    rows = np.arange(32)
    # The target network begins as the online one.
    targets = data.rewards + 0.5 * following[rows, following.argmax(axis=1)]
    assert made.update(data) == pytest.approx(np.mean((values[rows, data.actions] - targets) ** 2), rel=1e-5)


def test_transitions_of_one_state_teach_the_same_whether_they_lie_together_or_not(agent: AgentSettings) -> None:
    rng = np.random.default_rng(3)
    states = np.repeat(rng.normal(size=(8, 5)).astype(np.float32), 4, axis=0)
    stops = {"terminated": rng.random(32) < 0.3, "undone": rng.random(32) < 0.5}
    together = batch(0, 32, observations=states, **stops)
    order = rng.permutation(32)
    scattered = Transitions(**{name: getattr(together, name)[order] for name in FIELDS})
    one, two = learner(agent), learner(agent)
    for _ in range(5):
        assert one.update(together) == pytest.approx(two.update(scattered), rel=1e-4)
    for mine, other in zip(one.policy_arrays().values(), two.policy_arrays().values(), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("double", [True, False])
def test_what_follows_is_valued_by_the_slower_target_network(agent: AgentSettings, double: bool) -> None:
    made = learner(agent.model_copy(update={"double": double, "target_every": 1000}))
    for update in range(5):
        made.update(batch(update))
    slow = learner(agent).online
    data = batch(9)
    rows = np.arange(32)
    values, following = made.online.values(data.observations), slow.values(data.next_observations)
    chosen = made.online.values(data.next_observations) if double else following
    targets = data.rewards + 0.5 * following[rows, chosen.argmax(axis=1)]
    assert made.update(data) == pytest.approx(np.mean((values[rows, data.actions] - targets) ** 2), rel=1e-5)


def test_terminated_stops_and_truncated_bootstraps(agent: AgentSettings) -> None:
    yes = np.ones(32, dtype=bool)
    going = loss_of(agent, batch(0))
    assert loss_of(agent, batch(0, truncated=yes)) == going
    assert loss_of(agent, batch(0, terminated=yes)) != going
    assert loss_of(agent, batch(0, terminated=yes, truncated=yes)) == loss_of(agent, batch(0, terminated=yes))


def test_undone_steps_bootstrap_only_where_said(agent: AgentSettings) -> None:
    yes = np.ones(32, dtype=bool)
    looking_past = agent.model_copy(update={"bootstrap_undone": True})
    stopping = agent.model_copy(update={"bootstrap_undone": False})
    assert loss_of(looking_past, batch(0, undone=yes)) == loss_of(looking_past, batch(0))
    assert loss_of(stopping, batch(0, undone=yes)) == loss_of(stopping, batch(0, terminated=yes))
    assert loss_of(stopping, batch(0, undone=yes)) != loss_of(stopping, batch(0))


def test_the_target_network_follows_by_its_rate_at_its_times(agent: AgentSettings) -> None:
    made = learner(agent.model_copy(update={"target_every": 3, "target_rate": 0.25}))
    start = {name: values.copy() for name, values in made.state().items() if name.startswith("target.layers")}
    for update in (1, 2, 3):
        made.update(batch(update))
        now = made.state()
        for name, values in start.items():
            online = now[name.replace("target.", "online.")]
            wanted = values if update < 3 else values + 0.25 * (online - values)
            np.testing.assert_allclose(now[name], wanted, atol=1e-7)
    assert made.updates == 3


def test_both_networks_see_the_same_normalised_inputs(agent: AgentSettings) -> None:
    made = learner(agent)
    made.normalise_to(batch(3).observations * 4 + 1)
    state = made.state()
    np.testing.assert_array_equal(state["online.mean"], state["target.mean"])
    np.testing.assert_array_equal(state["online.spread"], state["target.spread"])
    assert state["online.spread"].min() > 1


@pytest.mark.parametrize("double", [True, False])
def test_it_learns_a_contextual_bandit(agent: AgentSettings, double: bool) -> None:
    """The right action is the tenth in which the first input falls; one look at each action is enough to learn it."""
    made = learner(agent.model_copy(update={"double": double, "gamma": 0.0}))
    rng = np.random.default_rng(0)

    def contexts(count: int) -> tuple[np.ndarray, np.ndarray]:
        seen = np.zeros((count, 5), dtype=np.float32)
        right = rng.integers(10, size=count)
        seen[:, 0], seen[:, 1] = np.cos(0.2 * np.pi * right), np.sin(0.2 * np.pi * right)
        return seen, right

    for _ in range(400):
        seen, right = contexts(64)
        actions = rng.integers(10, size=64)
        rewards = np.where(actions == right, 1.0, -1.0).astype(np.float32)
        made.update(batch(0, 64, observations=seen, actions=actions, rewards=rewards))
    seen, right = contexts(200)
    assert np.mean(made.online.values(seen).argmax(axis=1) == right) > 0.95


def test_value_flows_back_from_a_later_reward(agent: AgentSettings) -> None:
    """A chain of three states: −0 now and 1 at the end is worth γ² at the beginning."""
    made = learner(agent.model_copy(update={"gamma": 0.5}))
    states = np.eye(5, dtype=np.float32)[:4]
    index = np.tile([0, 1, 2], 20)
    actions = np.tile(np.arange(10), 6)
    rewards = (index == 2).astype(np.float32)
    for _ in range(500):
        made.update(
            batch(
                0,
                60,
                observations=states[index],
                actions=actions,
                rewards=rewards,
                next_observations=states[index + 1],
                terminated=index == 2,
            )
        )
    np.testing.assert_allclose(made.online.values(states[:3]).max(axis=1), [0.25, 0.5, 1.0], atol=0.1)


def test_adam_is_torchs_own() -> None:
    ours, theirs = (torch.ones(3, 2, requires_grad=True) for _ in range(2))
    mine, other = Adam([ours], 0.01), torch.optim.Adam([theirs], lr=0.01)
    for _ in range(10):
        mine.descend((ours**3 - ours).sum())
        other.zero_grad()
        (theirs**3 - theirs).sum().backward()  # type: ignore[no-untyped-call]
        other.step()
    assert torch.equal(ours, theirs)
    assert not torch.equal(ours, torch.ones(3, 2))


@pytest.mark.parametrize("hidden", [(16,), (24, 7, 33)])
def test_an_update_is_that_of_autograd_and_torchs_adam_bit_for_bit(agent: AgentSettings, hidden: tuple[int]) -> None:
    network = agent.network.model_copy(update={"hidden": hidden, "fourier_features": 12})
    made = learner(agent.model_copy(update={"network": network, "target_every": 1000}))
    other = QNetwork(5, network, np.random.default_rng(0))
    load_arrays(other, made.policy_arrays())
    optimizer = torch.optim.Adam(other.parameters(), lr=agent.learning_rate, foreach=False)
    for number in range(3):
        # Every state twice in a row, once with the same action, as it comes from the replay buffer.
        drawn = batch(number, count=10)
        twice = {name: np.repeat(getattr(drawn, name), 2, axis=0) for name in FIELDS}
        some = twice | {"actions": np.where(np.arange(20) % 4 == 1, 3, twice["actions"])}
        tried = Transitions(**some)
        targets = torch.from_numpy(tried.rewards) + agent.gamma * made.target(
            torch.from_numpy(tried.next_observations)
        ).gather(1, other(torch.from_numpy(tried.next_observations)).argmax(dim=1, keepdim=True)).squeeze(1)
        values = other(torch.from_numpy(drawn.observations))
        chosen = values[np.repeat(np.arange(10), 2), tried.actions]
        loss = torch.nn.functional.mse_loss(chosen, targets.detach())
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        assert made.update(tried) == float(loss.detach())
        for ours, theirs in zip(made.online.parameters(), other.parameters(), strict=True):
            assert torch.equal(ours, theirs)


def test_a_restored_learner_goes_on_bit_for_bit(agent: AgentSettings) -> None:
    settings = agent.model_copy(update={"target_every": 3})
    old = learner(settings)
    for update in range(5):
        old.update(batch(update))
    state = {name: values.copy() for name, values in old.state().items()}
    new = learner(settings, seed=99)
    new.update(batch(77))
    new.restore(state)
    assert new.updates == 5
    for update in range(5, 10):
        assert new.update(batch(update)) == old.update(batch(update))
    for name, values in old.state().items():
        np.testing.assert_array_equal(new.state()[name], values, err_msg=name)


def test_a_learner_can_be_restored_before_its_first_update(agent: AgentSettings) -> None:
    old, new = learner(agent), learner(agent, seed=5)
    new.restore(old.state())
    assert new.update(batch(0)) == old.update(batch(0))


@pytest.mark.parametrize("which", ["online", "target"])
def test_the_policys_arrays_are_a_copy_of_the_network_that_is_the_policy(agent: AgentSettings, which: str) -> None:
    made = learner(agent.model_copy(update={"policy_network": which}))
    arrays = made.policy_arrays()
    before = {name: values.copy() for name, values in arrays.items()}
    made.update(batch(0))
    for name, values in before.items():
        np.testing.assert_array_equal(arrays[name], values)
    twin = QNetwork(5, agent.network, np.random.default_rng(8))
    load_arrays(twin, made.policy_arrays())
    wanted, other = (made.online, made.target) if which == "online" else (made.target, made.online)
    np.testing.assert_array_equal(twin.values(batch(1).observations), wanted.values(batch(1).observations))
    assert np.abs(twin.values(batch(1).observations) - other.values(batch(1).observations)).max() > 1e-4


def test_arrays_of_another_shape_are_refused(agent: AgentSettings) -> None:
    wider = QNetwork(8, agent.network, np.random.default_rng(0))
    with pytest.raises(RuntimeError, match="size mismatch"):
        load_arrays(wider, learner(agent).policy_arrays())


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU here")
def test_a_gpu_that_is_not_there_is_told_before_any_work(agent: AgentSettings) -> None:
    assert check_device(agent) == "cpu"
    with pytest.raises(BadInputError, match=r"agent.device: must be cpu where .* found cuda"):
        check_device(agent.model_copy(update={"device": "cuda"}))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_gpu_makes_the_updates_of_the_cpu(agent: AgentSettings) -> None:
    one, two = (learner(agent.model_copy(update={"device": name})) for name in ("cpu", "cuda"))
    for seed in range(5):
        one.update(batch(seed))
        two.update(batch(seed))
    other = two.state()
    for name, values in one.state().items():
        np.testing.assert_allclose(values, other[name], atol=1e-4, err_msg=name)
