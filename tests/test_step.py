import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.step import IN_PLACE, TURNS_PER_STEP, full_step, one_step

STEP, TURN = 0.0021, 0.02
AROUND = np.array([0.0, 1.0, 0.0])

places = st.lists(st.floats(-0.3, 0.3, allow_nan=False), min_size=3, max_size=3).map(np.array)
# Within half a turn of one another, where the short way is never in doubt.
turns = st.lists(st.floats(-0.7, 0.7, allow_nan=False), min_size=3, max_size=3).map(np.array)
poses = st.builds(lambda place, turn: pose.make(place, pose.from_rotation_vector(turn)), places, turns)
small = st.lists(st.floats(-0.004, 0.004, allow_nan=False), min_size=3, max_size=3).map(np.array)
headings = st.floats(-np.pi, np.pi, allow_nan=False)


def stepped(here: Array, wished: Array, goal: Array) -> Array:
    return np.asarray(one_step(here[None], wished[None], goal, room(here[None], goal), STEP, TURN)[0])


def room(here: Array, goal: Array) -> Array:
    return np.asarray(pose.position_distance(here, goal))


def made(here: Array, wished: Array, goal: Array) -> tuple[float, float]:
    """Return how far (in steps) and by how much (in turns in place) one step goes."""
    after = stepped(here, wished, goal)
    return float(pose.position_distance(after, here)) / STEP, float(pose.rotation_distance(after, here)) / TURN


def beside(here: Array, move: Array, turn: Array) -> Array:
    """A pose (7,) that is a motion [m] and a turn (3,) [rad] from another."""
    return pose.make(here[:3] + move, pose.multiply(here[3:], pose.from_rotation_vector(turn)))


def at(x: float = 0.0, turned: float = 0.0) -> Array:
    return pose.make([x, 0.0, 0.0], pose.from_rotation_vector(turned * AROUND))


def wishing(heading: float, turned: float, length: float = STEP) -> Array:
    """A pose wished from :func:`at`: a motion so many radians off the way to the goal, and a turn toward it."""
    direction = np.array([np.cos(heading), 0.0, np.sin(heading)])
    return pose.make(length * direction, pose.from_rotation_vector(turned * AROUND))


GOAL = at(0.3, 0.6)


@given(here=poses, wished=poses, goal=poses)
def test_it_is_never_longer_than_a_step_nor_a_larger_turn_than_two_and_a_half_in_place(
    here: Array, wished: Array, goal: Array
) -> None:
    moved, turned = made(here, wished, goal)
    assert moved <= 1 + 1e-9
    assert turned <= 2.4 + 1e-9


@given(heading=headings, turned=st.floats(-0.3, 0.6), length=st.floats(1e-4, 0.1))
def test_off_the_way_to_the_goal_motion_and_turn_together_are_one_step(
    heading: float, turned: float, length: float
) -> None:
    """Where there is more to turn than half a turn in place; there and on the way to the goal the step is whole."""
    assume(abs(np.cos(heading) - np.sqrt(0.75)) > 1e-3)
    assume(abs(turned - 0.45 * TURN) > 1e-6)
    moved, made_turn = made(at(), wishing(heading, turned, length), GOAL)
    if turned > 0.45 * TURN and np.cos(heading) < np.sqrt(0.75):
        assert moved**2 + made_turn**2 == pytest.approx(1.0, abs=1e-9)
        assert moved / made_turn == pytest.approx((length / STEP) / (turned / TURN), rel=1e-6)
    else:
        assert moved == pytest.approx(1.0, rel=1e-9)
        assert made_turn == pytest.approx(np.clip(turned / TURN, 0.0, 2.4), abs=1e-6)


@given(here=poses, move=small, turn=small, ahead=poses)
def test_the_goal_is_never_passed(here: Array, move: Array, turn: Array, ahead: Array) -> None:
    goal = beside(here, move, turn)
    left = pose.rotation_distance(goal, here)
    for wished in (ahead, goal, beside(here, 9 * move, 9 * turn)):
        after = stepped(here, wished, goal)
        assert pose.position_distance(after, here) <= pose.position_distance(goal, here) + 1e-12
        assert pose.rotation_distance(after, here) <= left + 1e-9
        # It turns along the way to the goal, so never away from it.
        assert pose.rotation_distance(after, goal) <= left + 1e-9


@given(here=poses, wished=places, turn=turns)
def test_with_nothing_left_to_turn_it_moves_a_whole_step_to_where_it_is_wished(
    here: Array, wished: Array, turn: Array
) -> None:
    motion = wished - here[:3]
    length = np.linalg.norm(motion)
    assume(length > 1e-6)
    goal = beside(here, np.array([0.0, 0.0, 0.5]), np.zeros(3))
    after = stepped(here, pose.make(wished, pose.multiply(here[3:], pose.from_rotation_vector(turn))), goal)
    np.testing.assert_allclose(pose.rotation_distance(after, here), 0.0, atol=1e-7)
    np.testing.assert_allclose(after[:3] - here[:3], STEP * motion / length, atol=1e-12)


