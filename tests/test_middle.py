"""The mean path from the middle of the start region (``intent.from_middle``)."""

import numpy as np
import pytest

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.intent.validation import cross_validate, jackknife_signs
from koopdqn.intent.whole_pose import WholePoseSettings
from koopdqn.paths import between, mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

STEPS, FIRST = 400, 25


@pytest.fixture(scope="module")
def shelf() -> tuple[Task, WholePoseSettings]:
    """The shelf, and an intent from the middle of its start region."""
    parts = load_config("intent=gentle")
    assert isinstance(parts.intent, WholePoseSettings)
    return parts.task, parts.intent


def beside(task: Task, offsets: Array, fading_m: float) -> list[Array]:
    """Return the nominal path begun at ``offsets`` (D, 3) [m] from it, which fade as exp(−s / fading_m)."""
    path = task.demonstrator.roll_out(task.nominal_start, STEPS)
    arc = np.arange(len(path)) * task.step_m
    shown = []
    for offset in offsets:
        rows = path.copy()
        rows[:, :3] += np.exp(-arc / fading_m)[:, None] * offset
        shown.append(rows)
    return shown


def off_the_path(task: Task, settings: WholePoseSettings, shown: list[Array]) -> float:
    """Return the farthest [m] that the model of demonstrations leaves the nominal path within its first steps."""
    rolled = settings.fit(shown, task).roll_out(task.nominal_start[None], FIRST, task.step_m)[:, 0, :3]
    path = task.nominal_path
    return float(np.linalg.norm(path.at(path.nearest(rolled)) - rolled, axis=1).max())


@pytest.mark.parametrize("fading_m", [0.04, 0.08])
def test_demonstrations_from_beside_the_middle_teach_the_path_from_the_middle(
    shelf: tuple[Task, WholePoseSettings], fading_m: float
) -> None:
    task, settings = shelf
    offsets = np.array([[0.03, 0.0, 0.02], [0.0, 0.025, 0.01], [0.01, 0.02, -0.01]])
    shown = beside(task, offsets, fading_m)
    as_they_are = settings.model_copy(update={"from_middle": False})
    assert off_the_path(task, settings, shown) < 0.3 * off_the_path(task, as_they_are, shown)


def test_what_is_moved_is_judged_by_what_is_moved(shelf: tuple[Task, WholePoseSettings]) -> None:
    """The mean of few starts lies beside the middle: the models of the others, begun there, are not wrong for that."""
    task, settings = shelf
    offsets = 0.02 + np.random.default_rng(0).normal(scale=0.01, size=(5, 3))
    shown = beside(task, offsets, 0.04)
    folds = cross_validate(shown, task, settings).folds

    def right(mean: Array) -> float:
        first = np.array([each[:10, 0] for each in jackknife_signs(folds, mean, task, "rescaled", [0.1])])
        return float(first[..., 0].sum() / first[..., 1].sum())

    assert right(settings.mean(shown, task)) > 0.95
    assert right(settings.mean(shown, task)) > right(mean_poses(shown)) + 0.05


def same(task: Task, settings: WholePoseSettings, shown: list[Array]) -> bool:
    """Return whether the model is the same to the bit with and without ``from_middle``."""
    one, other = (
        settings.model_copy(update={"from_middle": each}).fit(shown, task).arrays()["matrix"] for each in (True, False)
    )
    return np.array_equal(one, other)


def test_the_mean_stays_where_nothing_tells_how_offsets_fade(shelf: tuple[Task, WholePoseSettings]) -> None:
    task, settings = shelf
    offset = np.array([[0.03, 0.0, 0.02]])
    assert same(task, settings, beside(task, offset, 0.02))
    assert same(task, settings, beside(task, np.repeat(offset, 3, axis=0), 0.02))


