import csv
import os
import re
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import pytest
from report_runs import train_report, write_evaluation, write_swept

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.commands import report
from koopdqn.errors import WorkFailedError
from koopdqn.evaluation.results import Variant
from koopdqn.files import read_json, write_json
from koopdqn.report import sweep
from koopdqn.report.schema import SweepFile

if TYPE_CHECKING:
    from parts import Parts


@pytest.fixture
def work(tmp_path: Path, parts: "Parts", monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a sweep of two intents and two seeds below ``swept``; the last run failed."""
    for job, (intent, seed) in enumerate([("pose", 0), ("pose", 1), ("paper", 0), ("paper", 1)]):
        write_swept(tmp_path / "swept" / str(job), parts, seed, f"intent={intent}", finished=job < 3)
    (tmp_path / "swept" / "multirun.yaml").touch()
    monkeypatch.chdir(tmp_path)
    for stream in (console.out, console.err):
        stream.cache_clear()
    return tmp_path


def test_a_sweep_becomes_a_page_a_table_and_a_plot(work: Path, parts: "Parts") -> None:
    write_evaluation(work / "runs" / "eval", parts, "swept/0")
    assert cli.main(["report", "sweep=swept", "out=made"]) == 0
    folder = work / "made" / "report"
    content = SweepFile.model_validate(read_json(folder / "sweep.json", "the sweep"))
    assert [run.state for run in content.runs] == ["finished"] * 3 + ["failed"]
    assert content.runs[0].success_rate == 0.9
    assert [variant.overrides for variant in content.variants] == [{"intent": "pose"}, {"intent": "paper"}]
    assert (folder / "sweep.png").read_bytes().startswith(b"\x89PNG")
    text = (folder / "report.html").read_text(encoding="utf-8")
    links = set(re.findall(r'href="([^"#][^"]*)"', text))
    assert len(links) == 4
    assert all((folder / unquote(link)).exists() for link in links)
    # A row a run, one a variant, and the failed run with its reason.
    assert len(re.findall(r"<tr[ >]", text)) == 1 + 4 + 2 + 1 + 1
    assert text.count('class="summary"') == 2
    assert "It holds neither train.json nor begun.json" in text


def test_what_is_no_plain_folder_is_a_failed_run_and_nothing_of_it_is_read(work: Path) -> None:
    secret = work / "secret.yaml"
    secret.write_text("- intent=hunter2\n")
    record = work / "swept" / "0" / ".hydra" / "overrides.yaml"
    record.unlink()
    record.symlink_to(secret)
    os.mkfifo(work / "swept" / "1" / "pipe")
    bomb = "- &a [x, x]\n" + "".join(
        f"- &{two} [*{one}, *{one}, *{one}]\n" for one, two in pairwise("abcdefghijklmnopqrst")
    )
    (work / "swept" / "2" / ".hydra" / "overrides.yaml").write_text(bomb + f"- seed={'9' * 5000}\n")
    assert cli.main(["report", "sweep=swept", "out=made"]) == 0
    folder = work / "made" / "report"
    content = SweepFile.model_validate(read_json(folder / "sweep.json", "the sweep"))
    assert [run.state for run in content.runs] == ["failed", "failed", "finished", "failed"]
    assert ["must hold files and folders only" in run.reason for run in content.runs] == [True, True, False, False]
    assert "hunter2" not in (folder / "report.html").read_text(encoding="utf-8")


def test_the_csv_has_a_row_a_run_and_one_a_variant(work: Path) -> None:
    assert cli.main(["report", "sweep=swept", "out=made"]) == 0
    with (work / "made" / "report" / "sweep.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["row"] for row in rows] == ["run", "run", "variant"] * 2
    assert [row["intent"] for row in rows] == ["pose"] * 3 + ["paper"] * 3
    first, second, whole = rows[:3]
    assert float(whole["seconds"]) == (float(first["seconds"]) + float(second["seconds"])) / 2
    assert float(whole["seconds_std"]) == pytest.approx(0.5**0.5)
    assert (whole["runs"], whole["learned"]) == ("2", "1")
    assert (rows[4]["state"], rows[4]["learned"], rows[4]["seconds"]) == ("failed", "", "")


def test_what_was_never_checked_is_not_measured(work: Path, parts: "Parts", capsys: pytest.CaptureFixture[str]) -> None:
    write_swept(work / "one" / "0", parts, 0)
    unchecked = {**train_report(parts, 0), "checks": [], "best_success_rate": 0.0, "best_update": 0}
    write_json(work / "one" / "0" / "train.json", unchecked)
    assert cli.main(["report", "sweep=one", "out=made"]) == 0
    folder = work / "made" / "report"
    assert capsys.readouterr().out.startswith("1 run of 1 variant\n")
    content = read_json(folder / "sweep.json", "the sweep")
    assert [each["check_success_rate"] for each in (*content["runs"], *content["variants"])] == [None, None]
    with (folder / "sweep.csv").open(newline="") as file:
        assert [row["check_success_rate"] for row in csv.DictReader(file)] == ["", ""]
    # Success, deviation and best check, of the run and of its variant.
    rows = re.findall(r"<tr[ >].*?</tr>", (folder / "report.html").read_text(encoding="utf-8"), re.DOTALL)
    assert [len(re.findall(r">–", row)) for row in rows[1:]] == [3, 3]


def test_make_evaluates_what_is_finished(work: Path, parts: "Parts", monkeypatch: pytest.MonkeyPatch) -> None:
    write_evaluation(work / "runs" / "eval", parts, "swept/0")
    calls: list[str] = []

    def launch(command: str, overrides: list[str], result: Path) -> None:
        given = dict(item.split("=", 1) for item in overrides)
        calls.append(f"{command} {given['run']}")
        write_evaluation(result.parent, parts, given["run"])

    monkeypatch.setattr(report, "_koopdqn", launch)
    assert cli.main(["report", "--make", "sweep=swept", "out=made"]) == 0
    assert calls == ["eval swept/1", "eval swept/2"]
    content = read_json(work / "made" / "report" / "sweep.json", "the sweep")
    assert [run["success_rate"] for run in content["runs"]] == [0.9, 0.9, 0.9, None]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["sweep=nowhere"], "report.sweep: must name a folder that exists, found 'nowhere'"),
        (["sweep=empty"], "report.sweep: must hold runs of koopdqn train"),
        (["sweep=swept", "report.runs=[swept]"], "report.runs: must be empty where sweep= names the folder to show"),
    ],
)
def test_what_is_no_sweep_is_bad_input(
    work: Path, capsys: pytest.CaptureFixture[str], overrides: list[str], message: str
) -> None:
    (work / "empty").mkdir()
    assert cli.main(["report", *overrides, "out=made"]) == 2
    assert message in capsys.readouterr().err


def test_an_evaluation_that_fails_leaves_the_others(
    work: Path, parts: "Parts", monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(report, "_new_folder", lambda *_: work / "runs" / f"eval-{len(made)}")
    made: list[str] = []

    def evaluated(command: str, overrides: list[str], result: Path) -> None:
        run = next(each for each in overrides if each.startswith("run="))
        made.append(run)
        if run.endswith("/0"):
            raise WorkFailedError(f"koopdqn eval {run} ended with exit status 2")
        write_evaluation(result.parent, parts, run.removeprefix("run="))

    monkeypatch.setattr(report, "_koopdqn", evaluated)
    assert cli.main(["report", "sweep=swept", "report.make=true", "out=made"]) == 1
    assert len(made) == 3
    assert "ended with exit status 2" in capsys.readouterr().err


def test_a_long_value_is_cut_in_the_plot_alone() -> None:
    given: dict[str, Any] = {"overrides": {"task.obstacles": "[" + 100 * "0," + "]"}, "runs": 2, "finished": 2}
    variant = Variant.model_construct(**given)
    assert len(sweep._label(variant)) == 40
