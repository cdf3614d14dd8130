import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from parts import Parts, load_parts

from koopdqn import pose
from koopdqn.intent.correction import CorrectedIntent
from koopdqn.intent.fit import Fitted
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.separate import SeparateIntent
from koopdqn.pose import Array
from koopdqn.resources import conf_dir
from koopdqn.settings import load_settings
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.step import IN_PLACE
from koopdqn.tasks.task import Task


def test_the_goal_is_a_fixed_point_of_the_default_model(fitted: Fitted, parts: Parts) -> None:
    goal = parts.task.goal[None]
    np.testing.assert_array_equal(fitted.model.predict(goal)[:, :3], goal[:, :3])
    np.testing.assert_array_equal(fitted.model.predict_step(goal, parts.task.step_m)[:, :3], goal[:, :3])


def test_the_default_model_comes_to_the_goal_from_the_start_region(fitted: Fitted, parts: Parts) -> None:
    starts = parts.task.draw_starts(np.random.default_rng(0), 10)
    ends = fitted.model.roll_out(starts, 500, parts.task.step_m)[-1]
    assert pose.position_distance(ends, parts.task.goal).max() < 5e-3


@pytest.mark.parametrize(("intent", "share"), [("fourier", 0.25), ("pose", 0.4)])
def test_predictions_follow_demonstrations_not_in_the_fit(
    trajectories: list[Array], parts: Parts, intent: str, share: float
) -> None:
    """Of a step; one that leads back to the mean demonstration heads less along the one left out."""
    model = load_parts(f"intent={intent}").intent.fit(trajectories[1:], parts.task)
    held_out = trajectories[0]
    error = pose.position_distance(model.predict(held_out[:-1]), held_out[1:])
    assert np.median(error) < share * parts.task.step_m


def test_rescaled_predictions_are_a_step_long_in_the_predicted_direction(
    fitted: Fitted, trajectories: list[Array], parts: Parts
) -> None:
    here = trajectories[0][:-20]
    raw = fitted.model.predict(here)[:, :3] - here[:, :3]
    rescaled = fitted.model.predict_step(here, parts.task.step_m)[:, :3] - here[:, :3]
    np.testing.assert_allclose(np.linalg.norm(rescaled, axis=1), parts.task.step_m, rtol=1e-12)
    cosine = (raw * rescaled).sum(axis=1) / np.linalg.norm(raw, axis=1) / parts.task.step_m
    np.testing.assert_allclose(cosine, 1.0, atol=1e-9)


def test_rescaled_predictions_do_not_pass_the_goal(fitted: Fitted, parts: Parts) -> None:
    goal = parts.task.goal
    near = np.tile(goal, (3, 1))
    near[:, 0] -= [1e-4, 1e-3, 0.01]
    moved = pose.position_distance(fitted.model.predict_step(near, parts.task.step_m), near)
    np.testing.assert_allclose(moved, [1e-4, 1e-3, parts.task.step_m], rtol=1e-9)


def test_orientation_is_held_where_the_task_holds_it(fitted: Fitted, parts: Parts) -> None:
    start = parts.task.nominal_start[None].copy()
    for tilt in (0.0, 0.1):
        start[:, 3:] = pose.multiply(start[:, 3:], pose.from_rotation_vector([tilt, 0.0, 0.0]))
        for predicted in (fitted.model.predict(start), fitted.model.predict_step(start, 0.002)):
            assert pose.rotation_distance(predicted, start)[0] < 1e-15


def test_rolling_out_is_predicting_again_and_again(fitted: Fitted, parts: Parts) -> None:
    starts = parts.task.draw_starts(np.random.default_rng(1), 3)
    raw = fitted.model.roll_out(starts, 4)
    assert raw.shape == (5, 3, 7)
    np.testing.assert_array_equal(raw[0], starts)
    np.testing.assert_array_equal(raw[3], fitted.model.predict(raw[2]))
    rescaled = fitted.model.roll_out(starts, 4, 0.002)
    np.testing.assert_array_equal(rescaled[3], fitted.model.predict_step(rescaled[2], 0.002))


def test_the_papers_model_is_uncentred_and_of_demonstrated_pairs_alone(paper: Parts, trajectories: list[Array]) -> None:
    intent = paper.intent.fit(trajectories, paper.task)
    assert isinstance(intent, SeparateIntent)
    model = intent.position
    np.testing.assert_array_equal(model.center, 0.0)
    assert model.scale == 1.0
    assert model.matrix.shape == (9, 9)
    before = np.concatenate([rows[:-1, :3] for rows in trajectories])
    after = np.concatenate([rows[1:, :3] for rows in trajectories])
    wanted = np.linalg.lstsq(model.observables.lift(before), after, rcond=None)[0]
    np.testing.assert_allclose(model.predict(before), model.observables.lift(before) @ wanted, atol=1e-10)


