import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import STILL, StartFrame

START, GOAL = np.array([0.5, -0.2, 0.4]), np.array([0.6, 0.15, 0.5])
FRAME = StartFrame(START, GOAL, follows=True)
LENGTH = float(np.linalg.norm(GOAL - START))

# Starts beside the nominal one by up to a fifth of the way, and poses anywhere around.
offsets = st.lists(st.floats(-0.04, 0.04, allow_nan=False), min_size=3, max_size=3).map(np.array)
places = st.lists(st.floats(-0.3, 0.3, allow_nan=False), min_size=3, max_size=3).map(np.array)
turns = st.lists(st.floats(-1.5, 1.5, allow_nan=False), min_size=3, max_size=3).map(pose.from_rotation_vector)


def starting(offset: Array) -> Array:
    return pose.make(START + offset, [1.0, 0.0, 0.0, 0.0])


@given(place=places, turn=turns, offset=offsets, guess=places)
def test_what_was_placed_comes_back_from_wherever_it_is_looked_for(
    place: Array, turn: Array, offset: Array, guess: Array
) -> None:
    here, start = pose.make(GOAL + place, turn), starting(offset)
    placed = FRAME.to_frame(here, start)
    for near in (here, placed, pose.make(GOAL + guess, turn)):
        # The error shrinks by the share of the way that the start is off, twelve times.
        share = np.linalg.norm(offset) / (LENGTH - np.linalg.norm(offset))
        bound = pose.position_distance(near, here) * share**12 + 1e-12
        assert pose.position_distance(FRAME.from_frame(placed, start, near), here) <= bound
    back = FRAME.from_frame(placed, start, placed)
    np.testing.assert_allclose(back, here, atol=1e-6)
    np.testing.assert_array_equal(back[3:], here[3:])
    np.testing.assert_array_equal(placed[3:], here[3:])


@pytest.mark.parametrize("share", [0.2, 0.7, 0.95, 1.05, 1.7])
def test_along_a_path_that_begins_much_nearer_to_the_goal_a_step_comes_back_as_one(share: float) -> None:
    # The start lies on the straight way, its offset ``share`` times as long as what is left.
    left = LENGTH / (1.0 + share)
    way = (GOAL - START) / LENGTH
    places = GOAL - np.linspace(left, 0.0, 60)[:, None] * way
    path = pose.make(places, [1.0, 0.0, 0.0, 0.0])
    starts = np.repeat(path[:1], len(path) - 1, axis=0)
    placed = FRAME.to_frame(path[1:], starts)
    back = FRAME.from_frame(placed, starts, path[:-1])
    assert pose.position_distance(FRAME.to_frame(back, starts), placed).max() < 2e-4
    assert pose.position_distance(back, path[1:]).max() < 2e-4


