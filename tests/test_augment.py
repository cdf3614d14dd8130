import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn.intent.augment import Augmentation, PursuitPath, augmented
from koopdqn.pose import Array

PULL_BACK = 0.015
STEP = 0.002
SPREAD = 0.1


def chosen(copies: int = 0, far_copies: int = 0, seed: int = 0, touching: float = 0.0) -> Augmentation:
    return Augmentation(
        copies=copies,
        near_m=0.01,
        far_copies=far_copies,
        far=1.0,
        far_weight=0.2,
        pull_back_m=PULL_BACK,
        touching_m=touching,
        seed=seed,
    )


def straight(count: int = 101) -> Array:
    """A path along x, a step apart."""
    return np.stack([STEP * np.arange(count), np.zeros(count), np.zeros(count)], axis=1)


def test_without_copies_the_pairs_are_the_demonstrated_ones() -> None:
    shown = [straight(10), straight(5) + 1.0]
    pairs = augmented(shown, SPREAD, chosen())
    np.testing.assert_array_equal(pairs.before, np.concatenate([rows[:-1] for rows in shown]))
    np.testing.assert_array_equal(pairs.after, np.concatenate([rows[1:] for rows in shown]))
    np.testing.assert_array_equal(pairs.weight, 1.0)


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), copies=st.integers(0, 3), far=st.integers(1, 3))
def test_every_augmented_pair_is_a_step_that_leads_back_and_on(seed: int, copies: int, far: int) -> None:
    path = straight()
    pairs = augmented([path], SPREAD, chosen(copies, far, seed))
    assert len(pairs.before) == (1 + copies + far) * (len(path) - 1)
    assert set(np.unique(pairs.weight)) == {0.2, 1.0}
    moved = pairs.after - pairs.before
    left = np.linalg.norm(path[-1] - pairs.before, axis=1)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.minimum(STEP, left), rtol=1e-6)
    sideways = pairs.before * [0.0, 1.0, 1.0]
    assert np.all((moved * sideways).sum(axis=1) <= 1e-12)
    beside = (pairs.before[:, 0] > 0.0) & (pairs.before[:, 0] < path[-1, 0] - 2 * PULL_BACK)
    assert np.all(moved[beside, 0] > 0.0)
    slope = np.linalg.norm(moved[beside] * [0, 1, 1], axis=1) / moved[beside, 0]
    # Directions are known every millimetre.
    np.testing.assert_allclose(slope, np.linalg.norm(sideways[beside], axis=1) / PULL_BACK, rtol=0.05)


def test_on_a_curve_a_step_stays_on_the_path() -> None:
    angle = np.arange(0.0, 2.0, STEP / 0.05)
    arc = 0.05 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    stepped = PursuitPath.along(arc, PULL_BACK, 0.0).step_from(arc[1:-1], STEP)
    assert np.linalg.norm(stepped - arc[2:], axis=1).max() < 0.05 * STEP


def test_far_states_reach_as_far_as_said_and_near_ones_stay_near() -> None:
    pairs = augmented([straight(2001)], SPREAD, chosen(1, 1))
    near, far = pairs.before[2000:4000, 1:], pairs.before[4000:, 1:]
    assert near.std() == pytest.approx(0.01, rel=0.1)
    assert 0.05 < np.abs(far).max() < 5 * SPREAD


def test_where_a_path_comes_back_against_itself_only_the_later_part_counts() -> None:
    out, back = straight(), straight()[::-1] + np.array([0.0, 0.002, 0.0])
    path = np.concatenate([out, back])
    touching = augmented([path], SPREAD, chosen(1, 0, touching=0.004))
    # Away from the turn nothing leads out along x any more.
    middle = np.abs(touching.before[:, 0] - 0.1) < 0.05
    assert middle.any()
    assert np.all((touching.after - touching.before)[middle, 0] < 0.0)
    apart = augmented([path], SPREAD, chosen(1, 0))
    assert ((apart.after - apart.before)[np.abs(apart.before[:, 0] - 0.1) < 0.05, 0] > 0.0).any()


def test_the_seed_fixes_the_augmented_states() -> None:
    one, same, other = (augmented([straight()], SPREAD, chosen(2, 2, seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one.before, same.before)
    assert not np.allclose(one.before, other.before)
