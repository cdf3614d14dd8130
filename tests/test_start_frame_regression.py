from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.paths import arc_lengths, hausdorff, mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import StartFrame, StartRegression

GOAL = np.array([0.6, 0.15, 0.5])
START = pose.make([0.5, -0.2, 0.4], pose.IDENTITY[pose.QUATERNION])
END = pose.make(GOAL, pose.IDENTITY[pose.QUATERNION])

offsets = st.lists(st.floats(-0.03, 0.03, allow_nan=False), min_size=3, max_size=3).map(np.array)
shares = st.floats(0.0, 1.0, allow_nan=False)


def path(offset: Array) -> Array:
    """Poses (150, 7): who begins farther out swings out midway, twice as far and sideways, and then comes in."""
    share = np.linspace(0.0, 1.0, 150)[:, None]
    bow = np.sin(np.pi * share)
    straight = START[:3] + share * (GOAL - START[:3]) + 0.04 * bow * np.array([0.0, 0.0, 1.0])
    swing = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    return pose.make(straight + (1.0 - share) * offset + bow * (swing @ offset), pose.IDENTITY[pose.QUATERNION])


def shown(count: int, seed: int = 0) -> list[Array]:
    return [path(offset) for offset in np.random.default_rng(seed).uniform(-0.02, 0.02, (count, 3))]


@cache
def of_twelve() -> StartFrame:
    return StartFrame.chosen(shown(12), START, END)


@pytest.fixture
def frame() -> StartFrame:
    return of_twelve()


def regression_of(frame: StartFrame) -> StartRegression:
    assert frame.regression is not None
    return frame.regression


def foretold(frame: StartFrame, trajectories: list[Array], start: Array) -> Array:
    mean = mean_poses(frame.each(trajectories), 200)
    return frame.from_frame(mean, start[None], mean)


def test_the_path_of_another_start_is_foretold_where_its_offset_does_more_than_fade(frame: StartFrame) -> None:
    fading = StartFrame(frame.start, frame.goal, follows=True)
    for other in shown(5, seed=1):
        near, far = (hausdorff(foretold(each, shown(12), other[0])[:, :3], other[:, :3]) for each in (frame, fading))
        assert near < 0.45 * far


def test_more_demonstrations_of_one_law_foretell_it_better() -> None:
    def off(count: int) -> float:
        known = shown(count)
        frame = StartFrame.following(known, START, END)
        return float(np.mean([hausdorff(foretold(frame, known, o[0])[:, :3], o[:, :3]) for o in shown(8, seed=1)]))

    assert off(40) < off(10) < off(3)


@given(share=shares, aside=offsets, offset=offsets)
def test_what_was_moved_comes_back(share: float, aside: Array, offset: Array) -> None:
    frame = of_twelve()
    here = path(np.zeros(3))[round(149 * share)].copy()
    here[:3] += aside
    start = START.copy()
    start[:3] += offset
    local = frame.to_frame(here, start)
    np.testing.assert_allclose(frame.from_frame(local, start, here), here, atol=2e-4)
    np.testing.assert_array_equal(local[3:], here[3:])


def test_the_goal_stays_whatever_the_start(frame: StartFrame) -> None:
    for other in shown(5, seed=1):
        np.testing.assert_allclose(frame.to_frame(END, other[0]), END, atol=1e-12)
        np.testing.assert_allclose(frame.from_frame(END, other[0], END), END, atol=1e-12)


def test_it_is_not_extrapolated_beyond_the_demonstrated_starts(frame: StartFrame) -> None:
    regression = regression_of(frame)
    far = START.copy()
    far[:3] = regression.centre + np.array([0.3, -0.4, 0.0])
    np.testing.assert_allclose(np.linalg.norm(regression.offset(far)), regression.reach)
    np.testing.assert_allclose(regression.offset(far) / regression.reach, [0.6, -0.8, 0.0], atol=1e-12)
    near = START.copy()
    near[:3] = regression.centre + 0.5 * regression.reach * np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(regression.offset(near), near[:3] - regression.centre)


def test_the_motion_is_linear_in_the_offset_and_smooth_along_the_path(frame: StartFrame) -> None:
    regression = regression_of(frame)
    places = path(np.zeros(3))[:, :3]
    one = regression.shift(places, np.array([0.01, 0.0, 0.0]))
    np.testing.assert_allclose(regression.shift(places, np.array([0.02, 0.0, 0.0])), 2.0 * one, atol=1e-15)
    assert np.linalg.norm(np.diff(one, axis=0), axis=1).max() < 0.2 * np.diff(arc_lengths(places)).max()


def test_nothing_is_told_from_demonstrations_of_one_start_or_alone() -> None:
    same = [path(np.zeros(3)), path(np.zeros(3))]
    assert StartFrame.following(same, START, END).regression is None
    assert StartFrame.following(shown(1), START, END).regression is None


def test_each_unseen_is_placed_by_what_the_others_show(frame: StartFrame) -> None:
    known = shown(12)
    unseen = frame.each_unseen(known)
    others = StartFrame.following(known[:4] + known[5:], START, END)
    np.testing.assert_array_equal(unseen[4], others.to_frame(known[4], known[4][:1]))
    # They differ more from one another than where each has shaped the frame.
    spread, fitted = (np.std([rows[75, :3] for rows in each], axis=0).sum() for each in (unseen, frame.each(known)))
    assert spread > fitted
    still = StartFrame(frame.start, frame.goal, follows=False)
    assert all(one is other for one, other in zip(still.each_unseen(known), known, strict=True))


def test_what_it_holds_restores_it(frame: StartFrame) -> None:
    found = StartFrame.restore(frame.arrays())
    starts = np.array([rows[0] for rows in shown(5, seed=1)])
    poses = np.array([rows[60] for rows in shown(5, seed=1)])
    np.testing.assert_array_equal(found.to_frame(poses, starts), frame.to_frame(poses, starts))
    for name, odd in {"path": found.arrays()["path"][:1], "shifts": np.full((40, 3, 3), np.nan)}.items():
        with pytest.raises(ValueError, match="must have at least two places, and all of it be finite"):
            StartFrame.restore({**frame.arrays(), name: odd})
    for name, odd in {"path": found.arrays()["path"][:5], "centre": np.zeros(2), "reach": np.zeros(1)}.items():
        with pytest.raises(ValueError, match="must be of shapes"):
            StartFrame.restore({**frame.arrays(), name: odd})
    assert StartRegression.restore(StartFrame(frame.start, frame.goal, follows=True).arrays()) is None
