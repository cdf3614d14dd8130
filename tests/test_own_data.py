"""A person's own files on the command line: import, export, and tasks made from them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_shown import arc, recorded

from koopdqn import load_config
from koopdqn.app import cli
from koopdqn.demonstrations.cleaning import without_outliers
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.recording import NOTHING

LITTLE = (
    "intent.count=40",
    "intent.copies=2",
    "agent.network.hidden=[32]",
    "agent.network.fourier_features=32",
    "agent.warm_up=500",
    "train.check_every=20",
    "train.max_steps=700",
)
"""A training of which nothing is asked but that it ends."""


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with three logs of one motion."""
    monkeypatch.chdir(tmp_path)
    for index in range(3):
        write_csv(tmp_path / f"log_{index}.csv", [recorded(arc(0.01 * index), idle=20)])
    return tmp_path


Printed = Callable[..., dict[str, object]]


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str]) -> Printed:
    def run(*arguments: str) -> dict[str, object]:
        capsys.readouterr()  # what was printed before
        assert cli.main([*arguments, "--json"]) == 0, capsys.readouterr().err
        found = json.loads(capsys.readouterr().out)
        assert isinstance(found, dict)
        return found

    return run


def test_import_keeps_every_sample_and_export_gives_it_back(logs: Path, printed: Printed) -> None:
    result = printed("import", "demos=log_*.csv", "out=mine")
    assert result["demonstrations"] == 3
    assert result["reachable"] == [True, True, True]
    assert np.all(np.array(result["idle_before_seconds"]) >= 0.39)
    kept = read_hdf5(logs / "mine" / "demos.hdf5")
    assert kept.task == "demonstrated"
    printed("export", "demos=mine/demos.hdf5", "out=back", "export.rotation=quaternion")
    for index, item in enumerate(load(logs / "back" / "demos.csv", NOTHING, None).items):
        np.testing.assert_array_equal(item.poses, load(logs / f"log_{index}.csv", NOTHING, None).items[0].poses)


def test_several_files_may_be_named_in_brackets(logs: Path, printed: Printed) -> None:
    assert printed("import", "demos=[log_2.csv,log_0.csv]", "out=two")["demonstrations"] == 2
    assert printed("import", "demos=[log_1.csv]", "out=one")["demonstrations"] == 1


@pytest.mark.parametrize("command", ["fit", "train", "import", "export"])
def test_without_files_there_is_nothing_to_do(logs: Path, command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "task=demonstrated"]) == 2
    error = capsys.readouterr().err
    assert "demos: must name the files" in error
    assert "found none" in error
    assert error.count("\n") == 1


