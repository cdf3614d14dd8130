import numpy as np
import pytest
import torch

from koopdqn.rl.network import QNetwork
from koopdqn.rl.settings import NetworkSettings

PLAIN = NetworkSettings(hidden=(6, 4), fourier_features=0, length_scale_m=0.1, length_scale_rad=0.5)
WAVES = NetworkSettings(hidden=(6,), fourier_features=8, length_scale_m=0.1, length_scale_rad=0.5)


def network(settings: NetworkSettings, seed: int = 0, inputs: int = 5) -> QNetwork:
    return QNetwork(inputs, settings, np.random.default_rng(seed))


def seen(seed: int, count: int = 20) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(count, 5)).astype(np.float32)


@pytest.mark.parametrize("settings", [PLAIN, WAVES])
def test_the_generator_alone_decides_every_weight(settings: NetworkSettings) -> None:
    torch.manual_seed(1)
    first = network(settings).state_dict()
    torch.manual_seed(2)
    again, other = network(settings).state_dict(), network(settings, seed=1).state_dict()
    for name, values in first.items():
        assert torch.equal(values, again[name]), name
    assert not torch.equal(first["layers.0.weight"], other["layers.0.weight"])


def test_global_random_states_are_left_alone() -> None:
    torch.manual_seed(3)
    np.random.seed(3)
    expected = torch.rand(2), np.random.random(2)
    torch.manual_seed(3)
    np.random.seed(3)
    network(WAVES).values(seen(0))
    assert torch.equal(torch.rand(2), expected[0])
    np.testing.assert_array_equal(np.random.random(2), expected[1])


def test_it_computes_what_its_layers_say() -> None:
    made = network(PLAIN)
    state = {name: values.numpy() for name, values in made.state_dict().items()}
    rows = seen(0).astype(np.float64)
    for layer in (0, 2):
        rows = np.maximum(rows @ state[f"layers.{layer}.weight"].T + state[f"layers.{layer}.bias"], 0)
    wanted = rows @ state["layers.4.weight"].T + state["layers.4.bias"]
    np.testing.assert_allclose(made.values(seen(0)), wanted, atol=1e-5)
    assert wanted.shape == (20, 10)


def test_observations_are_normalised_to_mean_and_spread() -> None:
    made, plain = network(PLAIN), network(PLAIN)
    data = (seen(1) * [2.0, 0.1, 5.0, 1.0, 0.0] + [1.0, 2.0, 3.0, 4.0, 5.0]).astype(np.float32)
    made.normalise_to(data)
    by_hand = (data - data.mean(axis=0)) / np.maximum(data.std(axis=0), 0.02)
    np.testing.assert_allclose(made.values(data), plain.values(by_hand.astype(np.float32)), atol=1e-4)


def test_the_features_follow_the_position_and_the_length_scale() -> None:
    fine, coarse = (network(WAVES.model_copy(update={"length_scale_m": scale})) for scale in (0.01, 1.0))
    np.testing.assert_allclose(fine.frequencies.numpy(), 100 * coarse.frequencies.numpy(), rtol=1e-5)
    assert fine.layers[0].in_features == 5 + 8
    names = {name for name, _ in fine.named_parameters()}
    assert "frequencies" not in names
    assert "phases" not in names


def test_where_orientation_is_learned_the_features_follow_what_is_left_to_turn_too() -> None:
    fine, coarse = (
        network(WAVES.model_copy(update={"length_scale_rad": scale}), inputs=8).frequencies.numpy()
        for scale in (0.01, 1.0)
    )
    assert fine.shape == (6, 8)
    np.testing.assert_array_equal(fine[:3], coarse[:3])
    np.testing.assert_allclose(fine[3:], 100 * coarse[3:], rtol=1e-5)
    assert network(WAVES).frequencies.shape == (3, 8)
    rows = torch.zeros(2, 8)
    rows[1, 5] = 0.3
    waves = network(WAVES, inputs=8).features(rows)[:, 8:]
    assert (waves[0] != waves[1]).all()


def test_each_row_is_valued_by_itself() -> None:
    made = network(WAVES)
    together = made.values(seen(3))
    np.testing.assert_allclose(made.values(seen(3)[4:5]), together[4:5], atol=1e-5)


def test_many_rows_are_valued_as_few_are() -> None:
    made = network(WAVES)
    rows = np.random.default_rng(5).normal(size=(300, 5)).astype(np.float32)
    few = np.concatenate([made.values(rows[first : first + 100]) for first in range(0, 300, 100)])
    np.testing.assert_allclose(made.values(rows), few, atol=1e-5)
