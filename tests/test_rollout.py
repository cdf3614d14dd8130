"""Rolling a controller out, and following a path: how episodes end and what they hold."""

import numpy as np
import pytest
from helpers_shelf import held_out, shelf, taught

from koopdqn import pose
from koopdqn.evaluation.baselines import Greedy, straight_path
from koopdqn.pose import Array
from koopdqn.tasks.actions import ACTIONS, reached_poses, twists_between
from koopdqn.tasks.rollout import (
    FAILURES,
    OFF_GOAL,
    RULE_BROKEN,
    STEP_LIMIT,
    STUCK,
    SUCCESS,
    Controller,
    Episode,
    follow,
    roll_out,
)
from koopdqn.tasks.workcell import COLLISION, JUMP, UNREACHABLE, Motion

TURN_TO_GOAL = ACTIONS.index("moves only in rotation toward the goal")
TO_GOAL = ACTIONS.index("moves only in position toward the goal")


def always(action: int) -> Controller:
    return lambda poses, starts: np.full(len(poses), action)


def rolled(controller: Controller, count: int = 2, limit: int = 700) -> list[Episode]:
    cell = shelf()
    starts, joints = held_out(count)
    return roll_out(controller, cell.task, cell.reachability, starts, joints, limit)


def greedy() -> Greedy:
    return Greedy(taught().model, shelf().task)


def test_every_step_is_the_chosen_action_and_the_joints_reach_it() -> None:
    cell = shelf()
    for episode in rolled(greedy()):
        actions = greedy()(episode.poses[:-1], np.repeat(episode.poses[:1], episode.steps, axis=0))
        chosen = reached_poses(episode.poses[:-1], cell.task)[np.arange(episode.steps), actions]
        assert np.array_equal(chosen, episode.poses[1:])
        assert pose.position_distance(cell.arm.forward(episode.joints), episode.poses).max() < 1e-9
        assert len(episode.joints) == len(episode.poses) == episode.steps + 1


def test_success_is_the_first_pose_at_the_goal_and_the_episode_ends_there() -> None:
    task = shelf().task
    for episode in rolled(greedy()):
        assert episode.outcome == SUCCESS
        assert task.reached(episode.poses).tolist() == [False] * episode.steps + [True]


def to_goal_in_twists(poses: Array, starts: Array) -> Array:
    return twists_between(poses, np.repeat(shelf().task.goal[None], len(poses), axis=0), shelf().task)


def beside_the_goal() -> tuple[Array, Array]:
    """A start (1, 7) three tolerances in front of the goal, and its joints (1, 6)."""
    cell = shelf()
    episode = rolled(greedy(), 1)[0]
    away = pose.position_distance(episode.poses, cell.task.goal)
    row = [int(np.argmax(away < 3 * cell.task.goal_tolerance_m))]
    return episode.poses[row], episode.joints[row]


def test_twists_go_on_within_the_tolerance_to_the_goal_itself() -> None:
    cell = shelf()
    start, joints = beside_the_goal()
    episode = roll_out(to_goal_in_twists, cell.task, cell.reachability, start, joints, 50)[0]
    away = pose.position_distance(episode.poses, cell.task.goal)
    assert episode.outcome == SUCCESS
    assert (away <= cell.task.goal_tolerance_m).sum() >= 2
    assert away[-1] < 1e-9
    assert (np.diff(away) < 0).all()


@pytest.mark.parametrize("share", [-1.0, 0.0, 0.05])
def test_twists_within_the_tolerance_that_come_no_nearer_end_a_success(share: float) -> None:
    """Away from the goal, nowhere, and hardly nearer: the step is not made."""
    cell = shelf()
    start, joints = beside_the_goal()

    def choose(poses: Array, starts: Array) -> Array:
        return to_goal_in_twists(poses, starts) * (share if cell.task.reached(poses)[0] else 1.0)

    episode = roll_out(choose, cell.task, cell.reachability, start, joints, 50)[0]
    assert episode.outcome == SUCCESS
    assert cell.task.reached(episode.poses).tolist() == [False] * episode.steps + [True]


def test_what_the_arm_cannot_do_within_the_tolerance_takes_no_success_away() -> None:
    cell = shelf()
    start, joints = beside_the_goal()

    def moves(reached: Array, before: Array, joints: Array, starts: Array, steps: np.ndarray) -> list[Motion]:
        if cell.task.reached(before)[0]:
            return [Motion(None, COLLISION, "as if")]
        return cell.reachability.move_batch(reached, joints)

    episode = roll_out(to_goal_in_twists, cell.task, cell.reachability, start, joints, 50, moves=moves)[0]
    assert (episode.outcome, episode.detail) == (SUCCESS, "")
    assert cell.task.reached(episode.poses).sum() == 1


def test_the_step_limit_within_the_tolerance_is_a_success() -> None:
    cell = shelf()
    start, joints = beside_the_goal()
    whole = roll_out(to_goal_in_twists, cell.task, cell.reachability, start, joints, 50)[0]
    first = int(np.argmax(cell.task.reached(whole.poses)))
    assert first < whole.steps
    episode = roll_out(to_goal_in_twists, cell.task, cell.reachability, start, joints, first)[0]
    assert (episode.outcome, episode.steps) == (SUCCESS, first)


