"""Continuous actions: where they lead, and what the intent model suggests."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_runs import knife_parts

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.actions import (
    excess,
    in_balls,
    largest_turn,
    legal_actions,
    moved_by,
    reached_by,
    reached_poses,
    toward,
    twist_size,
    twists_between,
)
from koopdqn.tasks.task import Task

numbers = st.lists(st.floats(-3, 3, allow_nan=False), min_size=6, max_size=6).map(np.array)


@pytest.fixture(scope="module")
def knife() -> Task:
    return knife_parts().task


@given(twist=numbers)
def test_a_twist_moves_and_turns_by_its_length_and_never_farther(knife: Task, twist: Array) -> None:
    here = knife.nominal_start[None]
    there = moved_by(here, twist[None], knife)
    lengths = np.minimum([np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])], 1.0)
    np.testing.assert_allclose(pose.position_distance(there, here)[0], lengths[0] * knife.step_m, atol=1e-12)
    np.testing.assert_allclose(pose.rotation_distance(there, here)[0], lengths[1] * largest_turn(knife), atol=1e-9)


@given(twist=numbers)
def test_a_twist_is_found_again_from_what_it_reached(knife: Task, twist: Array) -> None:
    here = knife.nominal_start[None]
    found = twists_between(here, moved_by(here, twist[None], knife), knife)
    np.testing.assert_allclose(found[0], in_balls(twist), atol=1e-9)


def test_a_twist_is_told_in_the_frame_of_the_base(knife: Task) -> None:
    here = knife.nominal_start[None]
    up, about = (np.eye(6)[None, index] for index in (2, 5))
    np.testing.assert_allclose(moved_by(here, up, knife)[0, :3] - here[0, :3], [0, 0, knife.step_m], atol=1e-15)
    turn = pose.multiply(moved_by(here, about, knife)[0, 3:], pose.conjugate(here[0, 3:]))
    np.testing.assert_allclose(pose.to_rotation_vector(turn), [0, 0, largest_turn(knife)], atol=1e-12)


def test_every_action_of_table_1_is_a_twist(knife: Task, shelf_task: Task) -> None:
    for task in (knife, shelf_task):
        here = task.nominal_start[None]
        table = reached_poses(here, task)[:, legal_actions(task)]
        again = moved_by(here[:, None], twists_between(here[:, None], table, task), task)
        assert excess(again, table, task).max() < 1e-5


def test_held_orientation_leaves_nothing_to_turn(shelf_task: Task) -> None:
    here = shelf_task.nominal_start[None]
    assert twist_size(shelf_task) == 3
    np.testing.assert_array_equal(moved_by(here, np.ones((1, 3)), shelf_task)[0, 3:], here[0, 3:])


@given(wish=numbers)
def test_a_wish_within_the_balls_is_reached_and_one_beyond_is_gone_toward(knife: Task, wish: Array) -> None:
    here = knife.nominal_start[None]
    turned = pose.multiply(pose.from_rotation_vector(largest_turn(knife) * wish[3:]), here[0, 3:])
    wished = pose.make(here[0, :3] + knife.step_m * wish[:3], turned)[None]
    there = toward(here, wished, knife)
    beyond = np.maximum(np.linalg.norm(wish.reshape(2, 3), axis=1) - 1.0, 0.0)
    np.testing.assert_allclose(pose.position_distance(there, wished)[0], beyond[0] * knife.step_m, atol=1e-12)
    np.testing.assert_allclose(pose.rotation_distance(there, wished)[0], beyond[1] * largest_turn(knife), atol=1e-8)


def test_a_controller_may_give_either_kind(shelf_task: Task) -> None:
    here = np.repeat(shelf_task.nominal_start[None], 2, axis=0)
    by_index = reached_by(here, np.array([4, 7]), shelf_task)
    by_twist = reached_by(here, np.array([[1.0, 0, 0], [0, -1.0, 0]]), shelf_task)
    np.testing.assert_allclose(by_index, by_twist, atol=1e-15)
