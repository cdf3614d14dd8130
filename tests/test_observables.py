from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import PrivateAttr, ValidationError

from koopdqn.errors import BadInputError
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.intent.observables import (
    Observables,
    Polynomial,
    RadialBasis,
    RadialTurn,
    RandomFourier,
    SecondOrder,
)
from koopdqn.pose import Array

KNOTS = (0.05, 0.2, 1.0, 3.0)
EVERY: list[Observables] = [
    SecondOrder(),
    Polynomial(degree=4),
    RandomFourier(count=7, length_scales=(0.4, 0.4), seed=1),
    RandomFourier(count=300, length_scales=(1.0, 1.0), seed=0),
    RadialTurn(knots=KNOTS),
]

numbers = st.floats(-3, 3, allow_nan=False)
states = st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=6).map(np.array)


@pytest.mark.parametrize("observables", EVERY, ids=lambda o: type(o).__name__)
@given(rows=states)
def test_lifting_and_reading_back_is_the_identity(observables: Observables, rows: Array) -> None:
    lifted = observables.lift(rows)
    assert lifted.ndim == 2
    assert lifted.shape[0] == len(rows)
    np.testing.assert_array_equal(lifted[:, :3], rows)


@pytest.mark.parametrize("observables", EVERY, ids=lambda o: type(o).__name__)
@given(rows=states)
def test_each_row_is_lifted_by_itself(observables: Observables, rows: Array) -> None:
    together = observables.lift(rows)
    for row, lifted in zip(rows, together, strict=True):
        np.testing.assert_allclose(observables.lift(row[None])[0], lifted, atol=1e-12)


@pytest.mark.parametrize("observables", EVERY, ids=lambda o: type(o).__name__)
def test_everything_vanishes_at_the_origin(observables: Observables) -> None:
    np.testing.assert_array_equal(observables.lift(np.zeros((1, 3))), 0.0)


class _Own(Observables):
    """Features of one's own, as a test gives them."""

    _features: Callable[[Array], Any] = PrivateAttr()

    def features(self, states: Array) -> Array:
        return np.asarray(self._features(states))


@pytest.mark.parametrize(
    ("features", "said"),
    [
        (
            lambda s: s[:, 0] ** 2,
            r"real numbers of shape \(4, any number\), a row a state, found float64 of shape \(4,\)",
        ),
        (lambda s: np.ones((3, 2)), r"found float64 of shape \(3, 2\)"),
        (lambda s: s**2 + 1j, r"found complex128 of shape \(4, 3\)"),
        (lambda s: np.log(-1.0 - s**2), r"finite numbers, found \[nan, nan, nan\] of a state \[0.0, 1.0, 2.0\]"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_features_that_no_model_can_be_fitted_to_name_their_observables(
    features: Callable[[Array], Any], said: str
) -> None:
    own, states = _Own(), np.arange(12.0).reshape(4, 3)
    own._features = features
    with pytest.raises(BadInputError, match=f"observables _Own: features must return .*{said}"):
        KoopmanModel.fit(own, states, states, np.zeros(3), 1.0)


def test_the_second_order_lift_has_the_papers_entries_in_the_papers_order() -> None:
    a, b, c = 2.0, 3.0, 5.0
    wanted = [a, b, c, a * a, b * b, c * c, a * b, a * c, b * c]
    np.testing.assert_array_equal(SecondOrder().lift(np.array([[a, b, c]])), [wanted])


def test_random_features_approximate_the_gaussian_kernel() -> None:
    """√(2/F) cos(wᵀx + b) has inner products near exp(−‖x − y‖²/2ℓ²), also as differences from the origin."""
    scale = 0.7
    many = RandomFourier(count=5000, length_scales=(scale, scale), seed=3)
    points = np.random.default_rng(0).normal(scale=0.5, size=(6, 3))
    features = many.features(points)

    def kernel(x: Array, y: Array) -> Array:
        return np.asarray(np.exp(-((x[:, None] - y[None]) ** 2).sum(axis=2) / (2 * scale**2)))

    zero = np.zeros((1, 3))
    wanted = kernel(points, points) - kernel(points, zero) - kernel(zero, points) + kernel(zero, zero)
    np.testing.assert_allclose(features @ features.T, wanted, atol=0.1)


def test_the_seed_fixes_the_features() -> None:
    point = np.ones((1, 3))
    one, same, other = (
        RandomFourier(count=5, length_scales=(1.0, 1.0), seed=seed).features(point) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(one, same)
    assert not np.allclose(one, other)


@given(st.floats(0.06, 3.0), st.floats(0.06, 3.0))
def test_radial_features_share_direction_and_sum_to_it(angle: float, other: float) -> None:
    axis = np.array([1.0, 2.0, -2.0]) / 3
    at_angle, at_other = RadialTurn(knots=KNOTS).features(np.array([angle * axis, other * axis])).reshape(2, 4, 3)
    np.testing.assert_allclose(at_angle.sum(axis=0), axis, atol=1e-12)
    np.testing.assert_allclose(at_other.sum(axis=0), axis, atol=1e-12)
    assert np.count_nonzero(np.linalg.norm(at_angle, axis=1) > 1e-12) <= 2


@pytest.mark.parametrize("knots", [(0.0, 1.0), (0.5, 0.4), (0.3, 0.3)])
def test_knots_that_do_not_increase_are_refused(knots: tuple[float, ...]) -> None:
    with pytest.raises(ValidationError, match="knots must be positive and increase"):
        RadialTurn(knots=knots)


@given(seed=st.integers(0, 100), degree=st.integers(1, 5))
def test_polynomials_are_all_monomials_up_to_their_degree(seed: int, degree: int) -> None:
    states = np.random.default_rng(seed).normal(size=(4, 2))
    found = Polynomial(degree=degree).features(states)
    wanted = [states[:, 0] ** i * states[:, 1] ** (d - i) for d in range(2, degree + 1) for i in range(d, -1, -1)]
    np.testing.assert_allclose(found, np.array(wanted).T.reshape(4, -1), rtol=1e-12)


def test_bumps_stand_on_the_states_vanish_at_the_origin_and_are_restored() -> None:
    states = np.random.default_rng(0).normal(size=(50, 3))
    lift = RadialBasis(count=9, length_scale=0.5).fitted_to(states)
    centers = lift.arrays()["centers"]
    assert all((states == center).all(axis=1).any() for center in centers)
    assert len(np.unique(centers, axis=0)) == 9
    np.testing.assert_allclose(lift.features(np.zeros((1, 3))), 0.0, atol=1e-15)
    again = RadialBasis(count=9, length_scale=0.5).restored(lift.arrays())
    np.testing.assert_array_equal(again.features(states), lift.features(states))
    assert len(RadialBasis(count=80, length_scale=0.5).fitted_to(states).arrays()["centers"]) == 50
