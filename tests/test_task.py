import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import with_fields

from koopdqn import pose
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.settings import load_settings
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import MAX_STEP_PER_TOLERANCE, Task


@given(ratio=st.floats(0.5, 1.5))
def test_the_step_is_held_to_the_tolerance(shelf_task: ShelfTask, ratio: float) -> None:
    step = ratio * shelf_task.position_tolerance_m
    found = step / shelf_task.position_tolerance_m
    if 1 < found <= MAX_STEP_PER_TOLERANCE:
        assert with_fields(shelf_task, step_m=step).step_m == step
    else:
        with pytest.raises(BadInputError, match=r"step_m must be over position_tolerance_m.*0\.002.*found"):
            with_fields(shelf_task, step_m=step)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("start_quaternion", [0.7, 0.0, 0.7, 0.0]),
        ("goal_quaternion", [0.0, 0.0, 0.0, 0.0]),
        ("start_half_range_m", [0.04, -0.01, 0.04]),
        ("waypoints", [[0.5, 0.0, 0.4]]),
        ("goal_tolerance_m", 0.0),
        ("name", "The Shelf"),
    ],
)
def test_what_breaks_a_rule_is_refused_by_name(shelf_task: ShelfTask, field: str, value: object) -> None:
    with pytest.raises(BadInputError, match=field) as caught:
        with_fields(shelf_task, **{field: value})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "place"),
    [
        ("waypoints", [[0.5, 0.0, 0.4], [500, 0.0, 440], [0.5, 0.2, 0.4]], "waypoints[1]"),
        ("compartment_corner_m", [500, 0.0, 440], "compartment_corner_m"),
    ],
)
def test_millimetres_are_refused(shelf_task: ShelfTask, field: str, value: object, place: str) -> None:
    expected = rf"{re.escape(place)}: must be in metres and within 10 m, found \[500, 0\.0, 440\]"
    with pytest.raises(BadInputError, match=expected):
        with_fields(shelf_task, **{field: value})


def test_start_and_goal_are_the_ends_of_the_path(shelf_task: ShelfTask) -> None:
    np.testing.assert_allclose(shelf_task.nominal_start[:3], shelf_task.waypoints[0], atol=1e-15)
    np.testing.assert_allclose(shelf_task.goal[:3], shelf_task.waypoints[-1], atol=1e-15)
    np.testing.assert_allclose(
        shelf_task.nominal_path.points[[0, -1]], [shelf_task.nominal_start[:3], shelf_task.goal[:3]], atol=1e-12
    )
    assert np.linalg.norm(shelf_task.goal[3:]) == pytest.approx(1.0, abs=1e-15)


def test_starts_fill_the_start_region_and_the_seed_fixes_them(shelf_task: ShelfTask) -> None:
    starts = shelf_task.draw_starts(np.random.default_rng(0), 2000)
    offset = (starts - shelf_task.nominal_start)[:, :3] / np.array(shelf_task.start_half_range_m)
    assert np.abs(offset).max() <= 1
    assert np.all(offset.max(axis=0) > 0.98)
    assert np.all(offset.min(axis=0) < -0.98)
    np.testing.assert_allclose(offset.std(axis=0), 1 / np.sqrt(3), atol=0.03)
    np.testing.assert_array_equal(starts, shelf_task.draw_starts(np.random.default_rng(0), 2000))


def test_tilted_starts_are_turned_by_at_most_the_tilt(shelf_task: ShelfTask) -> None:
    turning = with_fields(shelf_task, start_tilt_rad=0.1, start_quaternion=[0.0, 1.0, 0.0, 0.0])
    tilted = turning.draw_starts(np.random.default_rng(0), 500)
    angles = pose.rotation_distance(tilted, turning.nominal_start)
    assert 0.09 < angles.max() <= 0.1
    assert angles.std() > 0.02


def test_a_tilt_without_a_turn_is_refused(shelf_task: ShelfTask) -> None:
    """Start and goal are turned alike here, so there is no axis to tilt about."""
    with pytest.raises(BadInputError, match="start_tilt_rad must be 0 where start and goal"):
        with_fields(shelf_task, start_tilt_rad=0.1)


@pytest.mark.parametrize(("off_m", "off_rad"), [(0.9, 0.9), (1.1, 0.0), (0.0, 1.1), (0.0, 0.0)])
def test_the_goal_is_reached_within_both_tolerances(shelf_task: ShelfTask, off_m: float, off_rad: float) -> None:
    position = shelf_task.goal[:3] + np.array([0, off_m * shelf_task.goal_tolerance_m, 0])
    turn = pose.from_rotation_vector([0, 0, off_rad * shelf_task.goal_rotation_tolerance_rad])
    near = pose.make(position, pose.multiply(turn, shelf_task.goal[3:]))
    assert shelf_task.reached(near[None])[0] == (off_m <= 1 and off_rad <= 1)


def test_a_described_task_loads_as_itself(shelf_task: ShelfTask) -> None:
    node = described(shelf_task)
    assert described(load_settings(node, Task, "task")) == node