@given(offset=offsets)
def test_every_start_is_placed_at_the_nominal_one_and_the_goal_stays(offset: Array) -> None:
    start = starting(offset)
    np.testing.assert_allclose(FRAME.to_frame(start, start)[:3], START, atol=1e-15)
    goal = pose.make(GOAL, [0.0, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(FRAME.to_frame(goal, start), goal)
    np.testing.assert_array_equal(FRAME.from_frame(goal, start, goal), goal)


@given(place=places, turn=turns)
def test_from_the_nominal_start_every_pose_stays(place: Array, turn: Array) -> None:
    here = pose.make(GOAL + place, turn)
    np.testing.assert_array_equal(FRAME.to_frame(here, starting(np.zeros(3))), here)


@given(place=places, offset=offsets)
def test_the_offset_of_the_start_fades_with_the_distance_left(place: Array, offset: Array) -> None:
    here, start = pose.make(GOAL + place, [1.0, 0.0, 0.0, 0.0]), starting(offset)
    share = min(1.0, float(np.linalg.norm(place)) / float(np.linalg.norm(start[:3] - GOAL)))
    np.testing.assert_allclose(FRAME.to_frame(here, start)[:3], here[:3] - share * offset, atol=1e-15)


@given(place=places, turn=turns, offset=offsets)
def test_a_frame_that_does_not_follow_returns_the_very_same_array(place: Array, turn: Array, offset: Array) -> None:
    here, start = pose.make(GOAL + place, turn)[None], starting(offset)[None]
    for frame in (STILL, StartFrame(START, GOAL, follows=False)):
        assert frame.to_frame(here, start) is here
        assert frame.from_frame(here, start, here + 1.0) is here


@pytest.mark.parametrize("shape", [(3,), (2, 4)])
def test_starts_belong_to_poses_row_by_row(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    poses, starts = (pose.make(START + 0.03 * rng.normal(size=(*shape, 3)), [1.0, 0, 0, 0]) for _ in range(2))
    placed = FRAME.to_frame(poses, starts)
    back = FRAME.from_frame(placed, starts, placed)
    for index in np.ndindex(shape):
        np.testing.assert_allclose(placed[index], FRAME.to_frame(poses[index], starts[index]), atol=1e-15)
        np.testing.assert_allclose(back[index], poses[index], atol=1e-9)


def path(bow: float, offset: Array, fading: float) -> Array:
    """Poses (100, 7) from beside the nominal start to the goal; the offset of the start fades as it says."""
    share = np.linspace(0.0, 1.0, 100)[:, None]
    middle = START + share * (GOAL - START) + bow * np.sin(np.pi * share) * np.array([0.0, 0.0, 1.0])
    return pose.make(middle + (1.0 - share) ** fading * offset, [1.0, 0.0, 0.0, 0.0])


OFFSETS = 0.02 * np.array([[1.0, 0.2, -0.3], [-0.8, 0.3, 0.5], [0.1, -0.4, 1.0], [-0.2, 0.3, -0.9]])


@pytest.mark.parametrize("bow", [0.0, 0.05])
def test_demonstrations_side_by_side_whose_offset_fades_follow_their_start(bow: float) -> None:
    shown = [path(bow, offset, 1.0) for offset in OFFSETS]
    chosen = StartFrame.chosen(shown, starting(np.zeros(3)), pose.make(GOAL, [1.0, 0, 0, 0]))
    assert chosen.follows
    np.testing.assert_array_equal(chosen.start, START)
    np.testing.assert_array_equal(chosen.goal, GOAL)
    # Placed, they lie on one another.
    placed = chosen.each(shown)
    assert pose.position_distance(placed[0], placed[1]).max() < 0.2 * pose.position_distance(shown[0], shown[1]).max()
    np.testing.assert_allclose([rows[0, :3] for rows in placed], np.tile(START, (4, 1)), atol=1e-4)


@pytest.mark.parametrize("bow", [0.0, 0.05])
def test_demonstrations_that_meet_at_once_do_not_follow_their_start(bow: float) -> None:
    shown = [path(bow, offset, 20.0) for offset in OFFSETS]
    chosen = StartFrame.chosen(shown, starting(np.zeros(3)), pose.make(GOAL, [1.0, 0, 0, 0]))
    assert not chosen.follows
    assert all(one is other for one, other in zip(chosen.each(shown), shown, strict=True))


def test_of_one_demonstration_nobody_can_tell() -> None:
    one = path(0.05, OFFSETS[0], 1.0)
    assert not StartFrame.chosen([one], starting(np.zeros(3)), pose.make(GOAL, [1.0, 0, 0, 0])).follows


@given(start=places, goal=places, follows=st.booleans())
def test_what_a_frame_holds_restores_it(start: Array, goal: Array, follows: bool) -> None:
    frame = StartFrame(start, goal, follows)
    for held in (frame.arrays(), frame.described(), json.loads(json.dumps(frame.described()))):
        found = StartFrame.restore(held)
        np.testing.assert_array_equal(found.start, start)
        np.testing.assert_array_equal(found.goal, goal)
        assert found.follows is follows
