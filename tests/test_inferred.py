"""Inferring actions from demonstrated poses."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st
from imitation.inferred import BestOf, demonstrated_transitions, labels

from koopdqn import pose
from koopdqn.app.api import generate, load_config
from koopdqn.intent.fit import agent_steps
from koopdqn.pose import Array
from koopdqn.rl.network import observe
from koopdqn.rl.policy import Policy, policy_network
from koopdqn.tasks.actions import COUNT, excess, legal_actions, nearest_actions, reached_poses
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.step import IN_PLACE, one_step

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


def test_where_a_tool_turns_a_step_stands_for_what_an_action_can_do() -> None:
    """People turn and move at once; Table 1 turns in place or on the way to the goal, so that nothing is near that."""
    config = load_config("task=knife", "demo.count=2")
    task, rows = config.task, agent_steps(generate(config), config.task)
    before, after = (np.concatenate([path[part] for path in rows]) for part in (slice(None, -1), slice(1, None)))
    room = pose.position_distance(before, task.goal)
    scaled = one_step(before, after, task.goal, room, task.step_m, IN_PLACE * task.rotation_tolerance_rad)
    told = labels(before, after, task)
    reached = reached_poses(before, task)[np.arange(len(before)), told]
    assert (excess(reached, scaled, task) <= 1.0).mean() > 0.99
    raw = reached_poses(before, task)[np.arange(len(before)), nearest_actions(before, after, task)]
    assert (excess(raw, after, task) <= 1.0).mean() < 0.9


def test_of_policies_that_are_checked_the_latest_of_the_best_is_kept(shelf_task: ShelfTask) -> None:
    scores = iter([0.5, 1.0, 1.0, 0.8])
    best = BestOf(lambda policy: next(scores))
    network = policy_network(shelf_task, load_config().agent.network, continuous=False)
    kept = []
    for number in range(4):
        with torch.no_grad():
            next(network.parameters()).fill_(number)
        kept.append(best.offer(Policy(network, shelf_task)))
    values = [float(next(iter(policy.network.parameters())).detach().flatten()[0]) for policy in kept]
    assert values == [0.0, 1.0, 2.0, 2.0]


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
