import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from report_runs import first, write_evaluation, write_run

from koopdqn.app.commands.report import all_presets
from koopdqn.errors import BadInputError
from koopdqn.files import write_json
from koopdqn.report import tables
from koopdqn.report.runs import find_runs, group_runs
from koopdqn.report.schema import MissingPart
from koopdqn.report.tables import Table, spread

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.report.runs import Groups, Presets, Run

ABLATION = {"learned": True, "episodes": 10, "oracle_queries": 3, "success_rate": 0.5, "deviation_mm": None}


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
    given: dict[str, dict[str, str]] = {"default": {}, "line": {"intent": "line"}}
    rows = [
        {"case": "shelf", "variant": name, "seed": seed, "settings": {"train": {"task": "shelf", **more}}, **ABLATION}
        for name, more in given.items()
        for seed in range(2)
    ]
    write_json(root / "ablations" / "ablations.json", rows)
    return root


@pytest.fixture(scope="module")
def groups(folder: Path, presets: "Presets") -> "Groups":
    return group_runs(find_runs([folder])[0], presets)[0]


def numbers_of(table: Table | MissingPart, ours: slice) -> list[Any]:
    assert isinstance(table, Table)
    return [cell for row in table.rows for cell in row[ours] if re.search(r"\d", cell.text)]


def test_every_number_of_ours_has_a_source_that_exists(groups: "Groups", presets: "Presets", folder: Path) -> None:
    found = (
        (tables.comparison(groups, {}), slice(2, None)),
        (tables.hyperparameters(presets), slice(3, None)),
        (tables.training(groups), slice(1, None)),
        (tables.evaluation(groups), slice(1, None)),
        (tables.ablations(folder / "ablations" / "ablations.json"), slice(2, None)),
    )
    for table, ours in found:
        cells = numbers_of(table, ours)
        assert cells
        assert all(cell.sources and all(source.exists() for source in cell.sources) for cell in cells)


def test_means_and_ranges_are_over_all_seeds_and_what_failed_counts(groups: "Groups") -> None:
    table = tables.training(groups)
    row = {name: cell.text for name, cell in zip(table.header, table.rows[0], strict=True)}
    assert row["learned"] == "1 of 2"
    assert row["questions"] == "12 (12–13)"
    assert row["time [s]"] == "10 (10–11)"
    assert len(tables.shown_runs(groups).rows) == 2


def test_what_it_took_to_learn_ends_there_and_leaves_out_what_never_learned(groups: "Groups") -> None:
    (place, runs), *_ = groups.items()
    learned, never = sorted(runs, key=lambda run: not run.train["learned"])
    further = replace(learned, train={**learned.train, "env_steps": 81000, "episodes": 180, "seconds": 30.0})

    def shown(*found: "Run") -> list[str]:
        rows = {row[0].text: row[2].text for row in tables.comparison({place: found}, {}).rows}
        return [rows["shelf: episodes to learn"], rows["shelf: minutes to learn"]]

    assert shown(learned, never) == ["60", "0.17"]
    assert shown(learned, further) == ["60", "0.17"]
    assert shown(never) == ["–", "–"]


def test_the_papers_numbers_stand_as_it_gives_them(groups: "Groups", presets: "Presets") -> None:
    said = {row[0].text: row[1].text for row in tables.comparison(groups, {}).rows}
    assert said["shelf: minutes to learn"] == "about 135 (§5.1)"
    assert said["knife: minutes to learn"] == "about 210 (§5.2)"
    assert said["shelf: episodes to learn"] == "1,200 (§5.1)"
    assert said["knife: questions asked"] == "not given"
    # Each number of the paper's text stands in a row.
    assert set(tables._REPORTED) <= set(said)
    rows = {row[0].text: [cell.text for cell in row[1:]] for row in tables.hyperparameters(presets).rows}
    # Where the paper gives a number its preset has the same one.
    for name in ("max. number of episodes", "size of the replay buffer", "batch size", "inputs of the network"):
        assert rows[name][:2] == rows[name][2:4]
    assert [float(text) for text in rows["learning rate"][:4]] == [1e-5, 1e-4, 1e-5, 1e-4]
    assert len(tables.actions().rows) == 10


def test_what_was_not_measured_is_said(groups: "Groups", tmp_path: Path) -> None:
    bare = {
        place: [replace(run, evaluation=None, evaluation_file=None) for run in runs] for place, runs in groups.items()
    }
    assert isinstance(tables.evaluation(bare), MissingPart)
    missing = tables.ablations(tmp_path / "ablations.json")
    assert isinstance(missing, MissingPart)
    assert missing.command == "make ablations"
    assert isinstance(tables.intents({}), MissingPart)


def test_an_ablation_is_told_by_what_it_changes(folder: Path) -> None:
    for file in (folder / "ablations" / "ablations.json", Path(__file__).parents[1] / "docs" / "ablations.json"):
        table = tables.ablations(file)
        assert isinstance(table, Table)
        changed = {row[0].text: row[1].text for row in table.rows}
        assert changed["shelf, default"] == "nothing"
        others = [text for name, text in changed.items() if not name.endswith(", default")]
        assert others
        assert all("=" in text and "task=" not in text for text in others)


def test_damaged_ablations_are_bad_input(tmp_path: Path) -> None:
    write_json(tmp_path / "ablations.json", [{"case": "shelf"}])
    with pytest.raises(BadInputError, match="must hold one row a run"):
        tables.ablations(tmp_path / "ablations.json")


def test_spread_is_mean_and_range() -> None:
    assert spread([1.0, None, 3.0], ".1f", unit="mm") == "2.0 (1.0–3.0) mm"
    assert spread([0.5, 0.5], ".0f", 100.0, "%") == "50 %"
    assert spread([0.991, 0.992], ".0f", 100.0) == "99"
    assert spread([None], ".1f", unit="mm") == "–"
