import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import pytest
from report_runs import first, knife_parts, write_evaluation, write_run

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.commands import report
from koopdqn.app.commands.report import all_presets
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json
from koopdqn.report import page as build
from koopdqn.report.blocks import Missing, Table
from koopdqn.report.groups import DEFAULT, PAPER, group_runs
from koopdqn.report.material import gather
from koopdqn.report.numbers import ablations_table, evaluation_table, intents_table, runs_table, training_table
from koopdqn.report.paper import actions_table, comparison_table, hyperparameters_table
from koopdqn.report.runs import ReportFile, find_runs

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.report.groups import Groups, Presets

ABLATION = {"overrides": ["intent=line"], "learned": True, "episodes": 10, "oracle_queries": 3}
ABLATION |= {"success_rate": 0.5, "deviation_mm": None}


@pytest.fixture(scope="module")
def presets() -> "Presets":
    return all_presets()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, parts: "Parts", demonstrations: "Demonstrations") -> Path:
    """Finished runs of the shelf with two seeds, one of them evaluated, and ablations."""
    root = tmp_path_factory.mktemp("finished")
    for seed in range(2):
        write_run(root / f"run{seed}", parts, first(demonstrations, 2), seed)
    write_evaluation(root / "eval", parts, str(root / "run0"))
    rows = [{"case": "shelf", "variant": "line", "seed": seed, **ABLATION} for seed in range(2)]
    write_json(root / "ablations" / "ablations.json", rows)
    return root


@pytest.fixture(scope="module")
def groups(folder: Path, presets: "Presets") -> "Groups":
    return group_runs(find_runs([folder])[0], presets)[0]


@dataclass(frozen=True)
class Built:
    """A report: its folder, the content of its JSON, and how many units of work it told of."""

    folder: Path
    content: dict[str, Any]
    told: int


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, folder: Path) -> Built:
    """The report of those runs, made through the command line."""
    work = tmp_path_factory.mktemp("work")
    told: list[None] = []

    def counted(*arguments: Any) -> dict[str, Any]:
        counting = (*arguments[:-1], lambda: told.append(None))
        return build.build(*counting)

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(work)
        patch.setattr(report, "build", counted)
        for stream in (console.out, console.err):
            stream.cache_clear()
        assert cli.main(["report", f"report.runs=[{folder}]", "out=made"]) == 0
    where = work / "made" / "report"
    return Built(where, read_json(where / "report.json", "the report"), len(told))


def test_the_report_says_what_it_shows_and_what_it_lacks(built: Built, folder: Path) -> None:
    content = ReportFile.model_validate(built.content)
    assert [(run.task, run.preset, run.seed) for run in content.runs] == [("shelf", DEFAULT, 0), ("shelf", DEFAULT, 1)]
    assert [run.evaluation for run in content.runs] == [str(folder / "eval" / "eval.json"), None]
    assert [figure.number for figure in content.figures] == ["1", "2", "3", "4, left", "4, right", "5"]
    for figure in content.figures:
        for name in figure.files:
            assert (built.folder / name).read_bytes().startswith(b"\x89PNG")
    lacking = {part.what: part.command for part in content.missing}
    assert set(lacking) == {f"Figure {n}" for n in ("6, left", "6, right", "7", "8", "9, left", "9, right")}
    assert all(command.startswith("koopdqn train") for command in lacking.values())
    assert all("task=knife" in command for command in lacking.values())


def test_all_work_is_told(built: Built, groups: "Groups") -> None:
    assert built.told == build.work_units(groups)


def test_every_link_of_the_page_leads_to_a_file(built: Built) -> None:
    where, content = built.folder, built.content
    text = (where / "report.html").read_text(encoding="utf-8")
    links = set(re.findall(r'href="([^#"][^"]*)"', text))
    assert len(links) > 8
    for link in links:
        assert (where / unquote(link)).exists(), link
    assert text.count("data:image/png;base64,") == sum(len(figure["files"]) for figure in content["figures"])


def test_the_fits_that_tables_quote_are_kept(built: Built) -> None:
    for name in ("paper", "pose", "line", "joint"):
        kept = json.loads((built.folder / "fits" / f"shelf-{name}.json").read_text())
        assert kept["fit"]["intent"] == name
        assert len(kept["held_out"]["sixty_samples_error_m"]) == 59


def numbers_of(table: Table | Missing, ours: slice) -> list[Any]:
    assert isinstance(table, Table)
    return [cell for row in table.rows for cell in row[ours] if re.search(r"\d", cell.text)]


def test_every_number_of_ours_has_a_source_that_exists(groups: "Groups", presets: "Presets", folder: Path) -> None:
    tables = (
        (comparison_table(groups, {}), slice(2, None)),
        (hyperparameters_table(presets), slice(3, None)),
        (training_table(groups), slice(1, None)),
        (evaluation_table(groups), slice(1, None)),
        (ablations_table(folder / "ablations" / "ablations.json"), slice(2, None)),
    )
    for table, ours in tables:
        cells = numbers_of(table, ours)
        assert cells
        assert all(cell.sources and all(source.exists() for source in cell.sources) for cell in cells)


def test_means_and_ranges_are_over_all_seeds_and_what_failed_counts(groups: "Groups") -> None:
    table = training_table(groups)
    row = {name: cell.text for name, cell in zip(table.header, table.rows[0], strict=True)}
    assert row["learned"] == "1 of 2"
    assert row["questions"] == "12 (12–13)"
    assert row["time [s]"] == "10 (10–11)"
    assert len(runs_table(groups).rows) == 2


