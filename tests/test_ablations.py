import importlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import ablations
import pytest
from ablation_tables import Row, shown, signed, spread, table, with_table
from ablation_variants import ALL_TRIED, CASES, DEFAULT, VARIANTS, Variant
from ablations import Run
from hypothesis import given
from hypothesis import strategies as st
from measured_runs import carry_out

from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.errors import BadInputError

ROOT = Path(__file__).resolve().parents[1]
ROW = Row(
    case="shelf",
    variant="sign",
    seed=0,
    overrides=["reward.shape=sign"],
    learned=True,
    episodes=100,
    oracle_queries=2,
    seconds=20.0,
    trusted_right=0.99,
    success_rate=1.0,
    deviation_mm=20.0,
)
PLAIN = replace(ROW, variant=DEFAULT.name, oracle_queries=5, deviation_mm=18.5)
CASE = {case.name: case for case in CASES}
SIGN = next(variant for variant in VARIANTS if variant.name == "sign")
PAGE = "above\n\n<!-- begin: ablations -->\n<!-- end: ablations -->\n\nbelow\n"
ALGORITHM = (ROOT / "docs" / "algorithm.md").read_text(encoding="utf-8")
DEVIATIONS = ALGORITHM.partition("## Deviations\n")[2].partition("\n### ")[0]


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
                names = ("episodes", "oracle_queries", "seconds")
                report = {name: getattr(ROW, name) for name in names} | {"learned": self._train_status == 0}
                write(folder / "train.json", {**report, "reward_agreement": {"trusted": 0.99}})
            return self._train_status
        report = {"success_rate": 0.98, "path_deviation_mm": {"mean": 20.0}}
        write(folder / "eval.json", {**report, "holdout": {"hausdorff_mm": {"policy": [31.0]}}})
        return 0


def write(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content), encoding="utf-8")


def begin(folder: Path, arguments: Sequence[str]) -> None:
    # JSON is YAML, which Hydra records the overrides in.
    write(folder / ".hydra" / "overrides.yaml", [*arguments, "command=train"])


def tree(*overrides: str) -> Any:
    """Return the config tree of a training under overrides, less Hydra's own node."""
    found = composed(prepare("train", [*overrides, "out=unused"]).overrides)
    return {key: found[key] for key in found if key != "hydra"}


def leaves(node: Any, prefix: str = "") -> dict[str, Any]:
    """Return the values of a tree by their dotted names."""
    if not isinstance(node, Mapping) and not hasattr(node, "items"):
        return {prefix.removesuffix("."): node}
    found: dict[str, Any] = {}
    for name in node:
        found |= leaves(node[name], f"{prefix}{name}.")
    return found


def test_variants_have_names_of_their_own_and_differ_from_the_default() -> None:
    assert len({variant.name for variant in VARIANTS}) == len(VARIANTS)
    assert len({variant.overrides for variant in VARIANTS}) == len(VARIANTS)
    assert VARIANTS[0] is DEFAULT
    assert DEFAULT.overrides == ()


@pytest.mark.parametrize("task", ["shelf", "knife"])
@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: variant.name)
def test_every_variant_is_a_valid_config_other_than_the_default(task: str, variant: Variant) -> None:
    changed, default = (
        Configuration.load(tree(f"task={task}", *overrides)).shaped_by() for overrides in (variant.overrides, ())
    )
    assert (changed == default) == (variant is DEFAULT)