def test_an_action_that_changes_nothing_is_stuck() -> None:
    # Orientation is the goal's already, so turning to it moves nothing.
    for episode in rolled(always(TURN_TO_GOAL)):
        assert (episode.outcome, episode.steps) == (STUCK, 1)


@pytest.mark.parametrize("seed", range(5))
def test_an_action_that_changes_nothing_is_stuck_in_any_orientation(seed: int) -> None:
    # A quaternion is away from itself by a rounding error.
    cell = shelf()
    quaternion = pose.normalized(np.random.default_rng(seed).normal(size=4))
    task = cell.task.model_copy(update={"start_quaternion": quaternion, "goal_quaternion": quaternion})
    still = lambda reached, before, joints, starts, steps: [Motion(row) for row in joints]  # noqa: E731
    starts = pose.make(task.nominal_start[None, :3], task.goal[pose.QUATERNION])
    episode = roll_out(always(TURN_TO_GOAL), task, cell.reachability, starts, np.zeros((1, 6)), 9, moves=still)[0]
    assert (episode.outcome, episode.steps) == (STUCK, 1)


def test_a_collision_ends_the_episode_before_it_happens_and_says_what_touched() -> None:
    for episode in rolled(always(TO_GOAL)):
        assert episode.outcome == COLLISION
        assert "shelf" in episode.detail
        assert not any(shelf().scene.contact(row) for row in episode.joints)


@pytest.mark.parametrize(("jump", "cause"), [(0.4, JUMP), (2.0, UNREACHABLE)])
def test_a_jump_is_a_failure_by_its_own_cause_and_the_arm_stays(jump: float, cause: str) -> None:
    cell = shelf()
    starts, joints = held_out(1)
    path = np.array([starts[0], starts[0] - [jump, 0, 0, 0, 0, 0, 0], starts[0]])
    episode = follow([path], cell.task, cell.reachability, joints)[0]
    assert (episode.outcome, episode.steps) == (cause, 0)
    assert episode.detail


@pytest.mark.parametrize("limit", [1, 7])
def test_the_step_limit_bounds_every_episode(limit: int) -> None:
    for episode in rolled(greedy(), limit=limit):
        assert (episode.outcome, episode.steps) == (STEP_LIMIT, limit)


def test_going_round_in_circles_is_cut_where_it_closes_and_nothing_else_is() -> None:
    cell = shelf()
    starts, joints = held_out(2)
    ways = {0.0: 4, 1.0: 6, 2.0: 5, 3.0: 7}  # +x, +y, -x, -y

    def square(poses: Array, begun: Array) -> np.ndarray:
        x, y = np.round((poses - begun)[:, :2] / cell.task.step_m).T
        corner = np.select([(x == 0) & (y == 0), (x == 1) & (y == 0), (x == 1) & (y == 1)], [0.0, 1.0, 2.0], 3.0)
        return np.array([ways[each] for each in corner])

    for episode in roll_out(square, cell.task, cell.reachability, starts, joints, 50, cut_circles=True):
        assert (episode.outcome, episode.steps) == (STEP_LIMIT, 5)
        np.testing.assert_allclose(episode.poses[5], episode.poses[1], atol=1e-12)
    for whole, cut in zip(
        rolled(greedy()),
        roll_out(greedy(), cell.task, cell.reachability, starts, joints, 700, cut_circles=True),
        strict=True,
    ):
        assert cut.outcome == whole.outcome == SUCCESS
        np.testing.assert_array_equal(cut.poses, whole.poses)


def test_episodes_do_not_depend_on_which_others_run_beside_them() -> None:
    cell = shelf()
    together = rolled(greedy(), count=3)
    starts, joints = held_out(3)
    alone = [
        roll_out(greedy(), cell.task, cell.reachability, starts[i : i + 1], joints[i : i + 1], 700)[0] for i in range(3)
    ]
    for one, other in zip(together, alone, strict=True):
        assert one.outcome == other.outcome
        assert one.poses.shape == other.poses.shape
        assert np.allclose(one.poses, other.poses, atol=1e-9)


def test_following_a_path_that_breaks_the_rule_ends_where_it_does() -> None:
    cell = shelf()
    starts, joints = held_out(1)
    tilts = np.linspace(0.0, 2 * cell.task.model_dump()["max_tilt_rad"], 11)
    tilted = pose.multiply(starts[0, 3:], pose.from_rotation_vector(tilts[:, None] * [0.0, 1.0, 0.0]))
    path = pose.make(starts[0, :3], tilted)
    episode = follow([path], cell.task, cell.reachability, joints)[0]
    assert episode.outcome == RULE_BROKEN
    assert cell.task.rule_broken(episode.poses).tolist() == [False] * episode.steps + [True]


def test_following_a_path_that_ends_short_of_the_goal_is_no_success() -> None:
    cell = shelf()
    starts, joints = held_out(1)
    end = starts[0] - [0.01, 0, 0, 0, 0, 0, 0]
    episode = follow([straight_path(starts[0], end, cell.task)], cell.task, cell.reachability, joints)[0]
    assert episode.outcome == OFF_GOAL
    assert np.allclose(episode.poses[-1], end)


def test_every_outcome_but_success_is_a_failure() -> None:
    assert {STEP_LIMIT, STUCK, OFF_GOAL, RULE_BROKEN, COLLISION, UNREACHABLE, JUMP} == set(FAILURES)
    assert SUCCESS not in FAILURES