def test_the_mean_stays_where_the_start_region_was_made_from_the_demonstrations(
    shelf: tuple[Task, WholePoseSettings], monkeypatch: pytest.MonkeyPatch
) -> None:
    task, settings = shelf
    shown = beside(task, np.array([[0.03, 0.0, 0.02], [0.0, 0.02, 0.0]]), 0.02)
    assert not same(task, settings, shown)
    monkeypatch.setattr(type(task), "demonstrated_middle", None)
    assert same(task, settings, shown)


def test_a_turn_stays_where_it_was_shown() -> None:
    """Demonstrations that begin behind the middle show the turn at the same places."""
    parts = load_config("task=knife", "intent=gentle")
    task, settings = parts.task, parts.intent
    assert isinstance(settings, WholePoseSettings)
    path = task.demonstrator.roll_out(task.nominal_start, STEPS)
    ahead = path[10, :3] - path[0, :3]
    behind = -0.03 * ahead / np.linalg.norm(ahead)
    shown = beside(task, behind + np.array([[0.004, 0.0, 0.0], [0.0, 0.004, 0.0], [0.0, 0.0, 0.004]]), 0.02)
    turning = path[20:60]
    expected = task.demonstrator.next_pose(turning)
    found = settings.fit(shown, task).predict_step(turning, task.step_m)
    assert np.degrees(pose.rotation_distance(found, expected)).max() < 0.3


@pytest.mark.parametrize("at_goal", [True, False])
def test_a_turn_on_the_spot_is_kept(at_goal: bool) -> None:
    config = load_config("task=knife", "intent=gentle")
    task, settings = config.task, config.intent
    assert isinstance(settings, WholePoseSettings)
    path = task.demonstrator.roll_out(task.nominal_start, STEPS)
    ends = np.linspace(0.0, 1.0, 60)[1:-1]
    shown = []
    for rows in beside(task, np.array([[0.02, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.02]]), 0.02):
        begun, ended = rows.copy(), rows.copy()
        begun[:, 3:], ended[:, 3:] = path[0, 3:], path[-1, 3:]
        spot = np.repeat(rows[-1:] if at_goal else rows[:1], len(ends), axis=0)
        turned = between(np.repeat(begun[:1], len(ends), axis=0), np.repeat(ended[-1:], len(ends), axis=0), ends)
        spot[:, 3:] = turned[:, 3:]
        shown.append(np.concatenate([begun, spot, ended[-1:]] if at_goal else [begun[:1], spot, ended]))
    rolled = settings.fit(shown, task).roll_out(task.nominal_start[None], 2 * STEPS, task.step_m)[-1]
    assert np.degrees(pose.rotation_distance(rolled, task.goal))[0] < 1.0


@pytest.mark.parametrize("negated", [[0], [1], [0, 2], [0, 1, 2, 3, 4]])
def test_the_sign_of_a_quaternion_says_nothing(negated: list[int]) -> None:
    """Both quaternions of a rotation are one orientation, for the mean and for the intent's own roll-outs."""
    parts = load_config("task=knife")
    task, settings = parts.task, parts.intent
    assert isinstance(settings, WholePoseSettings)
    shown = [
        task.demonstrator.roll_out(pose.make(task.nominal_start[:3] + offset, task.nominal_start[3:]), STEPS)
        for offset in 0.01 * np.random.default_rng(0).normal(size=(5, 3))
    ]
    other = [np.array(rows) for rows in shown]
    for index in negated:
        other[index][:, pose.QUATERNION] *= -1.0
    mean, same = settings.mean(shown, task), settings.mean(other, task)
    np.testing.assert_allclose(same[:, pose.POSITION], mean[:, pose.POSITION], atol=1e-12)
    assert pose.rotation_distance(same, mean).max() < 1e-6
    assert ((same[1:, pose.QUATERNION] * same[:-1, pose.QUATERNION]).sum(axis=1) > 0).all()
    starts = np.array([rows[0] for rows in other])
    paths = settings.fit(other, task).intended_paths(starts, 400, task.step_m)
    assert ((paths[1:, :, pose.QUATERNION] * paths[:-1, :, pose.QUATERNION]).sum(axis=-1) > 0).all()
