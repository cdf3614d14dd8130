import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import straight_poses

from koopdqn import pose
from koopdqn.app.api import load_config, open_workcell
from koopdqn.errors import BadInputError
from koopdqn.robot.ur import URArm
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import COLLISION, Workcell


def test_the_demonstrated_path_matters_because_the_straight_line_hits_the_shelf(workcell: Workcell) -> None:
    task = workcell.task
    for start in [task.nominal_start, *task.draw_starts(np.random.default_rng(0), 20)]:
        line = straight_poses(start[:3], task.goal[:3], 200, task.goal[3:])
        joints, reason = workcell.reachability.follow(line)
        assert joints is None
        assert reason == COLLISION


def test_the_demonstrator_touches_nothing_on_the_way(workcell: Workcell) -> None:
    task = workcell.task
    starts, _, _ = workcell.reachability.draw_starts(task, np.random.default_rng(1), 10)
    for start in starts:
        joints, reason = workcell.reachability.follow(task.demonstrator.roll_out(start, 1000))
        assert reason == ""
        assert joints is not None
        assert all(workcell.scene.contact(row) == "" for row in joints)


def test_the_bottle_stands_clear_at_start_and_goal(workcell: Workcell) -> None:
    for point in (workcell.task.nominal_start, workcell.task.goal):
        joints = workcell.reachability.enter(point).joints
        assert joints is not None
        assert workcell.scene.payload_clearance(joints) >= 0.010


def test_path_and_start_region_are_as_large_as_they_must_be(shelf_task: ShelfTask) -> None:
    assert shelf_task.nominal_path.length >= 0.4
    assert min(shelf_task.start_half_range_m) >= 0.04


def test_orientation_is_held(shelf_task: ShelfTask) -> None:
    assert shelf_task.orientation == "held"
    assert pose.rotation_distance(shelf_task.nominal_start, shelf_task.goal) < 1e-9


unit_axes = (
    st.lists(st.floats(-1, 1, allow_nan=False), min_size=3, max_size=3)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)


@given(axis=unit_axes, angle=st.floats(0, 0.1))
def test_the_rule_is_about_tilt_from_upright_and_not_about_turning_round_the_upright(
    shelf_task: ShelfTask, axis: np.ndarray, angle: float
) -> None:
    turned = pose.make(shelf_task.goal[:3], pose.multiply(pose.from_rotation_vector(angle * axis), shelf_task.goal[3:]))
    before, after = (pose.rotate(q, [1.0, 0.0, 0.0]) for q in (shelf_task.goal[3:], turned[3:]))
    # The independent measure: half the chord between the two axes is the sine of half the tilt.
    tilt = 2 * np.arcsin(0.5 * np.linalg.norm(after - before))
    if abs(tilt - shelf_task.max_tilt_rad) > 1e-9:
        assert shelf_task.rule_broken(turned[None])[0] == (tilt > shelf_task.max_tilt_rad)


def test_half_a_degree_of_tilt_is_the_limit(shelf_task: ShelfTask) -> None:
    assert shelf_task.max_tilt_rad == pytest.approx(np.radians(0.5), rel=1e-4)
    upright = pose.rotate(shelf_task.goal[3:], [1.0, 0.0, 0.0])
    round_upright, tilting = upright * 0.5, pose.rotate(shelf_task.goal[3:], [0.0, 1.0, 0.0])
    for vector, broken in ((round_upright, False), (tilting * np.radians(0.49), False), (tilting * 0.009, True)):
        turned = pose.make(shelf_task.goal[:3], pose.multiply(pose.from_rotation_vector(vector), shelf_task.goal[3:]))
        assert shelf_task.rule_broken(turned[None])[0] == broken


def test_the_scene_names_what_the_bottle_hits(workcell: Workcell, arm: URArm) -> None:
    into_wall = pose.make([0.56, -0.03, 0.47], workcell.task.goal[3:])
    joints = arm.inverse(into_wall, arm.home).joints
    touching = workcell.scene.contact(joints)
    assert "shelf_right" in touching
    assert "bottle" in touching or "gripper" in touching


def test_a_smaller_arm_gets_a_smaller_shelf_and_the_same_steps(shelf_task: ShelfTask) -> None:
    small = shelf_task.scaled(0.5)
    assert small.nominal_path.length == pytest.approx(0.5 * shelf_task.nominal_path.length)
    np.testing.assert_allclose(small.goal[:3], 0.5 * shelf_task.goal[:3])
    np.testing.assert_allclose(small.compartment_corner_m, 0.5 * np.array(shelf_task.compartment_corner_m))
    assert (small.step_m, small.goal_tolerance_m) == (shelf_task.step_m, shelf_task.goal_tolerance_m)
    assert shelf_task.scaled(1.0) is shelf_task


@pytest.mark.parametrize("robot", ["ur3", "ur3e"])
def test_small_arms_follow_the_demonstrator_where_the_straight_line_hits_the_shelf(robot: str) -> None:
    config = load_config("task=shelf", f"robot={robot}")
    cell, task = open_workcell(config), config.task
    joints, reason = cell.reachability.follow(task.demonstrator.roll_out(task.nominal_start, 1000))
    assert joints is not None, reason
    line = straight_poses(task.nominal_start[:3], task.goal[:3], 200, task.goal[3:])
    assert cell.reachability.follow(line)[1] == COLLISION


def test_a_task_that_does_not_scale_says_what_the_arm_cannot_reach() -> None:
    with pytest.raises(BadInputError, match="out of reach"):
        open_workcell(load_config("task=shelf", "robot=ur3", "robot.task_scale=1"))
