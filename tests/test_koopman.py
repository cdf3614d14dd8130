import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.intent.koopman import (
    KoopmanModel,
    koopman_of_blocks,
    koopman_rows,
    snapshot_pairs,
    within_radius,
)
from koopdqn.intent.observables import Observables, RandomFourier, SecondOrder
from koopdqn.pose import Array


class _StateOnly(Observables):
    """The lift that adds nothing: the model is then a linear system."""

    def features(self, states: Array) -> Array:
        return np.empty((len(states), 0))


def koopman_matrix(before: Array, after: Array, ridge: float = 0.0) -> Array:
    """Return the whole K of pairs of equal weight."""
    return koopman_rows(before, after, np.ones(len(before)), (ridge,))[0]


def shelf_data(trajectories: list[Array]) -> tuple[Array, Array]:
    """Lifted snapshot pairs of real positions, as intent=paper lifts them."""
    before, after = snapshot_pairs([trajectory[:, :3] for trajectory in trajectories])
    return SecondOrder().lift(before), SecondOrder().lift(after)


@given(st.integers(0, 1000), st.integers(2, 5))
def test_a_known_linear_system_is_recovered_exactly(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    system = 0.9 * np.linalg.qr(rng.normal(size=(size, size)))[0]
    trajectories = []
    for _ in range(4):
        states = [rng.normal(size=size)]
        for _ in range(8):
            states.append(system @ states[-1])
        trajectories.append(np.array(states))
    before, after = snapshot_pairs(trajectories)
    np.testing.assert_allclose(koopman_matrix(before, after), system, atol=1e-10)
    model = KoopmanModel.fit(_StateOnly(), before, after, np.zeros(size), 1.0)
    np.testing.assert_allclose(model.predict(before), after, atol=1e-10)
    assert model.spectral_radius() == pytest.approx(0.9, abs=1e-10)


def test_it_is_the_least_squares_solution_on_real_demonstrations(trajectories: list[Array]) -> None:
    before, after = shelf_data(trajectories)
    found = koopman_matrix(before, after)
    by_pinv = (np.linalg.pinv(before) @ after).T
    by_scipy = scipy.linalg.lstsq(before, after, lapack_driver="gelsy")[0].T
    for independent in (by_pinv, by_scipy):
        np.testing.assert_allclose(found, independent, atol=1e-8 * np.abs(found).max())


def test_it_is_the_papers_a_g_dagger(trajectories: list[Array]) -> None:
    """K = A G†, A = 1/M Σ g(x') g(x)ᵀ, G = 1/M Σ g(x) g(x)ᵀ (Eqs. 10–12), summed pair by pair as written."""
    before, after = shelf_data(trajectories)
    size = before.shape[1]
    a, g = np.zeros((size, size)), np.zeros((size, size))
    for x, y in zip(before, after, strict=True):
        a += np.outer(y, x) / len(before)
        g += np.outer(x, x) / len(before)
    paper = a @ np.linalg.pinv(g, rcond=1e-15)
    found = koopman_matrix(before, after)
    # G squares the condition number of the data, which costs half of the digits.
    np.testing.assert_allclose(paper, found, atol=1e-5 * np.abs(found).max())
    np.testing.assert_allclose(before @ paper.T, before @ found.T, atol=1e-9)


@given(st.integers(0, 1000))
def test_the_residual_is_orthogonal_to_the_data(seed: int) -> None:
    rng = np.random.default_rng(seed)
    before, after = rng.normal(size=(30, 4)), rng.normal(size=(30, 4))
    residual = after - before @ koopman_matrix(before, after).T
    np.testing.assert_allclose(before.T @ residual, 0.0, atol=1e-11)


def test_pairs_never_cross_from_one_trajectory_to_the_next() -> None:
    """Two halves of a doubling; the jump between them, taken as a pair, would change K."""
    first, second = np.array([[1.0], [2.0], [4.0]]), np.array([[-1.0], [-2.0], [-4.0]])
    before, after = snapshot_pairs([first, second])
    np.testing.assert_array_equal(before, [[1.0], [2.0], [-1.0], [-2.0]])
    np.testing.assert_array_equal(after, [[2.0], [4.0], [-2.0], [-4.0]])
    np.testing.assert_allclose(koopman_matrix(before, after), [[2.0]], atol=1e-15)
    crossed = np.concatenate([first, second])
    assert koopman_matrix(crossed[:-1], crossed[1:])[0, 0] < 1.0


@given(st.lists(st.integers(2, 6), min_size=1, max_size=5))
def test_each_trajectory_gives_one_pair_less_than_it_has_states(lengths: list[int]) -> None:
    numbered = np.split(np.arange(float(sum(lengths)))[:, None], np.cumsum(lengths)[:-1])
    before, after = snapshot_pairs(list(numbered))
    assert len(before) == len(after) == sum(lengths) - len(lengths)
    np.testing.assert_array_equal(after - before, 1.0)


@given(st.integers(0, 1000), st.floats(1e-6, 1e6))
def test_the_ridge_draws_toward_standing_still(seed: int, ridge: float) -> None:
    rng = np.random.default_rng(seed)
    before, after = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    drawn, harder = koopman_matrix(before, after, ridge), koopman_matrix(before, after, 10 * ridge)
    still = np.eye(3)
    assert np.linalg.norm(harder - still) <= np.linalg.norm(drawn - still) * (1 + 1e-12)
    # The minimiser of |Y − KX|²/M + λ|K − I|²: its gradient vanishes.
    gradient = (before @ drawn.T - after).T @ before / len(before) + ridge * (drawn - still)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-9 * (1 + ridge))


