"""Recordings made fit for learning: idle ends cut off, noise taken out, ends brought together."""

import numpy as np
import pytest
from helpers_shown import HORIZONTAL, SECONDS, arc, recorded
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.preprocess import (
    MOST_SAMPLES,
    STILL_M,
    align_goal,
    check_orientation,
    check_position,
    goal_of,
    noise_of,
    smooth,
    trim_idle,
)
from koopdqn.errors import BadInputError
from koopdqn.paths import arc_lengths, to_step


@settings(max_examples=20)
@given(idle=st.integers(0, 1500), noise=st.sampled_from([0.0, 1e-5, 1e-4]))
def test_idle_ends_are_cut_off_and_nothing_else(idle: int, noise: float) -> None:
    found = trim_idle(recorded(arc(), idle=idle, noise=noise))
    waited = idle * SECONDS / 200
    # The first millimetre is as good as still.
    assert waited - 1e-9 <= found.before <= waited + 0.05
    assert waited - 1e-9 <= found.after <= waited + 0.05
    np.testing.assert_allclose(found.item.poses[[0, -1], :3], arc()[[0, -1], :3], atol=STILL_M)
    assert arc_lengths(found.item.poses[:, :3])[-1] == pytest.approx(arc_lengths(arc()[:, :3])[-1], rel=0.05)


def test_a_turn_in_place_is_no_idling() -> None:
    turns = np.linspace(0.0, 1.0, 50)[:, None] * [0.0, 0.0, 1.0]
    item = Demonstration(0.1 * np.arange(50.0), pose.make([0.4, 0.0, 0.3], pose.from_rotation_vector(turns)))
    assert len(trim_idle(item).item) >= 49


@settings(max_examples=10)
@given(noise=st.floats(1e-4, 2e-3), seed=st.integers(0, 100))
def test_noise_is_its_standard_deviation(noise: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    turns = pose.from_rotation_vector(rng.normal(scale=noise, size=(2000, 3)))
    item = recorded(pose.make(arc(count=2000)[:, :3], turns), noise=noise, seed=seed)
    assert noise_of(item) == pytest.approx((noise, noise), rel=0.1)


def test_what_never_moves_is_refused() -> None:
    with pytest.raises(BadInputError, match="standing still"):
        trim_idle(recorded(np.repeat(arc()[:1], 50, axis=0)))


def test_a_clean_recording_stays_as_it_is() -> None:
    assert np.abs(smooth(recorded(arc())).poses - arc()).max() < 1e-5


@settings(max_examples=10)
@given(noise=st.sampled_from([2e-4, 1e-3]), seed=st.integers(0, 20))
def test_smoothing_takes_most_of_the_noise_out(noise: float, seed: int) -> None:
    even = smooth(recorded(arc(), noise=noise, seed=seed))
    error = np.linalg.norm(even.poses[:, :3] - arc()[:, :3], axis=1)
    assert np.sqrt((error**2).mean()) < 0.5 * np.sqrt(3) * noise


def test_steps_do_not_follow_the_noise() -> None:
    """Neighbouring steps of a smooth arc turn by little; those along a noisy recording zigzag."""

    def largest_bend(poses: np.ndarray) -> float:
        steps = np.diff(to_step([poses], 0.0021, 0.05)[0][:-1, :3], axis=0)
        steps /= np.linalg.norm(steps, axis=1, keepdims=True)
        return float(np.degrees(np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1), -1, 1))).max())

    rough = recorded(arc(count=400), noise=5e-4)
    assert largest_bend(rough.poses) > 30.0
    assert largest_bend(smooth(rough).poses) < 12.0


def test_a_long_recording_is_averaged_first() -> None:
    count = 5 * MOST_SAMPLES
    even = smooth(recorded(arc(count=count), noise=1e-3))
    assert len(even) <= MOST_SAMPLES + 2
    there = np.stack(
        [np.interp(even.times, np.arange(count) * SECONDS / count, arc(count=count)[:, i]) for i in (1, 2)]
    )
    assert np.abs(even.poses[:, 1:3] - there.T).max() < 1e-3


@given(offset=st.lists(st.floats(-0.03, 0.03), min_size=3, max_size=3), turn=st.floats(-0.3, 0.3))
def test_a_demonstration_bent_to_the_goal_ends_there_and_begins_as_it_did(offset: list[float], turn: float) -> None:
    item = recorded(arc())
    rotated = pose.multiply(pose.from_rotation_vector([turn, 0.0, 0.0]), HORIZONTAL)
    goal = pose.make(item.poses[-1, :3] + offset, rotated)
    bent = align_goal(item, goal)
    assert pose.position_distance(bent.poses[-1], goal) == 0.0
    assert pose.rotation_distance(bent.poses[-1], goal) < 1e-12
    np.testing.assert_array_equal(bent.poses[: len(item) // 2], item.poses[: len(item) // 2])
    assert np.linalg.norm(bent.poses[:, :3] - item.poses[:, :3], axis=1).max() <= np.linalg.norm(offset) + 1e-12


def test_the_goal_is_the_mean_of_the_ends_whatever_their_quaternions_signs() -> None:
    ends = [arc(), arc()]
    ends[1][:, pose.QUATERNION] *= -1.0
    ends[1][:, 0] += 0.02
    items = [recorded(poses) for poses in ends]
    goal = goal_of(items)
    np.testing.assert_allclose(goal[:3], arc()[-1, :3] + [0.01, 0.0, 0.0])
    assert pose.rotation_distance(goal, arc()[-1]) < 1e-9
    # The way from start to end is 0.2·√2 m.
    assert check_position(items, goal, 0.011 / 0.283) == pytest.approx(0.01)
    with pytest.raises(BadInputError, match=r"task.end_spread = 0.03 times the median way of 0.283 m.*found 0.010 m"):
        check_position(items, goal, 0.03)


def test_ends_turned_apart_are_refused() -> None:
    turned = arc()
    turned[:, pose.QUATERNION] = pose.multiply(pose.from_rotation_vector([1.0, 0.0, 0.0]), HORIZONTAL)
    items = [recorded(arc()), recorded(turned)]
    with pytest.raises(BadInputError, match=r"found 0\.500 rad; task\.turning=free"):
        check_orientation(items, goal_of(items), 0.35)
