import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.config.resources import conf_dir
from koopdqn.errors import BadInputError

# The Makefile runs scripts as files, which puts their folder first on the path.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import ablations
from ablation_tables import BEGIN, END, Row, spread, table, with_tables
from ablation_variants import ALL_TRIED, VARIANTS, Variant
from ablations import Run
from measured_runs import carry_out

ROW = Row(
    task="shelf",
    variant="sign",
    seed=0,
    overrides=["reward.shape=sign"],
    learned=True,
    episodes=100,
    env_steps=100_000,
    updates=750,
    oracle_queries=2,
    seconds=20.0,
    reward_agreement={"trusted": 0.99, "remembered": None, "asked": 1.0},
    success_rate=1.0,
    path_deviation_mm=20.0,
    lateral_deviation_mm=9.0,
    failures={},
    evaluated=100,
)
SIGN = next(variant for variant in VARIANTS if variant.name == "sign")


class Launcher:
    """Stands in for the koopdqn command: notes what it is told and leaves the files that the command would."""

    def __init__(self, train_status: int = 0, reports: bool = True) -> None:
        self.calls: list[tuple[str, list[str]]] = []
        self._train_status = train_status
        self._reports = reports

    def __call__(self, command: str, arguments: Sequence[str], output: Path) -> int:
        self.calls.append((command, list(arguments)))
        given = dict(item.partition("=")[::2] for item in arguments)
        folder = Path(given["out"] if "out" in given else given["run"])
        if command == "train":
            if "out" in given:
                begin(folder, arguments)
            if self._reports:
                names = ("episodes", "env_steps", "updates", "oracle_queries", "seconds", "reward_agreement")
                report = {name: getattr(ROW, name) for name in names} | {"learned": self._train_status == 0}
                write(folder / "train.json", report)
            return self._train_status
        deviation = {"mean": 20.0}
        write(
            folder / "eval.json",
            {
                "success_rate": 0.98,
                "path_deviation_mm": deviation,
                "lateral_deviation_mm": deviation,
                "failures": {"collision": 2, "stuck": 0},
                "episodes": 100,
            },
        )
        return 0


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


def begin(folder: Path, arguments: Sequence[str]) -> None:
    # JSON is YAML, which Hydra records the overrides in.
    write(folder / ".hydra" / "overrides.yaml", [*arguments, "command=train"])


def test_variants_have_names_of_their_own_and_differ_from_the_default() -> None:
    assert len({variant.name for variant in VARIANTS}) == len(VARIANTS)
    assert len({variant.overrides for variant in VARIANTS}) == len(VARIANTS)
    assert VARIANTS[0].overrides == ()


@pytest.mark.parametrize("task", ablations.TASKS)
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_every_variant_is_a_valid_config_other_than_the_default(task: str, variant: Variant) -> None:
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from koopdqn.commands.configuration import Configuration

    def shape(overrides: Sequence[str]) -> dict[str, object]:
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            config = compose("config", overrides=[*overrides, "out=unused"])
        # The run folder's resolver belongs to Hydra's own node, which is not composed here.
        return Configuration.load(OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])).shaped_by()

    run = Run(task, variant, 0)
    changed, default = shape(run.overrides), shape([f"task={task}", "seed=0"])
    assert (changed == default) == (variant.name == "default")


def test_a_run_trains_then_evaluates_and_is_not_made_again(tmp_path: Path) -> None:
    run, launcher = Run("shelf", SIGN, 1, tmp_path), Launcher()
    assert run.row() is None
    assert carry_out(run, launcher) == ""
    (first, trained_with), (second, measured_with) = launcher.calls
    assert (first, second) == ("train", "eval")
    expected = ["task=shelf", "reward.shape=sign", f"train.max_steps={ALL_TRIED}", "seed=1"]
    assert trained_with == [*expected, f"out={run.folder / 'train'}"]
    assert measured_with[:2] == [f"run={run.folder / 'train'}", f"out={run.folder / 'eval'}"]
    row = run.row()
    assert row is not None
    assert (row.seed, row.success_rate, row.failures) == (1, 0.98, {"collision": 2})
    assert carry_out(run, launcher) == ""
    assert len(launcher.calls) == 2


