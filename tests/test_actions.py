from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import with_fields

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.actions import (
    ACTIONS,
    COUNT,
    ROTATING,
    checked_indices,
    excess,
    legal_actions,
    reached_poses,
    within_tolerance,
)
from koopdqn.tasks.shelf import ShelfTask

unit_vectors = (
    st.lists(st.floats(-1, 1, allow_nan=False), min_size=3, max_size=3)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)


def away(task: ShelfTask, offset: Array, turn: Array) -> Array:
    return pose.make(task.goal[:3] + offset, pose.multiply(pose.from_rotation_vector(turn), task.goal[3:]))[None]


def test_there_are_the_ten_actions_of_table_1_in_its_order() -> None:
    assert COUNT == len(ACTIONS) == 10
    assert ACTIONS[0] == "moves uniformly in position and rotation toward the goal"
    assert ACTIONS[1] == "moves only in position toward the goal"
    assert ACTIONS[2] == "moves only in rotation toward the goal"
    assert ACTIONS[3] == "moves in position and more in rotation toward the goal"
    assert ACTIONS[4:] == tuple(f"moves along {sign}{axis}" for axis in "xyz" for sign in "+-")


@given(direction=unit_vectors, axis=unit_vectors, far=st.floats(0.0022, 1.0), turned=st.floats(0.05, 3.0))
def test_each_action_does_what_table_1_says(
    shelf_task: ShelfTask, direction: Array, axis: Array, far: float, turned: float
) -> None:
    task, step, turn = shelf_task, shelf_task.step_m, shelf_task.rotation_tolerance_rad
    here = away(task, far * direction, turned * axis)
    reached = reached_poses(here, task)
    assert reached.shape == (1, 10, 7)
    moved = pose.position_distance(reached, here[:, None])[0]
    rotated = pose.rotation_distance(reached, here[:, None])[0]
    np.testing.assert_allclose(moved, [step, step, 0, step, *[step] * 6], atol=1e-12)
    np.testing.assert_allclose(rotated, [2 * turn, 0, 2 * turn, 4 * turn, *[0] * 6], atol=1e-9)
    nearer = far - pose.position_distance(reached, task.goal)[0]
    np.testing.assert_allclose(nearer[[0, 1, 2, 3]], [step, step, 0, step], atol=1e-9)
    closer = turned - pose.rotation_distance(reached, task.goal)[0]
    np.testing.assert_allclose(closer[:4], [2 * turn, 0, 2 * turn, 4 * turn], atol=1e-9)
    for action in range(4, 10):
        motion = np.zeros(3)
        motion[(action - 4) // 2] = step if action % 2 == 0 else -step
        np.testing.assert_allclose(reached[0, action, :3] - here[0, :3], motion, atol=1e-15)
        np.testing.assert_array_equal(reached[0, action, 3:], here[0, 3:])


@given(direction=unit_vectors, axis=unit_vectors, far=st.floats(0, 0.0021), turned=st.floats(0, 0.019))
def test_motion_toward_the_goal_is_clamped_there(
    shelf_task: ShelfTask, direction: Array, axis: Array, far: float, turned: float
) -> None:
    reached = reached_poses(away(shelf_task, far * direction, turned * axis), shelf_task)
    for action in (0, 3):
        assert pose.position_distance(reached[0, action], shelf_task.goal) < 1e-12
        assert pose.rotation_distance(reached[0, action], shelf_task.goal) < 1e-12
    assert pose.position_distance(reached[0, 1], shelf_task.goal) < 1e-12
    assert pose.rotation_distance(reached[0, 2], shelf_task.goal) < 1e-12


def test_every_pose_of_a_batch_moves_by_itself(shelf_task: ShelfTask) -> None:
    rng = np.random.default_rng(0)
    poses = np.concatenate([away(shelf_task, rng.normal(size=3), 0.5 * rng.normal(size=3)) for _ in range(5)])
    poses[2] = shelf_task.goal
    before = poses.copy()
    together = reached_poses(poses, shelf_task)
    np.testing.assert_array_equal(poses, before)
    for index in range(5):
        np.testing.assert_allclose(reached_poses(poses[index : index + 1], shelf_task)[0], together[index], atol=1e-15)


def test_with_orientation_held_the_actions_named_for_rotation_are_illegal(shelf_task: ShelfTask) -> None:
    assert ROTATING == (0, 2, 3)
    assert np.flatnonzero(legal_actions(shelf_task)).tolist() == [1, 4, 5, 6, 7, 8, 9]


@given(wish=unit_vectors, to_goal=unit_vectors)
def test_for_any_wished_direction_some_legal_action_is_within_tolerance(
    shelf_task: ShelfTask, wish: Array, to_goal: Array
) -> None:
    """The cone rule (row 9): with τ < s ≤ 1.087 τ the axes and the goal direction leave no direction out."""
    widest = with_fields(shelf_task, step_m=1.087 * shelf_task.position_tolerance_m)
    for task in (shelf_task, widest):
        here = away(task, -0.3 * to_goal, np.zeros(3))
        wished = here.copy()
        wished[0, :3] += task.step_m * wish
        right = within_tolerance(reached_poses(here, task), wished[:, None], task)[0]
        assert (right & legal_actions(task)).any()


@given(off=st.floats(0, 0.01), turned=st.floats(0, 0.05), direction=unit_vectors, axis=unit_vectors)
def test_comparing_keeps_metres_and_radians_apart(
    shelf_task: ShelfTask, off: float, turned: float, direction: Array, axis: Array
) -> None:
    there = away(shelf_task, off * direction, turned * axis)
    wanted = max(off / 0.002, turned / 0.01)
    assert excess(there, shelf_task.goal, shelf_task)[0] == pytest.approx(wanted, abs=1e-9)
    if abs(wanted - 1) > 1e-9:
        assert within_tolerance(there, shelf_task.goal, shelf_task)[0] == (off <= 0.002 and turned <= 0.01)


@pytest.mark.parametrize("kind", [np.int8, np.uint64, np.float32, object])
def test_whole_numbers_of_any_kind_are_actions(kind: Any) -> None:
    assert checked_indices(np.array([8, 3], dtype=kind), 2).tolist() == [8, 3]