def test_the_ridge_at_its_ends_is_least_squares_or_persistence() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(40, 3)), rng.normal(size=(40, 3))
    np.testing.assert_allclose(koopman_matrix(before, after, 1e-12), koopman_matrix(before, after), atol=1e-10)
    np.testing.assert_allclose(koopman_matrix(before, after, 1e12), np.eye(3), atol=1e-10)


@given(st.integers(0, 100), st.floats(0.1, 10))
def test_prediction_is_lift_multiply_and_read_back(seed: int, scale: float) -> None:
    """Eqs. 13, 14: x̂' = g⁻¹(K g(x)), whatever origin and unit are."""
    rng = np.random.default_rng(seed)
    lift = RandomFourier(count=5, length_scales=(1.0, 1.0), seed=0)
    model = KoopmanModel(lift, rng.normal(size=3), scale, rng.normal(size=(8, 8)))
    states = rng.normal(size=(4, 3))
    lifted = model.lift(states)
    size = len(model.center)
    after = model.center + model.scale * (lifted @ model.matrix.T)[:, :size]
    np.testing.assert_allclose(model.predict(states), after, atol=1e-10)
    np.testing.assert_allclose(model.center + model.scale * lifted[:, :size], states, atol=1e-12)


def test_what_vanishes_at_the_center_keeps_it_fixed() -> None:
    rng = np.random.default_rng(0)
    center = np.array([0.5, 0.1, 0.4])
    before, after = center + rng.normal(size=(50, 3)), center + rng.normal(size=(50, 3))
    fitted = KoopmanModel.fit(
        RandomFourier(count=20, length_scales=(1.0, 1.0), seed=0), before, after, center, 0.3, 1e-6
    )
    np.testing.assert_array_equal(fitted.predict(center[None]), center[None])


@given(seed=st.integers(0, 200), radius=st.floats(0.1, 2.0))
def test_the_spectral_constraint_bounds_the_eigenvalues_and_leaves_what_is_within(seed: int, radius: float) -> None:
    matrix = np.random.default_rng(seed).normal(size=(6, 6))
    bounded = within_radius(matrix, radius)
    assert np.abs(np.linalg.eigvals(bounded)).max() <= radius * (1 + 1e-6)
    np.testing.assert_array_equal(within_radius(matrix, 100.0), matrix)


def test_the_rows_of_every_ridge_are_those_of_the_whole_matrix() -> None:
    rng = np.random.default_rng(0)
    before, after = rng.normal(size=(2, 40, 5))
    for ridge, rows in zip(
        (0.0, 1e-3, 1.0), koopman_rows(before, after[:, :2], np.ones(40), (0.0, 1e-3, 1.0)), strict=True
    ):
        np.testing.assert_allclose(rows, koopman_matrix(before, after, ridge)[:2], atol=1e-10)


@pytest.mark.parametrize("ridge", [0.0, 1e-6])
@pytest.mark.parametrize("length", [1, 7, 1000])
def test_pairs_in_blocks_give_the_matrix_of_all_at_once(trajectories: list[Array], ridge: float, length: int) -> None:
    before, after = shelf_data(trajectories)
    weight = np.linspace(0.5, 2.0, len(before))
    rows = [slice(first, first + length) for first in range(0, len(before), length)]
    found = koopman_of_blocks(((before[part], after[part], weight[part]) for part in rows), ridge)
    whole = koopman_rows(before, after, weight, (ridge,))[0]
    np.testing.assert_allclose(found, whole, atol=1e-8 * np.abs(whole).max())


def test_a_matrix_of_no_blocks_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one pair, found none"):
        koopman_of_blocks(())


def test_more_pairs_than_are_lifted_at_once_give_the_same_model_as_few() -> None:
    rng = np.random.default_rng(0)
    few = rng.normal(size=(300, 3))
    after = few * [0.9, 0.8, 0.7] + 0.05 * few[:, [1, 2, 0]] ** 2 + rng.normal(scale=0.01, size=few.shape)
    # The same pairs again and again have the same least squares.
    many = KoopmanModel.fit(SecondOrder(), np.tile(few, (400, 1)), np.tile(after, (400, 1)), np.zeros(3), 1.0)
    one = KoopmanModel.fit(SecondOrder(), few, after, np.zeros(3), 1.0)
    np.testing.assert_allclose(many.matrix, one.matrix, atol=1e-10)
