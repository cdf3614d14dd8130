"""A whole evaluation, with greedy in the policy's place: its report, its schema, its table."""

import json
from functools import cache

import numpy as np
import pytest
from helpers_shelf import reward_of, shelf, taught
from pydantic import BaseModel, ValidationError
from rich.console import Console
from rich.table import Table

from koopdqn import pose
from koopdqn.app.commands.eval import holdout_table, off, table
from koopdqn.errors import BadInputError
from koopdqn.evaluation import schema
from koopdqn.evaluation.baselines import Greedy
from koopdqn.evaluation.evaluate import Evaluation, evaluate, work_units
from koopdqn.evaluation.schema import EvaluationReport, EvaluationSettings, MethodReport
from koopdqn.pose import Array
from koopdqn.settings import ReportModel, validate
from koopdqn.tasks.rollout import SUCCESS, Controller

SETTINGS = EvaluationSettings(
    episodes=5,
    seed=2000,
    start_scale=1.0,
    dynamics=True,
    dynamics_episodes=2,
    time_scale=2.0,
    baselines=True,
    video=False,
)
SHORT = SETTINGS.model_copy(update={"dynamics": False, "baselines": False})


def evaluated(settings: EvaluationSettings, policy: Controller | None = None, limit: int = 700) -> Evaluation:
    known = taught()
    chosen = policy or Greedy(known.model, shelf().task)
    return evaluate(shelf(), chosen, reward_of(known), known.trajectories, settings, limit)


@cache
def whole() -> Evaluation:
    return evaluated(SETTINGS)


def test_the_report_is_json_and_fits_its_schema() -> None:
    text = json.dumps(whole().report, allow_nan=False)
    assert EvaluationReport.model_validate(json.loads(text)).model_dump(mode="json") == whole().report


def test_the_report_says_what_was_asked_for() -> None:
    report = whole().report
    expected = {"task": "shelf", "episodes": 5, "seed": 2000, "step_limit": 700}
    assert {key: report[key] for key in expected} == expected
    assert report["dynamics"]["episodes"] == 2
    assert (report["dynamics"]["time_scale"], report["dynamics"]["step_seconds"]) == (2.0, 0.04)


def test_the_top_level_is_the_policys_and_has_the_baselines_keys() -> None:
    report = whole().report
    policy = {key: report[key] for key in MethodReport.model_fields}
    # The policy here is the greedy baseline itself, from the same starts.
    assert policy == report["baselines"]["greedy"]
    for baseline in report["baselines"].values():
        assert set(baseline) == set(MethodReport.model_fields)


def test_going_straight_never_succeeds_on_the_shelf() -> None:
    straight = whole().report["baselines"]["straight_line"]
    assert straight["success_rate"] == 0.0
    assert straight["failures"]["collision"] == 5


def test_episodes_and_references_begin_alike() -> None:
    evaluation = whole()
    assert len(evaluation.episodes) == len(evaluation.references) == 5
    for episode, reference in zip(evaluation.episodes, evaluation.references, strict=True):
        assert np.array_equal(episode.poses[0], reference[0])


def test_the_same_seed_gives_the_same_report_and_another_seed_other_starts() -> None:
    first, again = evaluated(SHORT), evaluated(SHORT)
    assert first.report == again.report
    other = evaluated(SHORT.model_copy(update={"seed": 2001}))
    assert not np.array_equal(first.episodes[0].poses[0], other.episodes[0].poses[0])


def test_the_starts_are_no_stream_of_training_even_with_one_seed() -> None:
    cell = shelf()
    starts = np.array([episode.poses[0] for episode in evaluated(SHORT).episodes])
    for stream in ([2000, 1], [2000, 3], *([2000, 2, part] for part in range(3))):
        theirs = cell.reachability.draw_starts(cell.task, np.random.default_rng(stream), 5)[0]
        assert not np.any(np.all(starts[:, None] == theirs, axis=2))


def test_what_is_not_asked_for_is_null() -> None:
    report = evaluated(SHORT).report
    assert report["dynamics"] is None
    assert report["baselines"] is None
    assert report["path_deviation_mm"] == whole().report["path_deviation_mm"]


def test_a_policy_that_never_succeeds_is_measured_too() -> None:
    def turn_to_goal(poses: Array, starts: Array) -> np.ndarray:
        return np.full(len(poses), 2)

    report = evaluated(SETTINGS.model_copy(update={"baselines": False}), turn_to_goal).report
    assert report["success_rate"] == 0.0
    assert report["failures"]["stuck"] == 5
    assert report["dynamics"]["episodes"] == 0
    EvaluationReport.model_validate(report)


def test_progress_adds_up_to_all_of_the_work() -> None:
    known, told = taught(), list[int]()
    policy = Greedy(known.model, shelf().task)
    evaluate(shelf(), policy, reward_of(known), known.trajectories, SETTINGS, 30, told.append)
    assert min(told) >= 0
    assert sum(told) == work_units(SETTINGS) == 57


def test_dynamics_runs_the_first_successful_paths_only() -> None:
    evaluation = whole()
    succeeded = sum(episode.outcome == SUCCESS for episode in evaluation.episodes)
    assert evaluation.report["dynamics"]["episodes"] == min(succeeded, SETTINGS.dynamics_episodes)
    assert evaluation.report["dynamics"]["contacts"]["episodes"] == 0


