"""Movement primitives of demonstrated poses."""

import numpy as np
import pytest
from helpers_shown import arc
from imitation.primitives import PRIMITIVES, learn

from koopdqn import pose

SHOWN = [arc(offset) for offset in (-0.03, -0.01, 0.0, 0.01, 0.03)]


@pytest.mark.parametrize("name", PRIMITIVES)
def test_a_path_leads_from_the_start_to_the_goal_as_it_was_shown(name: str) -> None:
    wanted = arc(0.02)
    path = learn(name, SHOWN)(wanted[0], wanted[-1])
    assert pose.position_distance(path[[0, -1]], wanted[[0, -1]]).max() < 2e-3
    gaps = np.linalg.norm(path[:, None, :3] - wanted[None, :, :3], axis=2)
    assert max(gaps.min(axis=0).max(), gaps.min(axis=1).max()) < 0.015
    assert pose.rotation_distance(path, wanted[0]).max() < 0.01


@pytest.mark.parametrize("name", PRIMITIVES)
def test_the_turn_is_learned_whatever_signs_the_quaternions_have(name: str) -> None:
    share = np.linspace(0.0, 1.0, len(SHOWN[0]))[:, None]
    turn = pose.from_rotation_vector(2.0 * share * np.array([0.0, 0.0, 1.0]))
    turned = [pose.make(rows[:, pose.POSITION], pose.multiply(rows[:, pose.QUATERNION], turn)) for rows in SHOWN]
    turned[1][:, pose.QUATERNION] *= -1.0
    start = turned[2][0].copy()
    start[pose.QUATERNION] *= -1.0
    path = learn(name, turned)(start, turned[2][-1])
    assert pose.rotation_distance(path[[0, -1]], turned[2][[0, -1]]).max() < 0.02
    left = pose.rotation_distance(path, turned[2][-1])
    assert abs(left[len(left) // 2] - 1.0) < 0.3
