import numpy as np
import pytest
from parts import Parts

from koopdqn import pose
from koopdqn.intent.fitting import Fitted
from koopdqn.intent.model import IntentModel
from koopdqn.pose import Array


def test_the_goal_is_a_fixed_point_of_the_default_model(fitted: Fitted, parts: Parts) -> None:
    goal = parts.task.goal[None]
    np.testing.assert_array_equal(fitted.model.position.predict(goal[:, :3]), goal[:, :3])
    np.testing.assert_array_equal(fitted.model.preferred(goal, parts.task.step_m)[:, :3], goal[:, :3])


def test_the_default_model_comes_to_the_goal_from_the_start_region(fitted: Fitted, parts: Parts) -> None:
    starts = parts.task.draw_starts(np.random.default_rng(0), 10)
    ends = fitted.model.roll_out(starts, 500, parts.task.step_m)[-1]
    assert pose.position_distance(ends, parts.task.goal).max() < 5e-3


def test_predictions_follow_demonstrations_not_in_the_fit(trajectories: list[Array], parts: Parts) -> None:
    model = IntentModel.fit(trajectories[1:], parts.task, parts.intent)
    held_out = trajectories[0]
    error = pose.position_distance(model.predict(held_out[:-1]), held_out[1:])
    assert np.median(error) < 0.25 * parts.task.step_m


def test_rescaled_predictions_are_a_step_long_in_the_predicted_direction(
    fitted: Fitted, trajectories: list[Array], parts: Parts
) -> None:
    here = trajectories[0][:-20]
    raw = fitted.model.predict(here)[:, :3] - here[:, :3]
    rescaled = fitted.model.preferred(here, parts.task.step_m)[:, :3] - here[:, :3]
    np.testing.assert_allclose(np.linalg.norm(rescaled, axis=1), parts.task.step_m, rtol=1e-12)
    cosine = (raw * rescaled).sum(axis=1) / np.linalg.norm(raw, axis=1) / parts.task.step_m
    np.testing.assert_allclose(cosine, 1.0, atol=1e-9)


def test_rescaled_predictions_do_not_pass_the_goal(fitted: Fitted, parts: Parts) -> None:
    goal = parts.task.goal
    near = np.tile(goal, (3, 1))
    near[:, 0] -= [1e-4, 1e-3, 0.01]
    moved = pose.position_distance(fitted.model.preferred(near, parts.task.step_m), near)
    np.testing.assert_allclose(moved, [1e-4, 1e-3, parts.task.step_m], rtol=1e-9)


def test_orientation_is_held_where_the_task_holds_it(fitted: Fitted, parts: Parts) -> None:
    assert fitted.model.rotation is None
    start = parts.task.nominal_start[None]
    for predicted in (fitted.model.predict(start), fitted.model.preferred(start, 0.002)):
        assert pose.rotation_distance(predicted, start)[0] < 1e-15


def test_rolling_out_is_predicting_again_and_again(fitted: Fitted, parts: Parts) -> None:
    starts = parts.task.draw_starts(np.random.default_rng(1), 3)
    raw = fitted.model.roll_out(starts, 4)
    assert raw.shape == (5, 3, 7)
    np.testing.assert_array_equal(raw[0], starts)
    np.testing.assert_array_equal(raw[3], fitted.model.predict(raw[2]))
    rescaled = fitted.model.roll_out(starts, 4, 0.002)
    np.testing.assert_array_equal(rescaled[3], fitted.model.preferred(rescaled[2], 0.002))


def test_the_papers_model_is_uncentred_and_of_demonstrated_pairs_alone(paper: Parts, trajectories: list[Array]) -> None:
    model = IntentModel.fit(trajectories, paper.task, paper.intent).position
    np.testing.assert_array_equal(model.center, 0.0)
    assert model.scale == 1.0
    assert model.matrix.shape == (9, 9)
    before = np.concatenate([rows[:-1, :3] for rows in trajectories])
    after = np.concatenate([rows[1:, :3] for rows in trajectories])
    wanted = np.linalg.lstsq(model.observables.lift(before), after, rcond=None)[0]
    np.testing.assert_allclose(model.predict(before), model.observables.lift(before) @ wanted, atol=1e-10)


def test_a_turn_is_predicted_where_orientation_is_learned(parts: Parts) -> None:
    from hydra import compose, initialize_config_dir

    from koopdqn.config.resources import conf_dir
    from koopdqn.config.settings import load_settings
    from koopdqn.intent.model import IntentSettings
    from koopdqn.tasks.task import Task

    for intent in ("fourier", "paper"):
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            config = compose("config", overrides=["task=knife", f"intent={intent}"])
        task = load_settings(config.task, Task, "task")
        settings = load_settings(config.intent, IntentSettings, "intent")
        starts = task.draw_starts(np.random.default_rng(0), 5)
        shown = [task.demonstrator.roll_out(start, 1000) for start in starts]
        model = IntentModel.fit(shown[1:], task, settings)
        assert model.rotation is not None
        error = pose.rotation_distance(model.predict(shown[0][:-1]), shown[0][1:])
        turned = pose.rotation_distance(shown[0][1:], shown[0][:-1])
        assert np.sqrt((error**2).mean()) < 0.5 * np.sqrt((turned**2).mean()), intent
    assert parts.task.orientation == "held"


@pytest.mark.parametrize("center", [True, False])
def test_the_center_is_the_goal_only_where_said(parts: Parts, trajectories: list[Array], center: bool) -> None:
    settings = parts.intent.model_copy(update={"goal_centered": center})
    model = IntentModel.fit(trajectories[:2], parts.task, settings).position
    np.testing.assert_array_equal(model.center, parts.task.goal[:3] if center else np.zeros(3))
