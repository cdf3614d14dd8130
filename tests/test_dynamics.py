"""Executing a joint path in MuJoCo dynamics."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from helpers_shelf import held_out, shelf

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import straight_path
from koopdqn.evaluation.dynamics import Execution, play, summarise
from koopdqn.evaluation.metrics import reference_paths
from koopdqn.pose import Array
from koopdqn.tasks.workcell import Workcell, build_scene


@cache
def path() -> Array:
    """Return the joints along a demonstrator's path."""
    cell = shelf()
    joints, reason = cell.reachability.follow(reference_paths(cell.task, held_out(1)[0], 700)[0])
    assert joints is not None, reason
    return joints


def execute(cell: Workcell, joints: Array, time_scale: float) -> Execution:
    return play(cell, joints, time_scale * cell.reachability.durations(joints))


@cache
def executed(time_scale: float) -> Execution:
    return execute(shelf(), path(), time_scale)


def fresh() -> Workcell:
    """Return a shelf workcell whose model may be changed."""
    cell = shelf()
    return replace(cell, scene=build_scene(cell.task, cell.arm))


def test_the_arm_follows_within_a_millimetre_and_within_its_limits() -> None:
    execution = executed(2.0)
    assert execution.tracking_error_mm.max() < 1.0
    assert 0 < execution.speed_ratio < 1
    assert 0 < execution.torque_ratio < 1
    assert (execution.contact_steps, execution.first_contact) == (0, "")


def test_the_arm_ends_where_it_was_sent_and_does_not_sag() -> None:
    assert executed(2.0).sag_mm < 1e-3


def test_slower_is_truer_and_takes_less_speed() -> None:
    slow, fast = executed(6.0), executed(2.0)
    assert slow.tracking_error_mm.mean() < 0.5 * fast.tracking_error_mm.mean()
    assert slow.speed_ratio < 0.6 * fast.speed_ratio
    assert len(slow.joints) == pytest.approx(3 * len(fast.joints), abs=2)


@pytest.mark.parametrize("time_scale", [1.0, 1.03, 1.77, np.pi])
def test_any_ratio_of_the_two_time_steps_keeps_the_paths_time(time_scale: float) -> None:
    cell, rows = shelf(), path()[:60]
    execution = execute(cell, rows, time_scale)
    duration = (len(rows) - 1) * time_scale * cell.arm.step_seconds
    simulated = len(execution.joints) * execution.physics_seconds
    assert duration - 1e-9 <= simulated < duration + execution.physics_seconds
    # Half-way in time the arm is half-way along the rows: a ratio rounded to whole steps would have drifted off.
    middle = execution.joints[round(0.5 * duration / execution.physics_seconds)]
    expected = np.array([np.interp(0.5 * (len(rows) - 1), np.arange(len(rows)), column) for column in rows.T])
    apart = float(pose.position_distance(cell.arm.forward(middle), cell.arm.forward(expected)))
    assert apart < 1.5e-3


def test_the_scenes_own_state_is_left_alone() -> None:
    scene = shelf().scene
    scene.place(path()[0])
    before, clock = scene.data.qpos.copy(), scene.data.time
    execute(shelf(), path()[:20], 1.0)
    assert np.array_equal(scene.data.qpos, before)
    assert scene.data.time == clock


def test_the_same_path_gives_the_same_numbers() -> None:
    again = execute(shelf(), path(), 2.0)
    assert np.array_equal(again.joints, executed(2.0).joints)


def test_an_arm_that_stands_still_carries_only_its_weight() -> None:
    cell = shelf()
    execution = execute(cell, np.repeat(path()[:1], 5, axis=0), 1.0)
    assert execution.tracking_error_mm.max() < 1e-6
    assert execution.speed_ratio < 1e-9
    assert 0.05 < execution.torque_ratio < 0.5


def test_driving_into_the_shelf_is_told_as_a_contact() -> None:
    cell = shelf()
    start = held_out(1)[0][0]
    rows = [held_out(1)[1][0]]
    for reached in straight_path(start, cell.task.goal, cell.task)[1:]:
        result = cell.arm.inverse(reached, rows[-1])
        assert result.success
        rows.append(result.joints)
    execution = execute(cell, np.array(rows), 2.0)
    assert execution.contact_steps > 0
    assert "shelf" in execution.first_contact
    report = summarise([executed(2.0), execution], 2.0, 0.02)
    assert report.contacts.model_dump() == {
        "episodes": 1,
        "steps": execution.contact_steps,
        "first": execution.first_contact,
    }


def test_without_gravity_compensation_the_arm_sags() -> None:
    cell = fresh()
    cell.scene.model.body_gravcomp[:] = 0.0
    assert execute(cell, np.repeat(path()[:1], 3, axis=0), 1.0).sag_mm > 0.5


def test_the_set_points_lead_by_the_actuators_lag() -> None:
    cell = fresh()
    servos = cell.scene.actuator_index
    cell.scene.model.actuator_biasprm[servos, 2] *= 2.0
    # Twice the damping is twice the lag; led by it, the flange still keeps up.
    assert execute(cell, path(), 4.0).tracking_error_mm.mean() < 0.2


def test_a_motor_without_stiffness_is_refused() -> None:
    cell = fresh()
    cell.scene.model.actuator_biasprm[cell.scene.actuator_index[2], 1] = 0.0
    with pytest.raises(BadInputError, match=r"elbow_joint must be a position actuator .* found biasprm\[1\] = 0"):
        execute(cell, path(), 1.0)


@pytest.mark.parametrize("rows", [0, 1])
def test_a_path_of_less_than_two_rows_is_refused(rows: int) -> None:
    with pytest.raises(BadInputError, match=rf"T >= 2, found \({rows}, 6\)"):
        execute(shelf(), path()[:rows], 1.0)


def test_the_summary_takes_means_of_paths_and_the_largest_of_all() -> None:
    one, other = executed(2.0), executed(6.0)
    report = summarise([one, other], 2.0, 0.02)
    means = [one.tracking_error_mm.mean(), other.tracking_error_mm.mean()]
    assert report.tracking_error_mm.mean == pytest.approx(np.mean(means))
    assert report.tracking_error_mm.max == max(one.tracking_error_mm.max(), other.tracking_error_mm.max())
    assert report.peak_joint_speed_ratio == one.speed_ratio
    assert report.step_seconds == pytest.approx(0.04)


def test_no_executions_give_a_report_without_numbers() -> None:
    report = summarise([], 2.0, 0.02).model_dump(mode="json")
    assert report["episodes"] == 0
    assert report["peak_joint_torque_ratio"] is None
    assert report["tracking_error_mm"] == {"mean": None, "max": None}
    assert json.loads(json.dumps(report, allow_nan=False)) == report
