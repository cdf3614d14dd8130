import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.paths import between, to_count, to_step
from koopdqn.pose import Array

STEP, TURN = 0.0021, 0.05


def gaps(poses: Array) -> Array:
    """The larger of both distances between neighbours, in steps and turns."""
    moved = pose.position_distance(poses[1:], poses[:-1]) / STEP
    turned = pose.rotation_distance(poses[1:], poses[:-1]) / TURN
    return np.maximum(moved, turned)


@st.composite
def recordings(draw: st.DrawFn) -> Array:
    """Smooth pose trajectories sampled at any rate, with pauses and turns in place."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    count = draw(st.integers(2, 40))
    speed = rng.uniform(0, draw(st.sampled_from([1e-4, 5e-4, 4e-3])), count)
    speed[rng.random(count) < 0.2] = 0.0
    turning = draw(st.sampled_from([0.0, 0.01, 0.1]))
    position = np.cumsum(speed[:, None] * (rng.normal(size=3) + 0.3 * rng.normal(size=(count, 3))), axis=0)
    turns = np.cumsum(turning * np.abs(rng.normal(size=count)))
    axis = rng.normal(size=3)
    vectors = turns[:, None] * axis / np.linalg.norm(axis)
    return pose.make(position, pose.from_rotation_vector(vectors))


@settings(max_examples=30)
@given(recordings())
def test_every_gap_but_the_last_is_a_step_or_a_turn(recorded: Array) -> None:
    resampled = to_step([recorded], STEP, TURN)[0]
    distances = gaps(resampled)
    np.testing.assert_allclose(distances[:-1], 1.0, atol=1e-6)
    assert np.all(distances[-1:] <= 1 + 1e-6)


@settings(max_examples=30)
@given(recordings())
def test_both_ends_are_kept(recorded: Array) -> None:
    resampled = to_step([recorded], STEP, TURN)[0]
    np.testing.assert_array_equal(resampled[0], recorded[0])
    assert pose.position_distance(resampled[-1], recorded[-1]) <= 1e-6 * STEP + 1e-15
    assert pose.rotation_distance(resampled[-1], recorded[-1]) <= 1e-6 * TURN + 1e-15


@settings(max_examples=30)
@given(recordings())
def test_resampling_anew_changes_nothing(recorded: Array) -> None:
    once = to_step([recorded], STEP, TURN)[0]
    np.testing.assert_allclose(to_step([once], STEP, TURN)[0][: len(once) - 1], once[:-1], atol=1e-6)


@given(recordings())
def test_trajectories_do_not_depend_on_which_others_are_resampled_beside_them(recorded: Array) -> None:
    others = [recorded, recorded[::-1], recorded[: len(recorded) // 2 + 1]]
    for rows, resampled in zip(others, to_step(others, STEP, TURN), strict=True):
        np.testing.assert_array_equal(resampled, to_step([rows], STEP, TURN)[0])


def test_turning_in_place_survives_and_idling_vanishes() -> None:
    turning = pose.make(np.zeros((11, 3)), pose.from_rotation_vector(np.outer(np.linspace(0, 1, 11), [0, 0, 1.0])))
    idle = np.repeat(turning[:1], 30, axis=0)
    resampled = to_step([np.concatenate([idle, turning, np.repeat(turning[-1:], 30, axis=0)])], STEP, TURN)[0]
    assert len(resampled) == 21
    np.testing.assert_allclose(pose.rotation_distance(resampled[1:], resampled[:-1]), TURN, atol=1e-9)


def test_whichever_comes_first_takes_the_sample() -> None:
    """A metre a radian: ten steps of 2.1 mm turn 21 mrad; at 5 mrad a turn there are four samples on the way."""
    share = np.linspace(0, 1, 5)[:, None]
    both = pose.make(share * [0.021, 0, 0], pose.from_rotation_vector(share * [0.021, 0, 0]))
    assert len(to_step([both], 0.0021, 1.0)[0]) == 11
    assert len(to_step([both], 1.0, 0.0042)[0]) == 6
    np.testing.assert_allclose(to_step([both], 0.0021, 0.0042)[0][:, 0], np.arange(11) * 0.0021, atol=1e-9)


def test_samples_lie_on_the_recorded_path() -> None:
    corner = pose.make([[0.0, 0, 0], [0.01, 0, 0], [0.01, 0.01, 0]], [1.0, 0, 0, 0])
    resampled = to_step([corner], STEP, TURN)[0][:, :3]
    on_first = (np.abs(resampled[:, 1]) < 1e-12) & (resampled[:, 0] <= 0.01 + 1e-12)
    on_second = np.abs(resampled[:, 0] - 0.01) < 1e-12
    assert np.all(on_first | on_second)


@given(recordings(), st.floats(0, 1))
def test_between_divides_both_distances(recorded: Array, share: float) -> None:
    a, b = recorded[0], recorded[-1]
    middle = between(a, b, share)
    for distance in (pose.position_distance, pose.rotation_distance):
        assert distance(a, middle) == pytest.approx(share * distance(a, b), abs=1e-12)


@given(recordings(), st.integers(2, 90))
def test_a_count_of_samples_is_spread_evenly_along_the_path(recorded: Array, count: int) -> None:
    resampled = to_count(recorded, count)
    assert resampled.shape == (count, 7)
    np.testing.assert_allclose(resampled[[0, -1], :3], recorded[[0, -1], :3], atol=1e-9)


def test_evenly_along_a_line_or_a_turn() -> None:
    uneven = np.array([0.0, 0.1, 0.15, 0.5, 1.0])[:, None]
    line = to_count(pose.make(uneven * [0.3, 0.4, 0], [1.0, 0, 0, 0]), 6)
    np.testing.assert_allclose(pose.position_distance(line[1:], line[:-1]), 0.1, atol=1e-9)
    turn = to_count(pose.make(np.zeros((5, 3)), pose.from_rotation_vector(uneven * [0.2, 0, 0])), 6)
    np.testing.assert_allclose(pose.rotation_distance(turn[1:], turn[:-1]), 0.04, atol=1e-4)