def knife(intent: str) -> tuple[Task, IntentSettings, list[Array]]:
    """Return the knife task, an intent's settings and five demonstrations of the task's own person."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("config", overrides=["task=knife", f"intent={intent}"])
    task = load_settings(config.task, Task, "task")
    shown = [task.demonstrator.roll_out(start, 1000) for start in task.draw_starts(np.random.default_rng(0), 5)]
    return task, load_settings(config.intent, IntentSettings, "intent"), shown


def rms(values: Array) -> float:
    return float(np.sqrt((values**2).mean()))


@pytest.mark.parametrize("intent", ["fourier", "paper"])
def test_a_turn_is_predicted_where_orientation_is_learned(intent: str) -> None:
    task, settings, shown = knife(intent)
    model = settings.fit(shown[1:], task)
    assert set(model.matrices) == {"K_p", "K_o"}
    error = pose.rotation_distance(model.predict(shown[0][:-1]), shown[0][1:])
    turned = pose.rotation_distance(shown[0][1:], shown[0][:-1])
    assert rms(error) < 0.5 * rms(turned)


Whole = tuple[Task, IntentSettings, IntentModel, Array]


@pytest.fixture(scope="module")
def whole() -> Whole:
    """The knife task, the whole-pose intent's settings, its model in its frame, and the mean path it leads along."""
    task, settings, shown = knife("pose")
    frame = settings.start_frame(shown, task)
    placed = frame.each(shown)
    model = settings.fit(placed, task).within(frame)
    return task, settings, model, settings.mean(placed, task)


def test_one_model_of_the_whole_pose_predicts_motion_and_turn_of_the_mean_demonstration(whole: Whole) -> None:
    task, _, model, mean = whole
    assert set(model.matrices) == {"K"}
    predicted = model.predict(mean[:-1])
    for distance in (pose.position_distance, pose.rotation_distance):
        assert rms(distance(predicted, mean[1:])) < 0.5 * rms(distance(mean[1:], mean[:-1]))
    goal = task.goal[None]
    np.testing.assert_allclose(pose.rotation_distance(model.predict(goal), goal), 0.0, atol=1e-7)


def test_a_tool_that_lags_in_its_turn_is_told_to_turn_more(whole: Whole) -> None:
    task, _, model, mean = whole
    left = pose.to_rotation_vector(pose.canonical(pose.multiply(mean[:, 3:], pose.conjugate(task.goal[3:]))))
    angle = np.linalg.norm(left, axis=1)
    turning = np.flatnonzero((angle > 0.3) & (angle < 2.8))[:-1]
    assert len(turning) > 10
    axis = left[turning] / angle[turning, None]
    turns = []
    for lag in (0.0, 0.01, 0.1):
        turned = pose.multiply(pose.from_rotation_vector(lag * axis), mean[turning, 3:])
        here = pose.make(mean[turning, :3], turned)
        following = model.predict_step(here, task.step_m)
        turns.append(pose.rotation_distance(here, task.goal) - pose.rotation_distance(following, task.goal))
    assert (turns[1] >= turns[0] - 1e-9).all()
    assert (turns[2] >= turns[1] - 1e-9).all()
    assert (turns[2] > turns[0] + 1e-3).any()
    # Of a tenth of a radian, at least what the step leaves of a turn in place where it moves as well (a step's motion).
    in_place = IN_PLACE * task.rotation_tolerance_rad
    assert turns[2].min() >= 0.99 * in_place * 0.1 / np.hypot(0.1, in_place)


def test_what_is_intended_from_elsewhere_is_what_is_predicted_from_the_nominal_start_and_is_stored(
    whole: Whole,
) -> None:
    task, settings, model, mean = whole
    frame = StartFrame(task.nominal_start[:3], task.goal[:3], follows=True)
    model = model.within(frame)
    starts = task.draw_starts(np.random.default_rng(3), 20)
    here = frame.from_frame(mean[10:210:10], starts, mean[10:210:10])
    for each in (
        model,
        settings.restore(model.arrays()),
        CorrectedIntent(model, mean[:1], mean[1:2], np.array([0.03])),
    ):
        found = each.intended(here, starts)
        np.testing.assert_allclose(frame.to_frame(found, starts), each.predict(frame.to_frame(here, starts)), atol=1e-9)
    np.testing.assert_array_equal(settings.restore(model.arrays()).intended(here, starts), model.intended(here, starts))
    assert pose.position_distance(model.intended(here, starts), model.predict(here)).max() > 1e-3


@pytest.mark.parametrize("center", [True, False])
def test_the_center_is_the_goal_only_where_said(parts: Parts, trajectories: list[Array], center: bool) -> None:
    settings = load_parts("intent=fourier").intent.model_copy(update={"goal_centered": center})
    intent = settings.fit(trajectories[:2], parts.task)
    assert isinstance(intent, SeparateIntent)
    model = intent.position
    np.testing.assert_array_equal(model.center, parts.task.goal[:3] if center else np.zeros(3))
