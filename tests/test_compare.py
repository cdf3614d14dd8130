"""`koopdqn compare`: runs of a task in one table and on one page."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_run import SMALL

from koopdqn import console
from koopdqn.app import cli
from koopdqn.app.commands import compare
from koopdqn.app.hydra.overrides import prepare
from koopdqn.artifact import read_artifact, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.intent.bend import Bend
from koopdqn.plots import style
from koopdqn.rl.policy import write_corrected
from koopdqn.view.schema import CompareFile, Difference

STOPPED = "train.max_steps=1500"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two runs that learned from the same demonstrations; the second is evaluated, and its name is odd."""
    folder = tmp_path_factory.mktemp("runs")
    one, other, odd = folder / "one", folder / "other", folder / "<i>[red] & $two"
    assert cli.main(["train", *SMALL, STOPPED, f"out={one}"]) == 1
    # The trust is the file's, whatever is given.
    given = [f"demos={one}/demos.hdf5", f"intent={one}/intent.npz", "trust=box", "seed=7", "agent.gamma=0.4"]
    assert cli.main(["train", *SMALL, STOPPED, *given, f"out={other}"]) == 1
    shutil.copytree(other, odd)
    few = ("eval.episodes=2", "eval.dynamics=false", "eval.baselines=false")
    assert cli.main(["eval", f"run={odd}", *few, f"out={folder}/eval"]) == 0
    return one, odd


