"""The baselines: the straight line, greedy on the intent model, replaying a demonstration."""

import numpy as np
from helpers_shelf import held_out, shelf, taught
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.evaluation.baselines import Greedy, replay_path, straight_path
from koopdqn.pose import Array
from koopdqn.tasks.actions import excess, legal_actions, reached_poses
from koopdqn.tasks.rollout import SUCCESS, follow, roll_out
from koopdqn.tasks.step import TURNS_PER_STEP


@st.composite
def poses(draw: st.DrawFn) -> Array:
    numbers = st.floats(-0.4, 0.4, allow_nan=False)
    position = [draw(numbers) for _ in range(3)]
    turn = np.array([draw(numbers) for _ in range(3)])
    return pose.make(position, pose.from_rotation_vector(4 * turn))


@given(start=poses(), end=poses())
def test_a_straight_path_goes_from_start_to_end_in_equal_steps_and_equal_turns(start: Array, end: Array) -> None:
    task = shelf().task
    path = straight_path(start, end, task)
    assert pose.position_distance(path[[0, -1]], np.array([start, end])).max() < 1e-12
    assert pose.rotation_distance(path[[0, -1]], np.array([start, end])).max() < 1e-7
    steps, turns = pose.position_distance(path[1:], path[:-1]), pose.rotation_distance(path[1:], path[:-1])
    assert np.allclose(steps, pose.position_distance(start, end) / max(1, len(steps)), atol=1e-9)
    assert np.allclose(turns, pose.rotation_distance(start, end) / max(1, len(turns)), atol=1e-6)
    assert np.all(steps <= task.step_m * (1 + 1e-6))
    assert np.all(turns <= TURNS_PER_STEP * task.rotation_tolerance_rad + 1e-6)


@given(start=poses(), end=poses())
def test_a_straight_path_turns_and_moves_no_further_than_it_must(start: Array, end: Array) -> None:
    path = straight_path(start, end, shelf().task)
    steps, turns = pose.position_distance(path[1:], path[:-1]), pose.rotation_distance(path[1:], path[:-1])
    assert np.isclose(steps.sum(), pose.position_distance(start, end), atol=1e-9)
    assert np.isclose(turns.sum(), pose.rotation_distance(start, end), atol=1e-5)


def test_a_straight_path_of_whole_steps_has_as_many() -> None:
    task = shelf().task
    start = task.nominal_start
    for count in (0, 1, 2, 7, 100):
        end = start + np.array([count * task.step_m, 0, 0, 0, 0, 0, 0])
        assert len(straight_path(start, end, task)) == count + 1


def test_the_straight_line_never_reaches_the_shelfs_goal() -> None:
    cell, (starts, joints) = shelf(), held_out(6)
    paths = [straight_path(start, cell.task.goal, cell.task) for start in starts]
    outcomes = [episode.outcome for episode in follow(paths, cell.task, cell.reachability, joints)]
    assert outcomes == ["collision"] * 6


def test_greedy_takes_the_nearest_legal_action() -> None:
    task, model = shelf().task, taught().model
    states = taught().trajectories[0][::10]
    reached = reached_poses(states, task)
    far = excess(reached, model.predict_step(states, task.step_m)[:, None], task)
    for row, action in enumerate(Greedy(model, task)(states, states)):
        assert legal_actions(task)[action]
        assert far[row, action] == far[row, legal_actions(task)].min()


def test_greedy_reaches_the_goal_from_where_it_was_shown() -> None:
    cell, known = shelf(), taught()
    starts = np.array([trajectory[0] for trajectory in known.trajectories])
    joints = np.array([cell.reachability.enter(start).joints for start in starts])
    greedy, limit = Greedy(known.model, cell.task), 3 * max(map(len, known.trajectories))
    episodes = roll_out(greedy, cell.task, cell.reachability, starts, joints, limit)
    assert [episode.outcome for episode in episodes] == [SUCCESS] * len(starts)


def test_replaying_goes_straight_to_the_nearest_start_and_then_as_recorded() -> None:
    task, trajectories = shelf().task, taught().trajectories
    for start in held_out(6)[0]:
        path = replay_path(start, trajectories, task)
        apart = [float(np.linalg.norm(trajectory[0, :3] - start[:3])) for trajectory in trajectories]
        nearest = trajectories[int(np.argmin(apart))]
        approach = len(path) - len(nearest)
        assert np.array_equal(path[approach + 1 :], nearest[1:])
        assert np.isclose(np.linalg.norm(np.diff(path[: approach + 1, :3], axis=0), axis=1).sum(), min(apart))
        assert pose.position_distance(path[1:], path[:-1]).max() <= task.step_m * (1 + 1e-9)


def test_replaying_from_a_demonstrations_own_start_succeeds_along_it() -> None:
    cell, trajectories = shelf(), taught().trajectories
    starts = np.array([trajectory[0] for trajectory in trajectories])
    joints = np.array([cell.reachability.enter(start).joints for start in starts])
    paths = [replay_path(start, trajectories, cell.task) for start in starts]
    episodes = follow(paths, cell.task, cell.reachability, joints)
    for episode, trajectory in zip(episodes, trajectories, strict=True):
        assert episode.outcome == SUCCESS
        gaps = np.linalg.norm(episode.poses[:, None, :3] - trajectory[None, :, :3], axis=2).min(axis=1)
        assert gaps.max() < 1e-9