def test_such_a_task_cannot_be_demonstrated_by_script(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demo", "task=demonstrated"]) == 2
    assert "valid: both_sides, knife, shelf" in capsys.readouterr().err


def test_fit_says_what_it_found_and_holds_the_last_out(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    short = ("intent.count=40", "intent.copies=2")
    assert cli.main(["fit", "task=demonstrated", "demos=log_*.csv", "out=fitted", *short]) == 0
    found = capsys.readouterr()
    for word in ("made from 2 demonstrations, 1 kept for evaluation", "start: around", "goal:", "step: 2.1 mm", "held"):
        assert word in found.err
    assert "kept for evaluation, rolled out" in found.out
    assert read_hdf5(logs / "fitted" / "demos.hdf5").held_out == 1
    assert json.loads((logs / "fitted" / "fit.json").read_text())["demonstrations"] == 2
    # The folder stands alone: the same is fitted to what it keeps.
    assert cli.main(["fit", "task=demonstrated", "demos=fitted/demos.hdf5", "out=again", *short]) == 0
    assert (logs / "again" / "intent.npz").read_bytes() == (logs / "fitted" / "intent.npz").read_bytes()


def test_that_the_arm_cannot_follow_what_is_held_out_is_told(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = arc(0.02)
    out[:, 0] += np.linspace(1.5, 0.0, len(out))
    write_csv(logs / "log_2.csv", [recorded(out)])
    assert cli.main(["fit", "task=demonstrated", "demos=log_*.csv", "intent.count=40", "intent.copies=2"]) == 0
    said = "the arm cannot follow demonstration 2, kept for evaluation, in the posture in which it follows those"
    assert said in capsys.readouterr().err


def test_training_and_evaluation_from_a_single_set_of_files(logs: Path, printed: Printed) -> None:
    assert cli.main(["train", "task=demonstrated", "demos=log_*.csv", "out=run", *LITTLE]) in (0, 1)
    report = printed("eval", "run=run", "out=measured", "eval.episodes=2", "eval.dynamics=false")
    assert report["path_deviation_mm"] == dict.fromkeys(("mean", "max", "p95_of_max", "frechet"))
    holdout = report["holdout"]
    assert isinstance(holdout, dict)
    assert holdout["demonstrations"] == len(holdout["outcomes"]) == len(holdout["hausdorff_mm"]["policy"]) == 1
    assert holdout["hausdorff_mm"]["straight_line"][0] > holdout["hausdorff_mm"]["nearest_demonstration"][0]


def test_what_was_declared_of_files_is_not_said_of_the_runs_own_copy(logs: Path, printed: Printed) -> None:
    item = recorded(arc(), idle=20)
    table = np.column_stack([item.times, item.poses])
    table[:, 1:4] *= 1e3
    np.savetxt(logs / "mm.csv", table, delimiter=",", header="t,x,y,z,qw,qx,qy,qz", comments="")
    declared = ("import.units=mm", "demos=mm.csv")
    assert cli.main(["train", "task=demonstrated", *declared, "out=run", *LITTLE]) in (0, 1)
    assert printed("eval", "run=run", "out=measured", "eval.episodes=2", "eval.dynamics=false")["episodes"] == 2
    assert cli.main(["train", "run=run", "train.max_steps=800"]) in (0, 1)


@pytest.mark.parametrize("spike", [[0.2, 0.0, 0.0], [-0.45, 0.1, -0.5]])
def test_a_bad_sample_bends_nothing_and_is_told(
    logs: Path, spike: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    clean = recorded(arc())
    poses = clean.poses.copy()
    poses[60, :3] += spike
    write_csv(logs / "plain.csv", [clean])
    write_csv(logs / "spiked.csv", [replace(clean, poses=poses)])
    plain, spiked = (
        load_config("task=demonstrated", f"demos={logs}/{name}.csv").derived for name in ("plain", "spiked")
    )
    assert plain is not None
    assert spiked is not None
    assert capsys.readouterr().err.count("far off their neighbours left out: 1, in demonstrations 0") == 1
    apart = spiked.training.items[0].poses[:, None, :3] - plain.training.items[0].poses[None, :, :3]
    assert np.linalg.norm(apart, axis=2).min(axis=1).max() < 0.0005
    noisy = recorded(arc(), idle=20, noise=0.0005)
    assert without_outliers(noisy).poses.tobytes() == noisy.poses.tobytes()


def test_a_run_keeps_the_samples_that_it_was_made_from(
    logs: Path, printed: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert cli.main(["train", "task=demonstrated", "demos=log_*.csv", "out=run", *LITTLE]) in (0, 1)
    fewer = "koopdqn.app.commands.demonstrated.without_outliers"
    monkeypatch.setattr(fewer, lambda item: replace(item, times=item.times[:-9], poses=item.poses[:-9]))
    assert printed("eval", "run=run", "out=measured", "eval.episodes=2", "eval.dynamics=false")["episodes"] == 2


def test_a_run_whose_task_is_made_otherwise_today_is_evaluated_with_its_own(
    logs: Path, printed: Printed, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("task=demonstrated", "demos=log_*.csv", "out=run", "task.step_m=0.0025", *LITTLE)
    assert cli.main(["train", *given]) in (0, 1)
    record = logs / "run" / ".hydra" / "overrides.yaml"
    record.write_text("".join(line for line in record.read_text().splitlines(keepends=True) if "step_m" not in line))
    assert "made from 2 demonstrations" in capsys.readouterr().err
    assert cli.main(["eval", "run=run", "out=measured", "eval.episodes=2", "eval.dynamics=false"]) == 0
    told = capsys.readouterr().err
    assert "task: as in the run, from which today's defaults differ" in told
    assert "made from" not in told, "what was told in training is not told again"
    holdout = json.loads((logs / "measured" / "eval.json").read_text())["holdout"]
    assert holdout["baselines"]["floor"]["success_rate"] == 1.0
    assert not (logs / "runs").exists()
