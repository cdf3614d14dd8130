"""What K is replaced by: the nearest demonstrated pose's velocity, and the mean demonstration's tangent."""

import numpy as np
import pytest
from helpers_shelf import shelf, taught
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.evaluation.baselines import Greedy, mean_tangent, nearest_velocity
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task

STEP = 0.0021
# Within what one step may turn.
TURN = 0.01
# Of the line that is shown, from goal − 0.3 m along y.
COUNT = 143

offsets = st.lists(st.floats(-0.03, 0.03, allow_nan=False), min_size=2, max_size=2)
indices = st.integers(1, COUNT - 2)


def line(task: Task, count: int = COUNT, turned: float = 0.0) -> Array:
    """Return poses (count, 7) straight along y to the task's goal, turning evenly by ``turned`` [rad] a step."""
    left = np.arange(count - 1, -1, -1.0)
    position = task.goal[pose.POSITION] - STEP * left[:, None] * np.array([0.0, 1.0, 0.0])
    turn = pose.from_rotation_vector(-turned * left[:, None] * np.array([0.0, 0.0, 1.0]))
    return pose.make(position, pose.multiply(task.goal[pose.QUATERNION], turn))


def beside(here: Array, offset: list[float]) -> Array:
    """Return a pose (1, 7) beside another (7,), off in x and z [m]."""
    return np.asarray((here + np.array([offset[0], 0.0, offset[1], 0, 0, 0, 0]))[None])


@given(index=indices, offset=offsets)
def test_beside_a_straight_line_both_go_on_beside_it(shelf_task: Task, index: int, offset: list[float]) -> None:
    shown = line(shelf_task)
    here = beside(shown[index], offset)
    for prediction in (nearest_velocity([shown], shelf_task), mean_tangent([shown], shelf_task)):
        moved = prediction(here)[0, pose.POSITION] - here[0, pose.POSITION]
        np.testing.assert_allclose(moved, [0.0, STEP, 0.0], atol=1e-6)


@given(index=indices, sign=st.sampled_from([-1.0, 1.0]))
def test_a_demonstrated_pose_moves_and_turns_as_it_did(shelf_task: Task, index: int, sign: float) -> None:
    shown = line(shelf_task, turned=TURN)
    # q and −q are the same rotation.
    here = pose.make(shown[index, pose.POSITION], sign * shown[index, pose.QUATERNION])[None]
    after = nearest_velocity([shown], shelf_task)(here)
    assert pose.position_distance(after[0], shown[index + 1]) < 1e-12
    assert pose.rotation_distance(after[0], shown[index + 1]) < 1e-6


def test_the_nearest_velocity_is_that_of_the_pose_whose_orientation_is_nearer_too(shelf_task: Task) -> None:
    shown = line(shelf_task)
    other = shown[::-1].copy()
    other[:, pose.QUATERNION] = pose.multiply(shown[:, pose.QUATERNION], pose.from_rotation_vector([0.0, 0.5, 0.0]))
    prediction = nearest_velocity([shown, other], shelf_task)
    for rows, way in ((shown, 1.0), (other, -1.0)):
        here = rows[50][None]
        assert (prediction(here) - here)[0, 1] == pytest.approx(way * STEP)


@given(index=indices, offset=offsets, lag=st.floats(0.0, 0.5))
def test_the_tangent_turns_as_the_mean_is_turned_a_step_on_whatever_is_left(
    shelf_task: Task, index: int, offset: list[float], lag: float
) -> None:
    shown = line(shelf_task, turned=TURN)
    here = beside(shown[index], offset)
    here[:, pose.QUATERNION] = pose.multiply(here[:, pose.QUATERNION], pose.from_rotation_vector([0.0, 0.0, -lag]))
    after = mean_tangent([shown], shelf_task)(here)
    # The mean is sampled every half millimetre, the turn of a quarter of a step.
    assert pose.rotation_distance(after[0], shown[index + 1]) < 0.5 * TURN


@given(offset=offsets)
def test_beyond_the_end_of_what_was_shown_the_goal_is_next(shelf_task: Task, offset: list[float]) -> None:
    shown = line(shelf_task)
    here = beside(shown[-1], offset)
    here[:, 1] += 0.01
    for prediction in (nearest_velocity([shown], shelf_task), mean_tangent([shown], shelf_task)):
        np.testing.assert_array_equal(prediction(here)[0], shelf_task.goal)


def test_a_turn_in_place_goes_on_to_the_goal(shelf_task: Task) -> None:
    shown = line(shelf_task, turned=TURN)
    shown[:, pose.POSITION] = shelf_task.goal[pose.POSITION]
    for prediction in (nearest_velocity([shown], shelf_task), mean_tangent([shown], shelf_task)):
        after = prediction(shown[50][None])
        before_it, after_it = (pose.rotation_distance(rows, shelf_task.goal) for rows in (shown[50], after[0]))
        assert after_it < before_it


def test_in_place_of_k_they_are_told_poses_in_the_start_frame() -> None:
    task, known = shelf().task, taught()
    frame = StartFrame(task.nominal_start[pose.POSITION], task.goal[pose.POSITION], follows=True)
    model, seen = known.model.within(frame), list[Array]()

    def instead(poses: Array) -> Array:
        seen.append(poses)
        return model.predict(poses)

    poses = known.trajectories[0][10:60:10]
    starts = np.repeat(known.trajectories[0][:1], len(poses), axis=0)
    actions = Greedy(model, task, instead)(poses, starts)
    np.testing.assert_array_equal(seen[0], frame.to_frame(poses, starts))
    np.testing.assert_array_equal(actions, Greedy(model, task)(poses, starts))