def test_the_papers_numbers_stand_as_it_gives_them(groups: "Groups", presets: "Presets") -> None:
    said = {row[0].text: row[1].text for row in comparison_table(groups, {}).rows}
    assert said["shelf: minutes to learn"] == "about 135 (§5.1)"
    assert said["knife: minutes to learn"] == "about 210 (§5.2)"
    assert said["shelf: episodes to learn"] == "1,200 (§5.1)"
    assert said["knife: questions asked"] == "not given"
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in hyperparameters_table(presets).rows}
    # Where the paper gives a number its preset has the same one.
    for name in ("max. number of episodes", "size of the replay buffer", "batch size", "inputs of the network"):
        assert rows[name][:2] == rows[name][2:4]
    assert [float(text) for text in rows["learning rate"][:4]] == [1e-5, 1e-4, 1e-5, 1e-4]
    assert len(actions_table().rows) == 10


def test_what_was_not_measured_is_said(groups: "Groups", tmp_path: Path) -> None:
    bare = {
        place: replace(group, runs=tuple(replace(r, evaluation=None, evaluation_file=None) for r in group.runs))
        for place, group in groups.items()
    }
    assert isinstance(evaluation_table(bare), Missing)
    missing = ablations_table(tmp_path / "ablations.json")
    assert isinstance(missing, Missing)
    assert missing.command == "make ablations"
    assert intents_table({}).rows == ()


def test_damaged_ablations_are_bad_input(tmp_path: Path) -> None:
    write_json(tmp_path / "ablations.json", [{"case": "shelf"}])
    with pytest.raises(BadInputError, match="must hold one row a run"):
        ablations_table(tmp_path / "ablations.json")


def test_demonstrations_that_allow_no_fit_leave_their_figures_out(
    tmp_path: Path, parts: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    write_run(tmp_path / "run", parts, first(demonstrations, 1))
    groups, left_out = group_runs(find_runs([tmp_path])[0], presets)
    content = build.build(groups, presets, {"shelf": {}}, left_out, tmp_path / "none.json", tmp_path / "report")
    reasons = {part["what"]: part["reason"] for part in content["missing"]}
    assert "must hold at least 2 demonstrations, found 1" in reasons["Figure 2"]
    # Rewards need no demonstrations.
    assert [figure["number"] for figure in content["figures"]] == ["1", "4, right"]


@pytest.mark.parametrize("make", [["--make"], ["report.make=true"]])
def test_make_trains_and_evaluates_what_is_missing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    parts: "Parts",
    demonstrations: "Demonstrations",
    make: list[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_run(tmp_path / "runs" / "shelf" / "old", parts, demonstrations, seed=0)
    knife = knife_parts()
    calls: list[tuple[str, ...]] = []

    def launch(command: str, overrides: list[str], result: Path) -> None:
        given = dict(item.split("=", 1) for item in overrides)
        calls.append((command, given.get("task", ""), given.get("seed", ""), given.get("run", "")))
        chosen = knife if "knife" in given["out"] else parts
        if command == "train":
            write_run(Path(given["out"]), chosen, demonstrations, int(given["seed"]))
        else:
            write_evaluation(Path(given["out"]), chosen, given["run"])
        assert result.is_file()

    shown: dict[tuple[str, str], list[tuple[int, bool]]] = {}

    def draw(groups: "Groups", *rest: object) -> dict[str, Any]:
        shown.update({place: [(r.seed, r.evaluation is not None) for r in g.runs] for place, g in groups.items()})
        return {"figures": [], "tables": [], "runs": [], "missing": []}

    monkeypatch.setattr(report, "_koopdqn", launch)
    monkeypatch.setattr(report, "build", draw)
    assert cli.main(["report", *make, "report.seeds=[0,1]", "out=made"]) == 0
    done = [(command, task, seed) for command, task, seed, _ in calls]
    assert done == [
        ("eval", "", ""),
        ("train", "shelf", "1"),
        ("eval", "", ""),
        ("train", "knife", "0"),
        ("eval", "", ""),
        ("train", "knife", "1"),
        ("eval", "", ""),
    ]
    assert calls[0][3] == str(Path("runs/shelf/old"))
    complete = [(0, True), (1, True)]
    assert shown == {("shelf", DEFAULT): complete, ("knife", DEFAULT): complete}
    # What is there is not made again.
    calls.clear()
    assert cli.main(["report", *make, "report.seeds=[0,1]", "out=again"]) == 0
    assert calls == []
    assert PAPER not in {preset for _, preset in shown}


def test_without_runs_the_error_says_what_makes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    console.err.cache_clear()
    assert cli.main(["report"]) == 2
    message = capsys.readouterr().err
    assert "must hold finished training runs" in message
    assert "koopdqn report --make" in message
    assert cli.main(["report", "report.runs=[nowhere]"]) == 2
    assert "report.runs: must name folders that exist, found 'nowhere'" in capsys.readouterr().err


def test_only_the_report_takes_make(capsys: pytest.CaptureFixture[str]) -> None:
    console.err.cache_clear()
    assert cli.main(["report", "--make", "--cfg", "job", "-p", "report"]) == 0
    assert "make: true" in capsys.readouterr().out
    assert cli.main(["train", "--make"]) == 2
    assert "unknown option --make of koopdqn train" in capsys.readouterr().err


def test_a_run_of_another_release_leaves_its_figures_out(tmp_path: Path, groups: "Groups") -> None:
    [(place, group)] = groups.items()
    old = replace(group.first, about={**group.first.about, "intent": {"target": "koopdqn.nowhere.Intent"}})
    with pytest.raises(BadInputError, match=r"run .* must have an intent of this release, found: intent\.target"):
        gather({place[1]: replace(group, runs=(old,))}, {}, tmp_path, lambda: None)
