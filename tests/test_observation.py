from typing import Literal

import numpy as np
import pytest

from koopdqn import pose
from koopdqn.rl.network import observe, size
from koopdqn.tasks.shelf import ShelfTask


class _Learned(ShelfTask):
    """The shelf with orientation to be learned."""

    @property
    def orientation(self) -> Literal["learned"]:
        return "learned"


def test_the_five_values_of_the_paper_are_position_and_both_distances(shelf_task: ShelfTask) -> None:
    poses = shelf_task.draw_starts(np.random.default_rng(0), 4)
    poses[1, 3:] = pose.multiply(pose.from_rotation_vector([0, 0, 0.2]), poses[1, 3:])
    seen = observe(poses, shelf_task)
    assert seen.shape == (4, size(shelf_task)) == (4, 5)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen[:, :3], poses[:, :3], rtol=1e-6)
    np.testing.assert_allclose(seen[:, 3], np.linalg.norm(poses[:, :3] - shelf_task.goal[:3], axis=1), rtol=1e-6)
    np.testing.assert_allclose(seen[:, 4], [0, 0.2, 0, 0], atol=1e-6)


def test_at_the_goal_both_distances_are_zero(shelf_task: ShelfTask) -> None:
    np.testing.assert_array_equal(observe(shelf_task.goal[None], shelf_task)[0, 3:], 0.0)


def test_with_orientation_learned_the_turn_from_the_goal_is_seen_and_signs_are_not(shelf_task: ShelfTask) -> None:
    task = _Learned.model_construct(**{name: getattr(shelf_task, name) for name in type(shelf_task).model_fields})
    turn = np.array([0.3, -0.2, 0.5])
    here = pose.make(task.goal[:3] + 0.1, pose.multiply(pose.from_rotation_vector(turn), task.goal[3:]))[None]
    seen = observe(here, task)
    assert seen.shape == (1, size(task)) == (1, 8)
    np.testing.assert_allclose(seen[0, 3:6], turn, atol=1e-6)
    assert seen[0, 7] == pytest.approx(np.linalg.norm(turn), abs=1e-6)
    here[:, 3:] *= -1
    np.testing.assert_allclose(observe(here, task), seen, atol=1e-7)