def test_deviations_are_numbered_without_gaps_and_are_twenty_at_most() -> None:
    numbers = [int(number) for number in re.findall(r"^\| D(\d+) \|", DEVIATIONS, re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) <= 20
    assert {number for variant in VARIANTS for number in variant.undone} == set(numbers)
    assert all(variant.undone for variant in VARIANTS[1:])


def test_no_page_or_line_of_code_names_a_deviation_that_is_not_there() -> None:
    known = set(re.findall(r"^\| D(\d+) \|", DEVIATIONS, re.MULTILINE))
    files = [*ROOT.glob("*.md"), *(path for name in ("docs", "conf", "koopdqn") for path in (ROOT / name).rglob("*.*"))]
    for path in files:
        if path.suffix in (".md", ".py", ".yaml"):
            assert set(re.findall(r"(?<!#)\bD(\d+)\b", path.read_text(encoding="utf-8"))) <= known, path


@pytest.mark.parametrize("variant", VARIANTS[1:], ids=lambda variant: variant.name)
def test_a_deviations_row_gives_the_overrides_that_undo_it(variant: Variant) -> None:
    last = {
        int(line.split("|")[1].strip().removeprefix("D")): set(re.findall(r"[\w.]+=[^\s`]+", line.split("|")[6]))
        for line in DEVIATIONS.splitlines()
        if line.startswith("| D")
    }

    def same(item: str) -> str:
        name, _, value = item.partition("=")
        try:
            return f"{name}={float(value)}"
        except ValueError:
            return item

    given = {same(item) for number in variant.undone for item in last[number]}
    assert {same(item) for item in variant.overrides} <= given


@pytest.mark.parametrize("task", ["shelf", "knife"])
def test_every_setting_in_which_the_paper_preset_differs_is_named_among_the_deviations(task: str) -> None:
    default, paper = (leaves(tree(f"task={task}", f"preset={preset}")) for preset in ("default", "paper"))
    # Intent and trust are whole options of their groups.
    differ = {
        name for name in default if not name.startswith(("intent.", "trust.")) and default[name] != paper.get(name)
    }
    assert len(differ) > 20
    for name in sorted(differ - {"agent.name"}):
        last = name.rpartition(".")[2]
        assert last in DEVIATIONS or {"gamma": "γ"}.get(last, last) in DEVIATIONS, name


def test_the_functions_of_algorithm_1_exist() -> None:
    section = ALGORITHM.partition("## Algorithm 1")[2].partition("\n## ")[0]
    owner: Any = None
    found = 0
    for name in re.findall(r"`(\.?\w[\w.]*)`", section):
        if name.startswith("."):
            assert hasattr(owner, name[1:]), name
        else:
            parts = name.split(".")
            module = importlib.import_module(f"koopdqn.{parts[0]}.{parts[1]}")
            for part in parts[2:]:
                owner, module = module, getattr(module, part)
        found += 1
    assert found > 20


def test_a_run_trains_then_evaluates_and_is_not_made_again(tmp_path: Path) -> None:
    run, launcher = Run(CASE["shelf"], SIGN, 1, root=tmp_path), Launcher()
    assert run.row() is None
    assert carry_out(run, launcher) == ""
    (first, trained_with), (second, measured_with) = launcher.calls
    assert (first, second) == ("train", "eval")
    expected = ["task=shelf", "reward.shape=sign", f"train.max_steps={ALL_TRIED}", "seed=1"]
    assert trained_with == [*expected, f"out={run.folder / 'train'}"]
    assert measured_with[:2] == [f"run={run.folder / 'train'}", f"out={run.folder / 'eval'}"]
    row = run.row()
    assert row is not None
    assert (row.seed, row.success_rate, row.deviation_mm) == (1, 0.98, 20.0)
    assert carry_out(run, launcher) == ""
    assert len(launcher.calls) == 2


def test_motions_of_people_are_measured_against_the_one_held_out(tmp_path: Path) -> None:
    run, launcher = Run(CASE["plate"], SIGN, 0, tmp_path / "people", tmp_path), Launcher()
    assert carry_out(run, launcher) == ""
    assert f"demos={tmp_path / 'people' / 'franka' / 'plate.csv'}" in launcher.calls[0][1]
    row = run.row()
    assert row is not None
    assert row.deviation_mm == 31.0


def test_a_set_that_is_not_there_is_left_out_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "franka" / "plate.csv", "")
    assert [case.name for case in ablations.cases_found(CASES, tmp_path)] == ["shelf", "knife", "plate"]
    streams = capsys.readouterr()
    assert "pouring is left out" in streams.out + streams.err


def test_an_interrupted_training_goes_on_and_a_finished_one_is_only_evaluated(tmp_path: Path) -> None:
    run = Run(CASE["shelf"], SIGN, 0, root=tmp_path)
    train = run.folder / "train"
    begin(train, [*run.overrides, f"out={train}"])
    assert run.commands()[0] == ("train", [f"run={train}"])
    write(train / "train.json", {})
    assert [command for command, _ in run.commands()] == ["eval"]


def test_a_run_that_does_not_learn_is_a_row(tmp_path: Path) -> None:
    run = Run(CASE["shelf"], SIGN, 0, root=tmp_path)
    assert carry_out(run, Launcher(train_status=1)) == ""
    row = run.row()
    assert row is not None
    assert not row.learned


def test_a_crash_is_told_and_the_others_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = Launcher()

    def launch(command: str, arguments: Sequence[str], output: Path) -> int:
        return 1 if "seed=1" in arguments else good(command, arguments, output)

    runs = ablations.runs_of([CASE["shelf"]], [SIGN], [1, 2], root=tmp_path)
    assert ablations.measure(runs, launch) == 1
    assert "shelf sign seed 1: train ended with exit status 1" in capsys.readouterr().err
    assert runs[0].row() is None
    assert runs[1].row() is not None


