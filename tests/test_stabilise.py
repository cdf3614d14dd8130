import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.intent.stabilise import Stabilisation, surrounded
from koopdqn.pose import Array

PULL_BACK = 0.015


def settings(copies: int, seed: int = 0, spread: float = 0.7) -> Stabilisation:
    return Stabilisation(copies=copies, spread=spread, pull_back_m=PULL_BACK, seed=seed)


def pairs(seed: int, count: int = 6) -> tuple[Array, Array]:
    rng = np.random.default_rng([seed, 9])
    before = rng.normal(size=(count, 3))
    return before, before + 0.002 * rng.normal(size=(count, 3))


@given(seed=st.integers(0, 1000), copies=st.integers(1, 6))
def test_made_up_states_lie_beside_and_lead_back_at_the_demonstrated_speed(seed: int, copies: int) -> None:
    before, after = pairs(seed)
    befores, afters = surrounded(before, after, settings(copies, seed))
    assert len(befores) == len(afters) == (1 + copies) * len(before)
    motion = np.tile(after - before, (copies, 1))
    length = np.linalg.norm(motion, axis=1)
    direction = motion / length[:, None]
    offset = befores[len(before) :] - np.tile(before, (copies, 1))
    np.testing.assert_allclose((offset * direction).sum(axis=1), 0.0, atol=1e-12)
    made = afters[len(before) :] - befores[len(before) :]
    np.testing.assert_allclose(np.linalg.norm(made, axis=1), length, rtol=1e-9)
    # Toward the line of motion (never away), in the plane of offset and motion.
    assert np.all((made * offset).sum(axis=1) < 0)
    assert np.all((made * direction).sum(axis=1) > 0)
    slope = (made * offset).sum(axis=1) / np.linalg.norm(offset, axis=1) / (made * direction).sum(axis=1)
    np.testing.assert_allclose(slope, -np.linalg.norm(offset, axis=1) / PULL_BACK, rtol=1e-6)


def test_demonstrated_pairs_come_first_and_unchanged() -> None:
    before, after = pairs(0)
    for copies in (0, 3):
        befores, afters = surrounded(before, after, settings(copies))
        np.testing.assert_array_equal(befores[: len(before)], before)
        np.testing.assert_array_equal(afters[: len(before)], after)


def test_idle_pairs_are_kept_but_not_surrounded() -> None:
    before, after = pairs(0)
    after[2] = before[2]
    befores, afters = surrounded(before, after, settings(2))
    assert len(befores) == len(before) + 2 * (len(before) - 1)
    assert np.isfinite(afters).all()


def test_the_spread_is_as_wide_as_said_and_the_seed_fixes_it() -> None:
    before = np.zeros((4000, 3))
    after = np.tile([0.002, 0.0, 0.0], (4000, 1))
    befores, _ = surrounded(before, after, settings(1, 5, spread=1.2))
    assert befores[4000:, 1:].std() == pytest.approx(1.2 * PULL_BACK, rel=0.05)
    np.testing.assert_array_equal(befores, surrounded(before, after, settings(1, 5, spread=1.2))[0])
    assert not np.allclose(befores[4000:], surrounded(before, after, settings(1, 6, spread=1.2))[0][4000:])
