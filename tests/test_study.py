"""The study: its runs, how they go on, and its tables."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import study
from hypothesis import given
from hypothesis import strategies as st
from imitate import IMITATION, METHODS
from measured_runs import carry_out
from study import Run
from study_lines import COMPARISONS, DEFAULT, EVALUATION_SEED, LINES, SEEDS, TASKS, Comparison, Line
from study_tables import PaperRun, Result, comparison_table, least_check, table, with_tables

from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import Baselines
from koopdqn.resources import conf_dir

LINE = {line.name: line for line in LINES}
MEASURED = tuple(Baselines.model_fields)
SHA = "0" * 64
STARTS = f"eval.seed={EVALUATION_SEED}"
RESULT = Result(
    task="shelf",
    line=DEFAULT,
    seed=0,
    learned=True,
    success_rate=1.0,
    path_deviation_mm=5.0,
    p95_of_max_mm=14.0,
    rotation_deviation_deg=2.0,
    questions=10,
    trusted=0.99,
    remembered=None,
    least_check=None,
    seconds=30.0,
    failures={},
    demonstrations=SHA,
)
PAPER = PaperRun(
    learned=False, episodes=1500, seconds=8000.0, questions=4321, success_rate=0.25, path_deviation_mm=70.0
)
PAGE = "above\n\n<!-- begin: study -->\n<!-- end: study -->\n\nbelow\n"


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


class Launcher:
    """Stands in for the commands: notes what it is told and leaves the files that they would."""

    def __init__(self, train_status: int = 0, demonstrations: str = SHA) -> None:
        self.calls: list[tuple[str, list[str]]] = []
        self._train_status = train_status
        self._made_from = {"demonstrations": demonstrations}

    def __call__(self, command: str, arguments: Sequence[str], output: Path) -> int:
        self.calls.append((command, list(arguments)))
        given = dict(item.partition("=")[::2] for item in arguments)
        folder = Path(given["out"])
        if command == "train":
            # JSON is YAML, which Hydra records the overrides in.
            write(folder / ".hydra" / "overrides.yaml", [*arguments, "command=train"])
            write(folder / "train.json", self._train_report())
            return self._train_status
        method = {
            "success_rate": 0.9,
            "path_deviation_mm": {"mean": 5.0, "p95_of_max": 14.0},
            "rotation_deviation_deg": {"mean": 2.0},
            "failures": {"collision": 10, "stuck": 0},
        }
        baselines = dict.fromkeys(MEASURED, method) if given.get("eval.baselines") == "true" else None
        if command == "imitate":
            write(folder / IMITATION, {"seconds": 3.0, "oracle_queries": 5, "made_from": self._made_from})
        write(folder / "eval.json", {**method, "baselines": baselines})
        return 0

    def _train_report(self) -> dict[str, object]:
        return {
            "learned": self._train_status == 0,
            "learned_at_env_steps": 100 if self._train_status == 0 else None,
            "checks": [{"env_steps": 100, "success_rate": 1.0}],
            "oracle_queries": 7,
            "seconds": 30.0,
            "reward_agreement": {"trusted": 0.99, "remembered": 1.0, "asked": 1.0},
            "made_from": self._made_from,
        }


def test_lines_have_names_of_their_own_and_those_without_a_training_name_one() -> None:
    assert len(LINE) == len(LINES)
    assert all(set(line.baselines) <= set(MEASURED) for line in LINES)
    names = [name for line in LINES for name in (line.name, *map(line.named, line.baselines))]
    assert len(set(names)) == len(names)
    for line in LINES:
        assert set(line.seeds) <= set(SEEDS)
        assert bool(line.of) == (bool(line.method) or (not line.overrides and line.name != DEFAULT))
        assert line.of in ("", DEFAULT)
        assert line.method in ("", *METHODS)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("line", LINES, ids=lambda line: line.name)
def test_every_line_is_a_valid_config(task: str, line: Line) -> None:
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from koopdqn.app.commands.configuration import Configuration

    def loaded(overrides: Sequence[str]) -> tuple[object, ...]:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            config = compose("config", overrides=[*overrides, "out=unused"])
        found = Configuration.load(OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"]))
        return found.shaped_by(), found.train, found.oracle, found.eval

    run = Run(task, line, 0)
    own, default = loaded([*run.training.overrides, *line.evaluation]), loaded([f"task={task}", "seed=0"])
    assert (own == default) == ((not line.overrides and not line.evaluation) or line.name == DEFAULT)


def test_a_run_trains_then_evaluates_and_is_not_made_again(tmp_path: Path) -> None:
    run, launcher = Run("shelf", LINE["gamma-0"], 1, tmp_path), Launcher()
    assert run.results() == []
    assert carry_out(run, launcher) == ""
    train, measured = run.folder / "train", run.folder / "eval"
    assert launcher.calls == [
        ("train", ["task=shelf", "agent.gamma=0.0", "seed=1", f"out={train}"]),
        ("eval", [f"run={train}", f"out={measured}", "eval.dynamics=false", STARTS, "eval.baselines=false"]),
    ]
    assert [(result.line, result.seed, result.questions) for result in run.results()] == [("gamma-0", 1, 7)]
    assert carry_out(run, launcher) == ""
    assert len(launcher.calls) == 2


@pytest.mark.parametrize("name", ["wide", *METHODS])
def test_lines_of_the_default_measure_its_training_and_make_it_if_it_is_missing(tmp_path: Path, name: str) -> None:
    default, run, launcher = Run("knife", LINE[DEFAULT], 2, tmp_path), Run("knife", LINE[name], 2, tmp_path), Launcher()
    assert carry_out(run, launcher) == ""
    assert [command for command, _ in launcher.calls] == ["train", "imitate" if name in METHODS else "eval"]
    assert carry_out(default, launcher) == ""
    assert [command for command, _ in launcher.calls][2:] == ["eval"]
    assert f"run={default.folder / 'train'}" in launcher.calls[1][1]
    assert launcher.calls[1][1][-1 if name in METHODS else 3] == STARTS
    assert {result.demonstrations for result in run.results()} == {SHA}
    assert run.results()[0].questions == (5 if name in METHODS else 7)


@pytest.mark.parametrize("name", [DEFAULT, "wide"])
def test_the_baselines_below_a_line_are_measured_with_it(tmp_path: Path, name: str) -> None:
    line, launcher = LINE[name], Launcher()
    run = Run("shelf", line, 0, tmp_path)
    carry_out(run, launcher)
    assert launcher.calls[1][1][2:] == ["eval.dynamics=false", STARTS, "eval.baselines=true", *line.evaluation]
    results = run.results()
    assert line.baselines
    assert [result.line for result in results] == [name, *map(line.named, line.baselines)]
    assert [result.questions for result in results] == [7] + [0] * len(line.baselines)


def test_an_evaluation_without_the_baselines_is_bad_input(tmp_path: Path) -> None:
    run = Run("shelf", LINE["wide"], 0, tmp_path)
    carry_out(run, Launcher())
    measured = run.folder / "eval" / "eval.json"
    write(measured, {**json.loads(measured.read_text(encoding="utf-8")), "baselines": None})
    with pytest.raises(BadInputError, match=r"eval\.json: must hold the baseline greedy, found none"):
        run.results()


def test_a_training_that_does_not_learn_is_a_result(tmp_path: Path) -> None:
    run = Run("shelf", LINE["gamma-0"], 0, tmp_path)
    assert carry_out(run, Launcher(train_status=1)) == ""
    assert [result.learned for result in run.results()] == [False]


def test_the_table_grows_run_by_run_and_no_run_is_begun_after_the_time(tmp_path: Path) -> None:
    page, launcher, missing = tmp_path / "page.md", Launcher(), tmp_path / "none.json"
    page.write_text(PAGE, encoding="utf-8")
    runs = study.runs_of(["shelf"], LINES, [SEEDS[0], SEEDS[9]], tmp_path)
    assert study.measure(runs, launcher, 0.0, tmp_path, page, missing) == 0
    assert launcher.calls == []
    assert study.measure(runs[:1], launcher, None, tmp_path, page, missing) == 0
    assert study.measure(runs[:1], launcher, 0.0, tmp_path, page, missing) == 0
    text = page.read_text(encoding="utf-8")
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert all(about in text for about in (LINE[DEFAULT].about, *LINE[DEFAULT].baselines.values(), "not measured"))
    assert LINE["gamma-0"].about not in text
    held = json.loads((tmp_path / "study.json").read_text(encoding="utf-8"))
    assert [each["line"] for each in held] == [DEFAULT, *map(LINE[DEFAULT].named, LINE[DEFAULT].baselines)]


def test_long_lines_have_fewer_seeds() -> None:
    names = [(run.line.name, run.seed) for run in study.runs_of(["shelf"], LINES, SEEDS)]
    assert ("always-ask", SEEDS[2]) in names
    assert ("always-ask", SEEDS[3]) not in names
    assert ("default", SEEDS[9]) in names
    assert len(set(names)) == len(names)


def test_other_persons_are_measured_on_the_shelf_with_demonstrations_of_their_own(tmp_path: Path) -> None:
    names = [run.line.name for run in study.runs_of(["knife"], LINES, SEEDS)]
    assert "square" not in names
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    carry_out(Run("shelf", LINE[DEFAULT], SEEDS[0], tmp_path), Launcher())
    carry_out(Run("shelf", LINE["square"], SEEDS[0], tmp_path), Launcher(demonstrations="1" * 64))
    held = study.write_results(tmp_path, page, tmp_path / "none.json")
    assert {"square", "square/floor"} <= {result.line for result in held}


def test_runs_that_learned_from_different_demonstrations_are_not_put_together(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    carry_out(Run("shelf", LINE[DEFAULT], SEEDS[0], tmp_path), Launcher())
    carry_out(Run("shelf", LINE["gamma-0"], SEEDS[0], tmp_path), Launcher(demonstrations="1" * 64))
    with pytest.raises(BadInputError, match=r"same demonstrations with seed 100, found default and gamma-0 to differ"):
        study.write_results(tmp_path, page, tmp_path / "none.json")


@pytest.mark.parametrize(
    ("content", "rule"), [({"shelf": {}}, "shelf"), ({"shelf": {**PAPER.model_dump(), "success_rate": 2.0}}, "2.0")]
)
def test_kept_results_that_break_a_rule_are_refused(tmp_path: Path, content: object, rule: str) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    write(tmp_path / "paper.json", content)
    with pytest.raises(BadInputError, match=rule):
        study.write_results(tmp_path, page, tmp_path / "paper.json")


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_line_of_the_table_is_over_its_seeds() -> None:
    others = [
        replace(RESULT, seed=seed, success_rate=rate, questions=asked, learned=seed != 2, trusted=None)
        for seed, rate, asked in ((1, 0.5, 0), (2, 0.75, 400), (7, 0.75, 20))
    ]
    head, rule, row, paper = table([RESULT, *others], PAPER).splitlines()
    assert len({len(cells(line)) for line in (head, rule, row, paper)}) == 1
    found = dict(zip(cells(head), cells(row), strict=True))
    assert found["seeds"] == "0–2, 7"
    assert found["learned"] == "3 of 4"
    assert found["success [%]"] == "75 (50)"
    assert found["questions"] == "15 (400)"
    assert found["trusted right [%]"] == "99"
    assert found["remembered right [%]"] == "–"
    kept = dict(zip(cells(head), cells(paper), strict=True))
    assert (kept["success [%]"], kept["questions"], kept["deviation [mm]"]) == ("25", "4,321", "70.0")
    assert kept["learned"] == "0 of 1 (1,500 episodes)"


def test_lines_are_compared_seed_by_seed() -> None:
    with_it = [replace(RESULT, seed=seed, success_rate=rate) for seed, rate in ((1, 0.9), (2, 1.0), (3, 1.0))]
    without = [
        replace(RESULT, line="other", seed=seed, success_rate=0.8, path_deviation_mm=deviation, p95_of_max_mm=None)
        for seed, deviation in ((1, 6.0), (2, 4.0), (9, 50.0))
    ]
    compared = (Comparison("what it adds", DEFAULT, "other"), Comparison("not measured", DEFAULT, "none"))
    head, _, row = comparison_table([*with_it, *without], compared).splitlines()
    found = dict(zip(cells(head), cells(row), strict=True))
    assert found["seeds"] == "1–2"
    assert found["success [points]"] == "+15.0 (+10.0 to +20.0)"
    assert found["deviation [mm]"] == "0.0 (−1.0 to +1.0)"
    assert found["p95 of largest [mm]"] == "–"
    assert found["turn [°]"] == "0.0"
    assert (found["in every seed it adds"], found["in every seed it costs"]) == ("success", "nothing")
    _, _, row = comparison_table([*with_it, *without], (Comparison("", "other", DEFAULT),)).splitlines()
    assert cells(row)[-2:] == ["nothing", "success"]


def test_less_than_the_digit_shown_is_no_difference() -> None:
    other = replace(RESULT, line="other", path_deviation_mm=5.04)
    _, _, row = comparison_table([RESULT, other], (Comparison("what it adds", DEFAULT, "other"),)).splitlines()
    assert cells(row)[-2:] == ["nothing", "nothing"]


def test_what_is_compared_is_measured_with_the_same_seeds() -> None:
    seeds = {line.name: line.seeds for line in LINES}
    seeds |= {line.named(name): line.seeds for line in LINES for name in line.baselines}
    for each in COMPARISONS:
        assert set(seeds[each.line]) & set(seeds[each.beside])


@given(st.lists(st.integers(0, 50), min_size=1, unique=True), st.floats(0, 1))
def test_the_least_success_is_never_above_the_mean(seeds: list[int], low: float) -> None:
    results = [replace(RESULT, seed=seed, success_rate=max(low, (seed % 11) / 10)) for seed in seeds]
    cell = cells(table(results, None).splitlines()[2])[4]
    mean, _, least = cell.rstrip(")").partition(" (")
    assert float(least or mean) <= float(mean)


def test_the_least_check_is_that_after_it_had_learned() -> None:
    checks = [{"env_steps": steps, "success_rate": rate} for steps, rate in ((1, 0.2), (2, 1.0), (3, 0.9), (4, 1.0))]
    assert least_check({"learned_at_env_steps": 2, "checks": checks}) == 0.9
    assert least_check({"learned_at_env_steps": 4, "checks": checks}) is None
    assert least_check({"learned_at_env_steps": None, "checks": checks}) is None


def test_a_second_time_nothing_changes_and_a_page_without_its_part_is_refused() -> None:
    once = with_tables(PAGE, [RESULT], {"shelf": PAPER})
    assert with_tables(once, [RESULT], {"shelf": PAPER}) == once
    with pytest.raises(BadInputError, match="study"):
        with_tables("no part here", [RESULT], {})


def test_the_projects_own_page_has_its_part() -> None:
    page = (Path(__file__).resolve().parents[1] / study.PAGE).read_text(encoding="utf-8")
    assert "### shelf" in with_tables(page, [RESULT], {})
