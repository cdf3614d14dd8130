"""One recording of several motions is cut where the arm rests or returns, and nowhere else."""

import numpy as np
import pytest
from helpers_shown import arc, recorded
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_files import motion

from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.recordings.cutting import motions_of
from koopdqn.pose import Array

STEP_S = 0.02


def timed(poses: Array) -> Demonstration:
    return Demonstration(STEP_S * np.arange(float(len(poses))), poses)


def rest(pose: Array, rows: int) -> Array:
    return np.repeat(pose[None], rows, axis=0)


@given(st.integers(2, 4), st.integers(40, 90))
@settings(max_examples=10, deadline=None)
def test_motions_between_rests_are_found_and_ways_back_left_out(count: int, rows: int) -> None:
    there = motion()
    parts = [rest(there[0], rows)]
    for _ in range(count):
        parts += [there, rest(there[-1], rows), there[::-1], rest(there[0], rows)]
    item = timed(np.concatenate(parts))
    cuts = motions_of(item)
    assert [cut.kept for cut in cuts] == [True, False] * count
    for cut in cuts:
        if cut.kept:
            np.testing.assert_allclose(cut.item.poses[[0, -1], :3], there[[0, -1], :3], atol=0.004)
            np.testing.assert_array_equal(cut.item.poses[:, :3], item.poses[cut.begin : cut.end + 1, :3])


@given(st.integers(2, 5))
@settings(max_examples=4, deadline=None)
def test_loops_without_a_rest_are_cut_at_the_start(count: int) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi * count, 200 * count)
    poses = np.tile(motion()[0], (len(angle), 1))
    poses[:, 0] += 0.1 * (np.cos(angle) - 1.0)
    poses[:, 1] += 0.1 * np.sin(angle)
    cuts = motions_of(timed(poses))
    assert len(cuts) == count
    assert all(cut.kept for cut in cuts)
    assert all(np.linalg.norm(cut.item.poses[-1, :3] - poses[0, :3]) < 0.01 for cut in cuts)


@pytest.mark.parametrize("noise", [0.0, 0.0005])
def test_one_motion_with_idle_ends_stays_whole(noise: float) -> None:
    item = recorded(arc(), idle=60, noise=noise)
    (cut,) = motions_of(item)
    assert cut.item is item
