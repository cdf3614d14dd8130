"""The bend: straightening and bending agree, and an intent follows the moved path as it followed its own."""

import numpy as np
import pytest

from koopdqn import pose
from koopdqn.intent.bend import Bend, BentIntent
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.intent.model import IntentModel
from koopdqn.pose import Array

STEP = 0.002


class _Line(IntentModel):
    """Goes along the x axis to the goal and back to the axis within a few steps."""

    goal = pose.make([0.4, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0])

    def predict(self, poses: Array) -> Array:
        motion = np.stack(
            [np.clip(self.goal[0] - poses[:, 0], 0.0, STEP), -0.25 * poses[:, 1], -0.25 * poses[:, 2]], axis=1
        )
        return pose.make(poses[:, :3] + motion, poses[:, 3:])

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        return {}

    def arrays(self) -> dict[str, np.ndarray]:
        return {}


@pytest.fixture(scope="module")
def bend() -> Bend:
    x = np.linspace(0.0, 0.4, 801)
    path = np.stack([x, np.zeros_like(x), np.zeros_like(x)], axis=1)
    bump = 0.06 * np.exp(-(((x - 0.2) / 0.05) ** 2))
    return Bend(path, np.stack([np.zeros_like(x), bump, 0.5 * bump], axis=1))


def _poses(positions: Array) -> Array:
    return pose.make(positions, np.tile([1.0, 0.0, 0.0, 0.0], (len(positions), 1)))


def test_the_moved_path_straightens_to_the_path(bend: Bend) -> None:
    assert np.allclose(bend.straightened(_poses(bend.bent))[:, :3], bend.path, atol=1e-12)
    assert np.allclose(bend.bent_each([_poses(bend.path)])[0][:, :3], bend.bent, atol=1e-12)


def test_a_distance_from_the_moved_path_stays_what_it_is(bend: Bend) -> None:
    rng = np.random.default_rng(0)
    off = _poses(bend.bent[100:-100:20] + rng.normal(scale=0.003, size=(31, 3)))
    far = np.linalg.norm(off[:, None, :3] - bend.bent, axis=2).min(axis=1)
    straight = bend.straightened(off)
    assert np.allclose(np.linalg.norm(straight[:, None, :3] - bend.path, axis=2).min(axis=1), far, atol=4e-4)


def test_nothing_changes_where_nothing_is_moved(bend: Bend) -> None:
    poses = _poses(np.array([[0.01, 0.004, -0.002], [0.39, -0.003, 0.001]]))
    model = _Line()
    assert np.allclose(BentIntent(model, bend).predict(poses), model.predict(poses), atol=1e-9)


def test_the_bent_intent_follows_the_moved_path_to_the_goal(bend: Bend) -> None:
    start = _poses(np.array([[0.0, 0.004, -0.004]]))
    path = BentIntent(_Line(), bend).intended_paths(start, 1000, STEP)[:, 0, :3]
    off = np.linalg.norm(path[:, None] - bend.bent, axis=2).min(axis=1)
    assert off[20:].max() < 1.5e-3
    assert np.linalg.norm(path[-1] - _Line.goal[:3]) < 1e-3
    assert path[:, 1].max() > 0.058


def test_greedy_on_the_intent_as_fitted_knows_no_bend(bend: Bend) -> None:
    base = _Line()
    assert BentIntent(base, bend).unbent is base
    assert base.unbent is base
