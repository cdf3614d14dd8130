from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from helpers_shown import arc, derivation, recorded, shown
from parts import Parts, as_demonstrations, load_parts, straight_poses
from small_run import SMALL

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import Fitted, agent_steps, fit, sixty_samples, unmatched_share
from koopdqn.intent.koopman import koopman_rows
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.observables import SecondOrder
from koopdqn.intent.validation import length_ratio
from koopdqn.paths import to_count
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import STILL


def lines_to_the_goal(parts: Parts, sideways: list[float], steps: int = 12) -> Demonstrations:
    """Straight demonstrations along +x that end beside the goal by millimetres, a whole number of steps long."""
    goal = parts.task.goal
    shown = []
    for y in sideways:
        end = goal[:3] + np.array([0.0, y, 0.0])
        start = end - np.array([steps * parts.task.step_m, 0.0, 0.0])
        shown.append(straight_poses(start, end, 3 * steps + 1, goal[3:]))
    return as_demonstrations("shelf", shown)


def test_the_report_says_what_is_computed_by_hand_on_a_tiny_case(paper: Parts) -> None:
    tiny = lines_to_the_goal(paper, [-0.001, 0.0, 0.001])
    report = fit(tiny, paper.task, paper.intent, paper.trust, paper.reward).report
    paths = [rows[:, :3] for rows in agent_steps(tiny, paper.task)]
    assert report["samples"] == [13, 13, 13]
    lift = SecondOrder().lift
    errors = []
    for index, held_out in enumerate(paths):
        others = [path for i, path in enumerate(paths) if i != index]
        before, after = (np.concatenate([path[part] for path in others]) for part in (slice(-1), slice(1, None)))
        (matrix,) = koopman_rows(lift(before), lift(after), np.ones(len(before)), (0.0,))
        errors.append((lift(held_out[:-1]) @ matrix.T)[:, :3] - held_out[1:])
    sizes = np.linalg.norm(errors, axis=2)
    summary = report["one_step_error_m"]
    assert summary["rms"] == pytest.approx(np.sqrt((sizes**2).mean()), rel=1e-6)
    assert summary["mean"] == pytest.approx(sizes.mean(), rel=1e-6)
    assert summary["max"] == pytest.approx(sizes.max(), rel=1e-6)
    for axis, name in enumerate("xyz"):
        component = np.array(errors)[:, :, axis]
        assert summary["rms_per_component"][name] == pytest.approx(np.sqrt((component**2).mean()), abs=1e-10)
        assert summary["max_per_component"][name] == pytest.approx(np.abs(component).max(), abs=1e-10)
    np.testing.assert_allclose(report["one_step_error_per_step_m"]["mean"], sizes.mean(axis=0), atol=1e-10)
    np.testing.assert_allclose(report["one_step_error_per_step_m"]["max"], sizes.max(axis=0), atol=1e-10)
    assert (report["task"], report["demonstrations"], report["lifted_dimension"]) == ("shelf", 3, 9)
    assert report["one_step_error_rad"] is None


def test_the_spectral_radius_is_that_of_the_model(fitted: Fitted) -> None:
    eigenvalues = np.linalg.eigvals(fitted.model.matrices["K"].matrix)
    assert fitted.report["spectral_radius"] == pytest.approx(np.abs(eigenvalues).max(), rel=1e-12)


def test_trust_rests_on_the_signs_of_rewards_as_they_are_made(
    fitted: Fitted, demonstrations: Demonstrations, parts: Parts
) -> None:
    shares = {}
    for prediction in ("raw", "rescaled"):
        reward = parts.reward.model_copy(update={"prediction": prediction})
        trust = fit(demonstrations, parts.task, parts.intent, parts.trust, reward)
        shares[prediction] = trust.report["trust"]["right_share"]
        assert np.all((trust.trust.right >= 0) & (trust.trust.right <= 1))
    assert shares["rescaled"] > 0.95
    assert shares["raw"] != shares["rescaled"]
    assert fitted.trust.settings == parts.trust


def test_fresh_demonstrations_measure_how_often_trusted_rewards_are_right(
    demonstrations: Demonstrations, parts: Parts, demonstrations_of: Callable[[int], Demonstrations]
) -> None:
    fresh = demonstrations_of(7)
    found = fit(demonstrations, parts.task, parts.intent, parts.trust, parts.reward, fresh=fresh).report["trust"]
    assert found["fresh_right_share"] >= found["least_right"]
    # Nobody foretells the next step of one person as well as what all agree on.
    assert found["left_out_right_share"] < found["right_share"]


def test_coverage_is_the_share_of_held_out_states_inside(fitted: Fitted) -> None:
    trust = fitted.report["trust"]
    assert trust["held_out_state_coverage"] == pytest.approx(np.mean(trust["per_demonstration"]))
    whole = [share == 1.0 for share in trust["per_demonstration"]]
    assert trust["held_out_path_coverage"] == pytest.approx(np.mean(whole))
    assert trust["held_out_state_coverage"] > 0.9