@given(heading=st.floats(0.6, np.pi), lag=st.floats(0.0, 0.2), more=st.floats(0.0101, 0.2))
def test_off_the_way_to_the_goal_a_pose_that_lags_in_its_turn_moves_less_and_turns_more(
    heading: float, lag: float, more: float
) -> None:
    punctual, late = (made(at(), wishing(heading, behind), GOAL) for behind in (lag, lag + more))
    assert late[0] < punctual[0] <= 1 + 1e-12
    assert punctual[1] < late[1] <= 1 + 1e-12


@given(heading=st.floats(-0.5, 0.5), lag=st.floats(0.0, 0.5))
def test_on_the_way_to_the_goal_a_lag_costs_no_way(heading: float, lag: float) -> None:
    moved, turned = made(at(), wishing(heading, lag), GOAL)
    assert moved == pytest.approx(1.0, rel=1e-9)
    assert turned == pytest.approx(min(lag / TURN, 2.4), abs=1e-6)


def test_a_step_and_a_turn_both_wished_whole_are_both_made_by_the_same_share() -> None:
    """By hand: each is as long as can be made alone, so each is divided by √2."""
    np.testing.assert_allclose(made(at(), wishing(0.5 * np.pi, TURN), GOAL), 1 / np.sqrt(2), rtol=1e-6)


def test_a_turn_that_is_all_that_is_wished_is_made_in_place() -> None:
    after = stepped(at(), at(0.0, 0.3), GOAL)
    np.testing.assert_array_equal(after[:3], 0.0)
    assert pose.rotation_distance(after, at()) == pytest.approx(TURN, rel=1e-6)
    assert pose.rotation_distance(after, GOAL) == pytest.approx(0.6 - TURN, rel=1e-6)


def test_a_turn_away_from_the_goal_is_not_made() -> None:
    for heading in (0.0, 2.5):
        after = stepped(at(), wishing(heading, -0.3), GOAL)
        np.testing.assert_allclose(after, wishing(heading, 0.0), atol=1e-12)


def test_at_the_goal_it_stays() -> None:
    np.testing.assert_allclose(stepped(GOAL, at(0.4, 0.9), GOAL), GOAL, atol=1e-12)


def test_where_the_path_goes_on_it_does_not_stay_at_the_goal() -> None:
    after = one_step(GOAL[None], at(0.4, 0.9)[None], GOAL, np.array([np.inf]), STEP, TURN)[0]
    assert pose.position_distance(after, GOAL) == pytest.approx(STEP)
    after = full_step(GOAL[None], at(0.4, 0.9)[None], np.array([np.inf]), STEP, TURN)[0]
    assert pose.position_distance(after, GOAL) > 0.0


def test_each_row_is_stepped_by_itself() -> None:
    here, wished = np.array([at(), at(0.1, 0.2)]), np.array([wishing(2.0, 0.1), at(0.1, 0.4)])
    together = one_step(here, wished, GOAL, room(here, GOAL), STEP, TURN)
    for row in range(2):
        np.testing.assert_allclose(together[row], stepped(here[row], wished[row], GOAL), atol=1e-15)


LARGEST = TURN * TURNS_PER_STEP / IN_PLACE


def stepped_in_full(here: Array, wished: Array, goal: Array = GOAL) -> Array:
    return np.asarray(full_step(here[None], wished[None], room(here[None], goal), STEP, TURN)[0])


@given(here=poses, move=small, turn=turns)
def test_a_full_step_turns_about_any_axis_as_far_as_it_moves(here: Array, move: Array, turn: Array) -> None:
    length, angle = float(np.linalg.norm(move)), float(np.linalg.norm(turn))
    assume(length > 1e-6)
    wished = beside(here, move, turn)
    after = stepped_in_full(here, wished, beside(here, np.array([1.0, 0.0, 0.0]), turn))
    share = min(1.0, LARGEST / max(angle, 1e-12))
    np.testing.assert_allclose(after[:3] - here[:3], share * STEP / length * move, atol=1e-9)
    assert pose.rotation_distance(after, here) == pytest.approx(share * angle, abs=1e-6)
    assert pose.rotation_distance(after, wished) == pytest.approx((1.0 - share) * angle, abs=1e-6)


@given(here=poses, turn=turns)
def test_a_full_step_keeps_the_sign_of_its_quaternion(here: Array, turn: Array) -> None:
    wished = beside(here, np.array([STEP, 0.0, 0.0]), turn)
    for sign in (1.0, -1.0):
        after = stepped_in_full(here, pose.make(wished[:3], sign * wished[3:]))
        assert after[3:] @ here[3:] >= 0


def test_a_full_step_at_the_goal_turns_in_place_and_stays() -> None:
    here = beside(GOAL, np.zeros(3), np.array([0.2, 0.0, 0.0]))
    after = stepped_in_full(here, GOAL)
    np.testing.assert_allclose(after[:3], GOAL[:3], atol=1e-12)
    assert pose.rotation_distance(after, GOAL) == pytest.approx(0.2 - LARGEST, rel=1e-6)
    np.testing.assert_allclose(stepped_in_full(GOAL, at(0.4, 0.6)), GOAL, atol=1e-12)


def test_each_row_is_stepped_in_full_by_itself() -> None:
    here, wished = np.array([at(), at(0.1, 0.2)]), np.array([wishing(2.0, -0.1), at(0.1, -0.4)])
    together = full_step(here, wished, room(here, GOAL), STEP, TURN)
    for row in range(2):
        np.testing.assert_allclose(together[row], stepped_in_full(here[row], wished[row]), atol=1e-15)