def test_everything_is_measured_with_one_seed_before_the_next() -> None:
    runs = ablations.runs_of(CASES, VARIANTS, [2, 0])
    assert [run.seed for run in runs] == [2] * (len(runs) // 2) + [0] * (len(runs) // 2)
    assert [run.case for run in runs[: len(CASES)]] == list(CASES)
    assert {run.variant for run in runs[: len(CASES)]} == {DEFAULT}


def test_results_of_other_overrides_are_refused_before_anything_runs(tmp_path: Path) -> None:
    run, other = (Run(CASE["shelf"], variant, 0, root=tmp_path) for variant in (SIGN, DEFAULT))
    begin(run.folder / "train", [*run.overrides, "agent.gamma=0.7"])
    launcher = Launcher()
    with pytest.raises(BadInputError, match=r"found one with .*agent\.gamma=0\.7"):
        ablations.measure([other, run], launcher)
    assert launcher.calls == []


def test_the_results_are_written_from_what_is_finished(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(PAGE, encoding="utf-8")
    for variant in (SIGN, DEFAULT):
        carry_out(Run(CASE["knife"], variant, 2, root=tmp_path), Launcher())
    rows = ablations.write_results(root=tmp_path, page=page)
    assert [(row.case, row.variant, row.seed) for row in rows] == [("knife", "default", 2), ("knife", "sign", 2)]
    held = json.loads((tmp_path / "ablations.json").read_text(encoding="utf-8"))
    assert held[1]["overrides"] == ["reward.shape=sign"]
    assert "Seed 2." in page.read_text(encoding="utf-8")


def test_the_page_has_a_place_for_the_table(tmp_path: Path) -> None:
    assert "| D5 | `reward.shape=sign` |" in with_table(ALGORITHM, [PLAIN, ROW])


def test_a_cell_is_the_difference_from_the_default_with_the_same_seed() -> None:
    rows = [
        PLAIN,
        replace(PLAIN, seed=1, oracle_queries=20),
        replace(ROW, seed=1, learned=False, success_rate=0.5, oracle_queries=1020),
        ROW,
    ]
    _, _, default, sign = table(rows).splitlines()
    assert default == "| – | the default | shelf | 100 | 12 (5 to 20) | 18.5 | 99 | 20 |"
    figures = "−25 (−50 to 0); learned 1 of 2 | +498 (−3 to +1,000) | +1.5 | 0 | 0"
    assert sign == f"| D5 | `reward.shape=sign` | shelf | {figures} |"


def test_a_variants_cases_stand_below_one_another() -> None:
    rows = [row for case in ("shelf", "plate") for row in (replace(PLAIN, case=case), replace(ROW, case=case))]
    lines = table(rows).splitlines()[2:]
    assert [line.split(" | ")[:3] for line in lines] == [
        ["| –", "the default", "shelf"],
        ["| ", "", "plate"],
        ["| D5", "`reward.shape=sign`", "shelf"],
        ["| ", "", "plate"],
    ]


def test_what_was_measured_with_fewer_seeds_than_the_default_says_so() -> None:
    rows = [PLAIN, replace(PLAIN, seed=1), replace(ROW, seed=1), replace(ROW, seed=2)]
    assert "| shelf, seed 1 alone | 0 | −3 | +1.5 | 0 | 0 |" in table(rows)
    assert len(table([replace(ROW, seed=2)]).splitlines()) == 2


@given(st.floats(-1e6, 1e6))
def test_a_difference_has_the_sign_of_what_is_shown(value: float) -> None:
    text = signed(value, "mm")
    assert float(text.replace("−", "-").replace(",", "")) == pytest.approx(value, abs=0.051)
    assert text[0] in "+−" or set(text) <= set("0.")


@given(st.lists(st.floats(0, 1e6), min_size=1))
def test_a_spread_keeps_the_mean_within_the_range(values: list[float]) -> None:
    text = spread(values, lambda value: shown(value, "mm"))
    numbers = [float(part) for part in re.split(r" \(| to ", text.replace(")", ""))]
    if len(numbers) == 3:
        mean, low, high = numbers
        assert low <= mean <= high
    else:
        assert max(values) - min(values) <= 0.1001


def test_unknown_values_do_not_count() -> None:
    assert spread([None, 0.25], str) == "0.25"
    assert spread([None], str) == "–"


@pytest.mark.parametrize("page", ["", "<!-- begin: ablations -->\n", PAGE + PAGE])
def test_a_page_without_its_part_is_refused(page: str) -> None:
    with pytest.raises(BadInputError, match="must stand in the text once"):
        with_table(page, [ROW])