def test_a_path_that_never_began_has_no_distance_and_a_held_out_turn_is_measured_as_recorded() -> None:
    known = taught()
    far, turned = known.trajectories[0].copy(), known.trajectories[0].copy()
    far[:, 0] += 5.0
    turned[:, 3:] = pose.multiply(turned[:, 3:], pose.from_rotation_vector([0.0, 0.0, 0.5 * np.pi]))
    policy = Greedy(known.model, shelf().task)
    report = evaluate(shelf(), policy, reward_of(known), known.trajectories, SHORT, 700, held_out=[far, turned]).report
    never, begun = report["holdout"]["hausdorff_mm"]["policy"]
    assert never is None
    assert begun is not None
    assert report["holdout"]["policy"]["rotation_deviation_deg"]["mean"] == pytest.approx(90, abs=3)
    alone = {**report["holdout"], "hausdorff_mm": {"policy": [None]}}
    assert "–" in printed(holdout_table({**report, "holdout": alone}), 100)


def models() -> list[type[BaseModel]]:
    found = [value for value in vars(schema).values() if isinstance(value, type)]
    return [value for value in found if issubclass(value, ReportModel) and value is not ReportModel]


@pytest.mark.parametrize("model", models(), ids=lambda model: model.__name__)
def test_every_key_of_the_schema_is_described(model: type[BaseModel]) -> None:
    assert all(field.description for field in model.model_fields.values())


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("success_rate", 1.2),
        ("success_rate", float("nan")),
        ("success_interval_95", [0.5]),
        ("episodes", 0),
        ("unheard_of", 1),
        ("steps", {"mean": -1.0, "max": 3.0}),
    ],
)
def test_the_schema_refuses_what_cannot_be(key: str, value: object) -> None:
    with pytest.raises(ValidationError):
        EvaluationReport.model_validate({**whole().report, key: value})


def printed(shown: Table, width: int) -> str:
    console = Console(width=width, color_system=None)
    with console.capture() as capture:
        console.print(shown)
    return capture.get()


def test_the_table_has_a_row_per_method_and_fits_100_columns() -> None:
    text = printed(table(whole().report), 100)
    assert max(len(line) for line in text.splitlines()) <= 100
    assert "…" not in text
    rows = [text.index(name) for name in ("policy", "straight", "greedy", "nearest")]
    assert rows == sorted(rows)
    assert "5 collision" in text


def test_the_table_without_baselines_and_without_a_reference_is_one_row_without_deviations() -> None:
    report = evaluated(SHORT).report
    report["path_deviation_mm"] = dict.fromkeys(report["path_deviation_mm"])
    report["tube_fraction"] = None
    text = printed(table(report), 100)
    assert "policy" in text
    assert not any(word in text for word in ("greedy", "deviation", "sideways", "–  "))


def test_the_table_of_held_out_demonstrations_fits_80_columns() -> None:
    report = whole().report
    far = {**report, "path_deviation_mm": {"mean": 270.5, "p95_of_max": 519.0}}
    names = ("policy", *report["baselines"])
    holdout = {"demonstrations": 1, "policy": far, "baselines": report["baselines"]}
    report = {**report, "holdout": {**holdout, "hausdorff_mm": {name: [515.9] for name in names}}}
    text = printed(holdout_table(report), 80)
    assert "…" not in text
    assert "failures" in text
    assert "515.9 / 515.9" in text


@pytest.mark.parametrize(
    ("continuous", "ratio", "told"),
    [(True, 0.79, True), (True, 0.81, False), (True, 1.26, True), (False, 1.26, False), (False, 1.74, True)],
)
def test_a_length_far_off_is_told(continuous: bool, ratio: float, told: bool) -> None:
    method = {"turn": None, "rotation_deviation_deg": {"mean": 0.0, "max": 0.0}, "path_length_ratio": ratio}
    line = f"path length     {ratio:.2f} times that of hers on average"
    assert off(method, "hers", continuous=continuous) == [line] * told


def test_a_turn_is_told_where_one_is_learned_and_has_a_reference() -> None:
    turn: dict[str, object] = {"half_before_third": None, "while_moving": {}}
    method = {"turn": turn, "rotation_deviation_deg": {"mean": 38.43, "max": 104.4}, "path_length_ratio": None}
    assert off(method, "hers", continuous=True) == ["turn            38.4° off that of hers on average, 104° at most"]
    assert not off({**method, "turn": None}, "hers", continuous=True)
    assert not off({**method, "rotation_deviation_deg": {"mean": None, "max": None}}, "hers", continuous=True)


@pytest.mark.parametrize(
    ("key", "small"), [("episodes", 0), ("dynamics_episodes", 0), ("time_scale", 0.9), ("seed", -1)]
)
def test_settings_refuse_what_is_too_small(key: str, small: float) -> None:
    with pytest.raises(BadInputError, match=rf"eval\.{key}.*{small}"):
        validate({**SETTINGS.model_dump(), key: small}, EvaluationSettings, "eval")