def test_the_default_model_rolls_out_to_the_goal_near_the_held_out_path(fitted: Fitted) -> None:
    rolled = fitted.report["roll_out_error_m"]
    assert rolled["reached_goal"] == 5
    assert rolled["median_hausdorff"] == pytest.approx(np.median(rolled["hausdorff"]))
    assert rolled["median_hausdorff"] < 0.010


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_papers_model_predicts_sixty_samples_four_times_better_than_no_motion(
    demonstrations_of: Callable[[int], Demonstrations], paper: Parts, seed: int
) -> None:
    shown = demonstrations_of(seed)
    sixty = fit(shown, paper.task, paper.intent, paper.trust, paper.reward).report["sixty_samples"]
    assert sixty["rms_over_persistence"] <= 0.25
    assert sixty["rms_over_persistence"] == pytest.approx(sixty["rms_m"] / sixty["persistence_rms_m"])
    motions = [np.diff(to_count(item.poses, 60)[:, :3], axis=0) for item in shown.items]
    persistence = np.sqrt((np.concatenate(motions) ** 2).sum(axis=1).mean())
    assert sixty["persistence_rms_m"] == pytest.approx(persistence, rel=1e-9)
    assert sixty["rms_m"] <= sixty["max_m"]


def test_every_demonstrated_step_of_the_shelf_can_be_matched(trajectories: list[Array], parts: Parts) -> None:
    assert unmatched_share(trajectories, parts.task) == 0.0


def test_steps_that_no_action_can_match_are_counted(parts: Parts) -> None:
    task = parts.task
    start, goal = task.nominal_start, task.goal[3:]
    stride = pose.make(start[:3] + np.array([[0.0, 0, 0], [0.0021, 0, 0], [0.02, 0, 0], [0.0221, 0, 0]]), goal)
    assert unmatched_share([stride], task) == pytest.approx(1 / 3)
    twist = stride[:2].copy()
    twist[1, 3:] = pose.multiply(pose.from_rotation_vector([0.5, 0, 0]), goal)
    assert unmatched_share([stride, twist], task) == pytest.approx(2 / 4)


def test_demonstrations_of_another_task_are_refused(parts: Parts, demonstrations: Demonstrations) -> None:
    other = Demonstrations("knife", demonstrations.arm, demonstrations.items)
    with pytest.raises(BadInputError, match="must be of task shelf, found task knife"):
        fit(other, parts.task, parts.intent, parts.trust, parts.reward)


def test_of_a_single_demonstration_a_model_is_fitted_and_nothing_measured(
    parts: Parts, demonstrations: Demonstrations
) -> None:
    single = Demonstrations("shelf", demonstrations.arm, demonstrations.items[:1])
    found = fit(single, parts.task, parts.intent, parts.trust, parts.reward)
    for key in ("one_step_error_m", "one_step_error_per_step_m", "roll_out_error_m", "sixty_samples"):
        assert found.report[key] is None
    trust = found.report["trust"]
    assert trust["nominal_coverage"] is None
    assert trust["held_out_path_coverage"] is None
    assert trust["radius_m"] == pytest.approx(0.015)
    assert found.report["regularisation"] == []
    start = agent_steps(single, parts.task)[0][:1]
    end = found.model.roll_out(start, 400, parts.task.step_m)[-1]
    assert pose.position_distance(end, parts.task.goal)[0] < 5e-3


def test_the_models_way_is_measured_in_metres_and_not_in_steps(
    fitted: Fitted, trajectories: list[Array], parts: Parts
) -> None:
    class Slow:
        """Moves by half a step at a time, as where it turns as well."""

        def roll_out(self, starts: Array, limit: int, step: float) -> Array:
            path = fitted.model.roll_out(starts, limit, step)
            return np.repeat(path, 2, axis=0)

    whole, slow = (length_ratio(model, trajectories, parts.task) for model in (fitted.model, Slow()))  # type: ignore[arg-type]
    assert slow == pytest.approx(whole, rel=1e-9)
    assert whole == pytest.approx(1.0, abs=0.1)


def test_coverage_is_measured_on_fresh_demonstrations(parts: Parts, demonstrations: Demonstrations) -> None:
    few = Demonstrations("shelf", "UR5", demonstrations.items[:2])
    trust = fit(few, parts.task, parts.intent, parts.trust, parts.reward, fresh=demonstrations).report["trust"]
    assert trust["fresh"] == 5
    assert trust["measured_coverage"] >= 2 / 5


def test_demonstrations_that_do_not_end_at_the_goal_are_refused(parts: Parts, demonstrations: Demonstrations) -> None:
    cut = [Demonstration(item.times[:100], item.poses[:100]) for item in demonstrations.items[1:]]
    mixed = Demonstrations("shelf", demonstrations.arm, [demonstrations.items[0], *cut])
    with pytest.raises(BadInputError, match=r"demonstration 1 must end within 0.005 m of the goal .* found 0\.\d+ m"):
        fit(mixed, parts.task, parts.intent, parts.trust, parts.reward)