def compared(runs: tuple[Path, ...], out: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    capsys.readouterr()
    named = [f"run={run}" for run in runs]
    assert cli.main(["compare", *named, "view.starts=2", "eval.episodes=2", f"out={out}", "--json"]) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert CompareFile.model_validate(content).model_dump(mode="json") == content
    assert json.loads((out / "compare.json").read_text(encoding="utf-8")) == content
    return content


def test_runs_stand_in_one_table_and_their_paths_on_one_page(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = compared(runs, tmp_path / "out", capsys)
    assert [(each["label"], each["folder"]) for each in content["runs"]] == [("A", str(runs[0])), ("B", str(runs[1]))]
    assert [each["evaluation"] is None for each in content["runs"]] == [True, False]
    assert content["runs"][1]["success_rate"] is not None
    assert [each["episodes"] for each in content["runs"]] == [None, 2]
    # The inputs are the same, so that what was given by hand differs and nothing else.
    keys = {each["key"]: each["values"] for each in content["differences"]}
    assert keys == {"seed": ["0", "7"], "agent.gamma": ["0.5", "0.4"]}
    page = (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    baked = json.loads(re.findall(r'id="baked">(.*?)</script>', page, re.DOTALL)[0])
    learned = [motion for motion in baked["motions"] if motion["kind"] == "learned"]
    assert [(motion["start"], motion["run"][0]) for motion in learned] == [(0, "A"), (0, "B"), (1, "A"), (1, "B")]
    assert {motion["run"][0]: motion["colour"] for motion in learned} == {"A": style.BLUE, "B": style.GREEN}
    assert len(baked["tracks"]) == 3


def test_what_a_policy_was_trained_with_is_compared_whatever_is_the_default_now(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    older = tmp_path / "older"
    shutil.copytree(runs[0], older)
    held = read_artifact(older / "policy.safetensors", "policy")
    about = dict(held.about)
    for part, setting, value in (("agent", "gamma", 0.9), ("train", "check_every", 7), ("feedback", "reach_m", 0.01)):
        about[part] = {**about[part], setting: value}
    write_artifact(older / "policy.safetensors", replace(held, about=about))
    keys = {row["key"] for row in compared((runs[0], older), tmp_path / "out", capsys)["differences"]}
    assert keys == {"agent.gamma", "train.check_every", "feedback.reach_m"}


def test_who_answered_is_a_difference(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    inputs = [f"demos={runs[0]}/demos.hdf5", f"intent={runs[0]}/intent.npz"]
    other = [*SMALL, STOPPED, *inputs, "oracle=noisy", "oracle.wrong=0.2", f"out={tmp_path}/noisy"]
    assert cli.main(["train", *other]) == 1
    content = compared((runs[0], tmp_path / "noisy"), tmp_path / "out", capsys)
    assert {each["key"]: each["values"] for each in content["differences"]} == {
        "oracle": ["scripted", "noisy"],
        "oracle.wrong": ["", "0.2"],
    }


def test_a_corrected_run_differs_in_that(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs[0], tmp_path / "run")
    line = np.linspace([0.45, -0.2, 0.45], [0.38, -0.12, 0.47], 30)
    write_corrected(tmp_path / "run" / "policy.safetensors", runs[0] / "policy.safetensors", Bend.none(line))
    content = compared((runs[0], tmp_path / "run"), tmp_path / "out", capsys)
    assert content["differences"] == [{"key": "corrected", "values": ["no", "yes"]}]


def test_a_folders_name_is_shown_and_not_obeyed(
    runs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    console.out.cache_clear()
    console.err.cache_clear()
    named = [f"run={run}" for run in runs]
    assert cli.main(["compare", *named, "view.starts=1", "eval.episodes=2", f"out={tmp_path}/out"]) == 0
    streams = capsys.readouterr()
    assert str(runs[1]) in streams.out
    assert f"not evaluated: A: koopdqn eval run={runs[0]}" in streams.out
    page = (tmp_path / "out" / "compare.html").read_text(encoding="utf-8")
    shown = page.partition('<script type="application/json"')[0].partition("<body>")[2]
    assert "&lt;i&gt;[red] &amp; $two" in shown
    assert "<i>" not in shown


def test_headings_are_whole_words_at_80_columns(
    runs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    console.out.cache_clear()
    named = [f"run={run}" for run in runs]
    assert cli.main(["compare", *named, "view.starts=1", "eval.episodes=2", f"out={tmp_path}/out"]) == 0
    told = capsys.readouterr().out
    assert "…" not in told
    assert re.search(r"\d% of 2 ", told)
    assert re.search(r"run +learned +time \[s\] +actions +questions +success +deviation +reached", told)
    assert [f"run {label}  {run}" for label, run in zip("AB", runs, strict=True)] == told.splitlines()[:2]


def test_a_run_beside_itself_differs_in_nothing_and_leaves_nothing_else(
    runs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    content = compared((runs[0], runs[0]), tmp_path / "out", capsys)
    assert content["differences"] == []
    one, other = content["runs"]
    assert {**one, "label": "B"} == other
    assert [each.name for each in tmp_path.iterdir()] == ["out"]


def test_long_values_that_differ_at_their_ends_are_a_difference() -> None:
    one, other = (compare._flat({"task": {"waypoints": [*range(100), end]}}) for end in (1, 2))
    assert one != other
    difference = Difference(key="task.waypoints", values=[*one.values(), *other.values()])
    (row,) = compare._config_listing([difference], []).rows
    assert max(map(len, row)) <= 60


def test_runs_are_named_as_often_as_there_are(runs: tuple[Path, Path]) -> None:
    prepared = prepare("compare", [f"run={runs[0]}", f"run={runs[1]}", "view.starts=1"]).overrides
    assert f"compare.runs=['{runs[0]}','{runs[1]}']" in prepared
    assert [each for each in prepared if each.startswith("run=")] == [f"run={runs[0]}"]
    for count in (0, 1, 7):
        with pytest.raises(BadInputError, match=f"run: koopdqn compare needs 2 to 6 runs .*, found {count}"):
            prepare("compare", [f"run={runs[0]}"] * count)


@pytest.mark.parametrize("given", ["task=knife", "agent.gamma=0.1", "robot=ur3", "view.video=a.mp4", "seed=3"])
def test_what_would_not_be_heeded_is_refused(runs: tuple[Path, Path], given: str) -> None:
    with pytest.raises(BadInputError, match=f"{given.partition('=')[0]}: koopdqn compare shows its runs as they were"):
        prepare("compare", [f"run={runs[0]}", f"run={runs[1]}", given])
    with pytest.raises(BadInputError, match=r"compare\.runs: is given as run=DIR run=DIR"):
        prepare("compare", [f"compare.runs=[{runs[0]},{runs[1]}]"])


def test_runs_of_two_tasks_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    names = iter(("shelf", "knife"))

    def read(*given: object) -> object:
        return SimpleNamespace(config=SimpleNamespace(task=SimpleNamespace(name=next(names))))

    monkeypatch.setattr(compare, "_read", read)
    config: Any = SimpleNamespace(compare=SimpleNamespace(runs=(Path("a"), Path("b"))))
    with pytest.raises(BadInputError, match="must be of one task, found shelf, knife"):
        compare.run(config, tmp_path)