def test_an_interrupted_training_goes_on_and_a_finished_one_is_only_evaluated(tmp_path: Path) -> None:
    run = Run("shelf", SIGN, 0, tmp_path)
    train = run.folder / "train"
    begin(train, [*run.overrides, f"out={train}"])
    assert run.commands()[0] == ("train", [f"run={train}"])
    write(train / "train.json", {})
    assert [command for command, _ in run.commands()] == ["eval"]


def test_a_run_that_does_not_learn_is_a_row(tmp_path: Path) -> None:
    run = Run("shelf", SIGN, 0, tmp_path)
    assert carry_out(run, Launcher(train_status=1)) == ""
    row = run.row()
    assert row is not None
    assert not row.learned


def test_a_crash_is_told_and_the_others_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = Launcher()

    def launch(command: str, arguments: Sequence[str], output: Path) -> int:
        return 1 if "seed=1" in arguments else good(command, arguments, output)

    runs = ablations.runs_of(["shelf"], [SIGN], [1, 2], tmp_path)
    assert ablations.measure(runs, launch) == 1
    assert "shelf sign seed 1: train ended with exit status 1" in capsys.readouterr().err
    assert runs[0].row() is None
    assert runs[1].row() is not None


def test_results_of_other_overrides_are_refused_before_anything_runs(tmp_path: Path) -> None:
    run, other = Run("shelf", SIGN, 0, tmp_path), Run("shelf", VARIANTS[0], 0, tmp_path)
    begin(run.folder / "train", [*run.overrides, "agent.gamma=0.7"])
    launcher = Launcher()
    with pytest.raises(BadInputError, match=r"found one with .*agent\.gamma=0\.7"):
        ablations.measure([other, run], launcher)
    assert launcher.calls == []


def test_the_results_are_written_from_what_is_finished(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"above\n\n{BEGIN}\n{END}\n\nbelow\n", encoding="utf-8")
    carry_out(Run("knife", SIGN, 2, tmp_path), Launcher())
    rows = ablations.write_results(tmp_path, page)
    assert [(row.task, row.variant, row.seed) for row in rows] == [("knife", "sign", 2)]
    held = json.loads((tmp_path / "ablations.json").read_text(encoding="utf-8"))
    assert held[0]["overrides"] == ["reward.shape=sign", f"train.max_steps={ALL_TRIED}"]
    assert "### knife: seeds 2" in page.read_text(encoding="utf-8")


def test_the_table_has_a_line_a_variant_with_mean_and_range() -> None:
    rows = [ROW, replace(ROW, seed=1, learned=False, success_rate=0.5, failures={"step_limit": 50})]
    head, rule, *lines = table(rows).splitlines()
    assert len(lines) == 1
    assert head.count("|") == rule.count("|") == lines[0].count("|")
    assert "| 1 of 2 |" in lines[0]
    assert "| 75 (50–100) |" in lines[0]
    assert "| 50 step limit of 200 |" in lines[0]


@given(st.lists(st.floats(0, 1e6), min_size=1))
def test_a_spread_keeps_the_mean_within_the_range(values: list[float]) -> None:
    numbers = [float(part) for part in spread(values, "mm").replace(")", "").replace("(", "–").split("–")]
    if len(numbers) == 3:
        mean, low, high = numbers
        assert low <= mean <= high
    else:
        assert max(values) - min(values) <= 0.1001


def test_unknown_values_do_not_count() -> None:
    assert spread([None, 0.25], "share") == "25"
    assert spread([None], "mm") == "–"


@given(st.text(alphabet="ab \n|"), st.text(alphabet="ab \n|"))
def test_only_what_is_between_the_markers_changes_and_a_second_time_nothing(above: str, below: str) -> None:
    once = with_tables(f"{above}{BEGIN}\nold\n{END}{below}", [ROW])
    assert once.startswith(above + BEGIN)
    assert once.endswith(END + below)
    assert "old" not in once
    assert with_tables(once, [ROW]) == once


@pytest.mark.parametrize("page", ["", BEGIN, END, END + BEGIN, BEGIN + END + BEGIN + END])
def test_a_page_without_its_markers_is_refused(page: str) -> None:
    with pytest.raises(BadInputError, match="once, in that order"):
        with_tables(page, [ROW])