def test_an_end_turned_away_from_the_goal_is_refused_for_its_turn(parts: Parts) -> None:
    straight = lines_to_the_goal(parts, [0.0, 0.001])
    turn = pose.from_rotation_vector([0.3, 0.0, 0.0])
    turned = [
        Demonstration(item.times, pose.make(item.poses[:, :3], pose.multiply(turn, item.poses[:, 3:])))
        for item in straight.items
    ]
    with pytest.raises(BadInputError, match=r"(0\.3\d* rad|17\.\d* ?°)"):
        fit(Demonstrations("shelf", "UR5", turned), parts.task, parts.intent, parts.trust, parts.reward)


def test_a_demonstration_that_does_not_move_is_refused(parts: Parts) -> None:
    still = as_demonstrations("shelf", [np.tile(parts.task.goal, (5, 1))] * 2)
    with pytest.raises(BadInputError):
        fit(still, parts.task, parts.intent, parts.trust, parts.reward)


def test_progress_is_told_once_a_fold(paper: Parts) -> None:
    told: list[int] = []
    fit(lines_to_the_goal(paper, [0.0, 0.001, 0.002]), paper.task, paper.intent, paper.trust, paper.reward, told.append)
    assert told == [1, 2, 3]


def test_the_same_demonstrations_give_the_same_fit(demonstrations: Demonstrations, parts: Parts) -> None:
    few = Demonstrations("shelf", "UR5", demonstrations.items[:2])
    one, two = (fit(few, parts.task, parts.intent, parts.trust, parts.reward) for _ in range(2))
    np.testing.assert_array_equal(one.model.matrices["K"].matrix, two.model.matrices["K"].matrix)
    assert one.trust.arrays().keys() == two.trust.arrays().keys()
    for name, values in one.trust.arrays().items():
        np.testing.assert_array_equal(two.trust.arrays()[name], values, err_msg=name)
    assert one.report == two.report


def test_agent_steps_are_a_step_apart(trajectories: list[Array], parts: Parts) -> None:
    for rows in trajectories:
        gaps = pose.position_distance(rows[1:], rows[:-1])
        np.testing.assert_allclose(gaps[:-1], parts.task.step_m, rtol=1e-6)


@pytest.mark.parametrize("person", ["person.look_ahead_m=0.06", "person=via"])
def test_the_model_is_told_nothing_of_the_person(
    demonstrations: Demonstrations, fitted: Fitted, parts: Parts, person: str
) -> None:
    other = fit(demonstrations, load_parts(person).task, parts.intent, parts.trust, parts.reward)
    for mine, theirs in ((fitted.model, other.model), (fitted.trust, other.trust)):
        arrays = theirs.arrays()
        assert mine.arrays().keys() == arrays.keys()
        for name, values in mine.arrays().items():
            np.testing.assert_array_equal(values, arrays[name])


def test_sixty_samples_are_foretold_in_the_start_frame_as_every_other(monkeypatch: pytest.MonkeyPatch) -> None:
    derived = derivation(holdout=0).derive(shown(*(recorded(arc(0.02 * index)) for index in range(5))))
    parts = load_parts()
    told = sixty_samples(derived.training, derived.task, parts.intent)[0]
    monkeypatch.setattr(type(parts.intent), "start_frame", lambda *_: STILL)
    without = sixty_samples(derived.training, derived.task, parts.intent)[0]
    assert told is not None
    assert without is not None
    assert told["rms_m"] is not None
    assert told["rms_m"] < 0.6 * (without["rms_m"] or 0.0)


def test_what_comes_back_over_the_same_place_is_told_by_the_length_of_the_way(parts: Parts) -> None:
    def ratio(*ways: Array, intent: IntentSettings = parts.intent) -> float:
        derived = derivation(holdout=0).derive(shown(*(recorded(way) for way in ways)))
        found = fit(derived.training, derived.task, intent, parts.trust, parts.reward)
        return float(found.report["length_ratio"])

    once = [arc(offset) for offset in (0.0, 0.02)]
    assert ratio(*once) == pytest.approx(1.0, abs=0.05)
    # Of a short motion the part within the goal's tolerance is a large one.
    short = [pose.make(way[-1, :3] + 0.1 * (way[:, :3] - way[-1, :3]), way[:, 3:]) for way in once]
    assert ratio(*short) == pytest.approx(1.0, abs=0.1)
    again = [np.concatenate([way[:140], way[:140][::-1], way]) for way in once]
    assert ratio(*again) == pytest.approx(1.0, abs=0.05)
    # What does not unfold a path leaves the first passages out.
    assert ratio(*again, intent=load_parts("intent=fourier").intent) < 0.6


def test_fresh_demonstrations_are_none_of_those_fitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", *SMALL, "seed=3", f"out={tmp_path}/shown"]) == 0
    given = ["fit", *SMALL, f"demos={tmp_path}/shown/demos.hdf5", "fit.fresh=1"]
    assert cli.main([*given, "fit.seed=3", f"out={tmp_path}/same"]) == 2
    assert "fit.seed must not be the seed of the demonstrations that are fitted, found 3" in capsys.readouterr().err
    # The seed of the command makes none of the demonstrations of a file.
    assert cli.main([*given, "fit.seed=0", f"out={tmp_path}/other"]) == 0
