from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from report_runs import knife_parts, write_evaluation, write_run

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.api import load_config
from koopdqn.app.commands import report
from koopdqn.report.runs import DEFAULT, PAPER

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.report.runs import Groups


def test_make_trains_and_evaluates_what_is_missing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    parts: "Parts",
    demonstrations: "Demonstrations",
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

    shown: dict[tuple[str, str], Any] = {}

    def draw(groups: "Groups", *rest: object) -> dict[str, Any]:
        shown.update({place: [(r.seed, r.evaluation is not None) for r in runs] for place, runs in groups.items()})
        return {"figures": [], "tables": [], "runs": [], "missing": []}

    monkeypatch.setattr(report, "_koopdqn", launch)
    monkeypatch.setattr(report, "build", draw)
    assert cli.main(["report", "--make", "report.seeds=[0,1]", "out=made"]) == 0
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
    # A run of another configuration is none of the present one's.
    other = replace(parts, agent=parts.agent.model_copy(update={"gamma": 0.8}))
    write_run(tmp_path / "other" / "shelf", other, demonstrations, seed=0)
    write_run(tmp_path / "other" / "knife", replace(knife, agent=other.agent), demonstrations, seed=0)
    calls.clear()
    chosen = ["report.runs=[other]", "report.seeds=[0]", "out=beside"]
    assert cli.main(["report", "--make", *chosen]) == 0
    assert [call[:3] for call in calls] == [
        ("train", t, "0") if c == "train" else ("eval", "", "") for t in ("shelf", "knife") for c in ("train", "eval")
    ]
    # What is there is not made again.
    calls.clear()
    assert cli.main(["report", "--make", "report.seeds=[0,1]", "out=again"]) == 0
    assert calls == []
    assert PAPER not in {preset for _, preset in shown}


def test_what_is_made_is_made_from_the_commands_own_config(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    monkeypatch.setattr(report, "_koopdqn", lambda command, overrides, result: calls.append([command, *overrides]))
    own = ["--config-dir=/mine", "--config-name=mine"]
    made = report._make_missing([("shelf", 3, None)], own)
    assert [call[:3] for call in calls] == [["train", *own], ["eval", *own]]
    assert calls[1][3] == f"run={made[0]}"


def test_a_seed_named_twice_is_made_once() -> None:
    settings = load_config("report.seeds=[0,0]").report
    jobs = report._jobs(settings, {}, report.all_presets())
    assert [(task, seed) for task, seed, _ in jobs] == [("shelf", 0), ("knife", 0)]


def test_one_run_is_told_as_one(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    parts: "Parts",
    demonstrations: "Demonstrations",
) -> None:
    write_run(tmp_path / "run", parts, demonstrations)
    console.out.cache_clear()
    for runs, told in ((1, "2 figures and 1 table from 1 run\n"), (2, "2 figures and 1 table from 2 runs\n")):
        content = {"figures": [0, 0], "tables": [0], "runs": [0] * runs, "missing": []}
        monkeypatch.setattr(report, "build", lambda *given, made=content: made)
        assert cli.main(["report", f"report.runs=[{tmp_path}/run]", f"out={tmp_path}/made{runs}"]) == 0
        assert capsys.readouterr().out.startswith(told)


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
