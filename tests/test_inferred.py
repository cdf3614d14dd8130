"""Inferring actions from demonstrated poses."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from imitation.inferred import demonstrated_transitions

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.rl.network import observe
from koopdqn.tasks.actions import COUNT, excess, legal_actions, nearest_actions, reached_poses
from koopdqn.tasks.shelf import ShelfTask

seeds = st.integers(0, 10_000)


def states(task: ShelfTask, seed: int, count: int = 5) -> Array:
    return task.draw_starts(np.random.default_rng(seed), count)


@given(seed=seeds, action=st.integers(0, COUNT - 1))
def test_an_action_is_inferred_from_the_pose_it_reaches(shelf_task: ShelfTask, seed: int, action: int) -> None:
    poses = states(shelf_task, seed)
    wished = reached_poses(poses, shelf_task)[:, action]
    inferred = nearest_actions(poses, wished, shelf_task)
    assert legal_actions(shelf_task)[inferred].all()
    if legal_actions(shelf_task)[action]:
        reached = reached_poses(poses, shelf_task)[np.arange(len(poses)), inferred]
        assert pose.position_distance(reached, wished).max() < 1e-12


@given(seed=seeds)
def test_no_legal_action_is_nearer_than_the_inferred_one(shelf_task: ShelfTask, seed: int) -> None:
    poses = states(shelf_task, seed)
    wished = shelf_task.demonstrator.next_pose(poses)
    far = excess(reached_poses(poses, shelf_task), wished[:, None], shelf_task)[:, legal_actions(shelf_task)]
    inferred = excess(
        reached_poses(poses, shelf_task)[np.arange(len(poses)), nearest_actions(poses, wished, shelf_task)],
        wished,
        shelf_task,
    )
    np.testing.assert_array_equal(inferred, far.min(axis=1))


def test_every_step_is_a_transition_and_each_demonstration_ends_once(
    shelf_task: ShelfTask, trajectories: list[Array]
) -> None:
    shown = demonstrated_transitions(trajectories, shelf_task)
    ends = np.flatnonzero(shown.terminated)
    assert len(ends) == len(trajectories)
    assert ends[-1] == len(shown.actions) - 1
    # Within a demonstration one transition begins where the one before ended; across two it does not.
    joined = (shown.next_observations[:-1] == shown.observations[1:]).all(axis=1)
    np.testing.assert_array_equal(joined, ~shown.terminated[:-1])
    starts = observe(np.array([trajectory[0] for trajectory in trajectories]), shelf_task)
    np.testing.assert_array_equal(shown.observations[[0, *(ends[:-1] + 1)]], starts)


def test_nothing_after_the_goal_is_shown(shelf_task: ShelfTask, trajectories: list[Array]) -> None:
    idle = [np.concatenate([trajectory, np.repeat(trajectory[-1:], 9, axis=0)]) for trajectory in trajectories]
    shown, longer = demonstrated_transitions(trajectories, shelf_task), demonstrated_transitions(idle, shelf_task)
    assert shelf_task.reached(trajectories[0][-1:])[0]
    np.testing.assert_array_equal(longer.observations, shown.observations)
    assert not shelf_task.reached(shown.poses).any()


def test_a_demonstration_that_stops_short_of_the_goal_ends_at_its_last_pose(
    shelf_task: ShelfTask, trajectories: list[Array]
) -> None:
    short = demonstrated_transitions([trajectories[0][:20]], shelf_task)
    assert len(short.actions) == 19
    np.testing.assert_array_equal(np.flatnonzero(short.terminated), [18])
