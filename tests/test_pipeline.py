"""What commands share: a run is evaluated as it was trained, whatever the defaults are by now."""

import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
from parts import load_parts
from small_run import SMALL, SOON

from koopdqn.app import cli
from koopdqn.app.hydra.compose import composed
from koopdqn.artifact import described, read_artifact, write_artifact
from koopdqn.files import read_json
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.rl.algorithm1 import Trainer

RECORD = Path(".hydra") / "overrides.yaml"
EVALUATING = ("eval.episodes=3", "eval.dynamics=false", "eval.baselines=false")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose record no longer says what today's defaults say otherwise, as after a change of the defaults."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    given = ["task=shelf", *SOON, "task.lip_m=0.012", "robot.step_seconds=0.3", "reward.goal=2.0"]
    assert cli.main(["train", *given, f"out={folder}"]) in (0, 1)
    record = (folder / RECORD).read_text(encoding="utf-8").splitlines(keepends=True)
    left = [line for line in record if not any(key in line for key in ("lip_m", "step_seconds", "reward.goal"))]
    assert len(left) == len(record) - 3
    (folder / RECORD).write_text("".join(left), encoding="utf-8")
    return folder


def test_a_run_is_evaluated_with_its_own_task_arm_and_reward(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval", f"run={run}", *EVALUATING, f"out={tmp_path / 'eval'}"]) == 0
    told = capsys.readouterr().err
    for name in ("task", "robot", "reward"):
        assert f"{name}: as in the run, from which today's defaults differ" in told
    assert read_json(tmp_path / "eval" / "eval.json", "the evaluation")["episodes"] == 3


def test_an_evaluation_tells_of_obstacles_that_the_policy_was_trained_without(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.yaml").write_text("- {name: ball, shape: sphere, center_m: [-0.5, 0.5, 0.2], radius_m: 0.05}")
    for name, given in {"plain": [], "among": [f"obstacles={tmp_path / 'scene.yaml'}"]}.items():
        assert cli.main(["eval", f"run={run}", *given, *EVALUATING, f"out={tmp_path / name}"]) == 0
        assert ("obstacles that the policy never saw" in capsys.readouterr().out) == (name == "among")
        assert read_json(tmp_path / name / "eval.json", "the evaluation")["as_trained"] == (name == "plain")
        assert cli.main(["view", f"run={run}", *given, "view.starts=1", f"out={tmp_path / name}-view"]) == 0
        page = (tmp_path / f"{name}-view" / "view.html").read_text(encoding="utf-8")
        assert ("obstacles that the policy never saw" in page) == (name == "among")


@pytest.mark.parametrize("given", ["eval.start_scale=2", "robot=ur5e"])
def test_an_evaluation_from_farther_out_or_of_another_arm_is_not_the_runs_own(
    run: Path, tmp_path: Path, given: str
) -> None:
    assert cli.main(["eval", f"run={run}", given, *EVALUATING, f"out={tmp_path / 'eval'}"]) == 0
    assert read_json(tmp_path / "eval" / "eval.json", "the evaluation")["as_trained"] is False


def test_a_run_trained_among_obstacles_takes_no_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shape = "shape: sphere, radius_m: 0.03}]"
    (tmp_path / "own.yaml").write_text(f"[{{name: lamp, center_m: [0.8, 0.6, 1.0], {shape}")
    (tmp_path / "other.yaml").write_text(f"[{{name: post, center_m: [-0.5, 0.5, 0.2], {shape}")
    trained = ["train", *SMALL, "train.max_steps=1500", f"obstacles={tmp_path}/own.yaml", f"out={tmp_path}/run"]
    assert cli.main(trained) in (0, 1)
    for obstacles, status in (("own", 0), ("other", 2)):
        given = [f"obstacles={tmp_path}/{obstacles}.yaml", f"out={tmp_path}/{obstacles}"]
        assert cli.main(["eval", f"run={tmp_path}/run", *EVALUATING, *given]) == status
    assert "obstacles" in capsys.readouterr().err


def test_a_run_is_corrected_with_its_own_arm(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["correct", f"run={run}", "robot=ur10", "waypoints=[[0.4,-0.15,0.46]]"]) == 2
    assert "robot: must be the arm that the run was trained with, found UR10" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["export", "view", "stream", "explain", "correct", "train"])
def test_a_goal_is_given_to_eval_alone(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "goal=[0.6,0.1,0.5]"]) == 2
    assert f"goal: koopdqn {command} goes to the goal that was demonstrated" in capsys.readouterr().err


def test_a_run_is_shown_with_its_own_task(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", f"run={run}", "view.starts=1", f"out={tmp_path / 'view'}"]) == 0
    assert "task: as in the run" in capsys.readouterr().err


def test_what_the_command_line_changes_stays_changed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval", f"run={run}", "task.lip_m=0.005", f"out={tmp_path / 'eval'}"]) == 2
    assert "(differing: lip_m, 0.012 there and 0.005 here)" in capsys.readouterr().err


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run as it was begun, with a checkpoint."""
    folder = tmp_path_factory.mktemp("begun") / "run"
    assert cli.main(["train", *SOON, f"out={folder}"]) in (0, 1)
    return folder


def test_what_a_run_goes_on_with_is_recorded_and_what_it_refuses_is_not(begun: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder)
    assert cli.main(["train", f"run={folder}", "train.max_steps=7777"]) in (0, 1)
    record = (folder / ".hydra" / "overrides.yaml").read_text(encoding="utf-8")
    assert "train.max_steps=7777" in record
    assert "max_steps: 7777" in (folder / ".hydra" / "config.yaml").read_text(encoding="utf-8")
    assert cli.main(["train", f"run={folder}", "agent.gamma=0.123"]) == 2
    assert (folder / ".hydra" / "overrides.yaml").read_text(encoding="utf-8") == record


@pytest.mark.parametrize("given", ["train.max_steps=7778", "seed=5"])
def test_what_a_run_goes_on_with_is_recorded_once_its_answers_fit(begun: Path, tmp_path: Path, given: str) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder, ignore=shutil.ignore_patterns("checkpoints"))
    before = (folder / RECORD).read_text(encoding="utf-8")
    fits = given != "seed=5"
    assert cli.main(["train", f"run={folder}", given, "hydra.verbose=false"]) in ((0, 1) if fits else (2,))
    assert (folder / RECORD).read_text(encoding="utf-8") == before + (f"- {given}\n" if fits else "")


@pytest.mark.parametrize("stopped", [False, True])
def test_before_all_answers_came_again_a_run_is_recorded_if_it_ends(
    begun: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder, ignore=shutil.ignore_patterns("checkpoints"))
    monkeypatch.setattr(JournalledOracle, "caught_up", False)
    if stopped:
        monkeypatch.setattr(Trainer, "run", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    assert cli.main(["train", f"run={folder}", "train.max_steps=20"]) == (130 if stopped else 1)
    assert ("train.max_steps=20" in (folder / RECORD).read_text(encoding="utf-8")) != stopped


def test_a_pause_before_the_first_check_is_gone_on_from_with_the_same_oracle(begun: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(begun, folder, ignore=shutil.ignore_patterns("checkpoints", "feedback.jsonl"))
    questions, answers = tmp_path / "questions", tmp_path / "answers"
    questions.touch()
    answers.write_text('{"number": 0, "pause": true}\n', encoding="utf-8")
    given = ["oracle=file", f"oracle.questions={questions}", f"oracle.answers={answers}"]
    assert cli.main(["train", f"run={folder}", *given]) == 130
    record = (folder / RECORD).read_text(encoding="utf-8").splitlines()
    assert record[-3:] == [f"- {each}" for each in given]


def test_a_run_goes_on_with_no_other_intent_than_its_own(begun: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (begun / RECORD).read_bytes()
    assert cli.main(["train", f"run={begun}", "trust=box"]) == 2
    assert "trust: must be as the intent was fitted that the run holds already" in capsys.readouterr().err
    assert (begun / RECORD).read_bytes() == before


@pytest.mark.parametrize("named", ["--config-dir={}/my conf", "hydra.searchpath=[file://{}/my_conf]"])
def test_the_command_that_goes_on_names_the_config_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    text = "defaults: [shelf, _self_]\nname: mine\n"
    for folder in ("my conf", "my_conf"):
        (tmp_path / folder / "task").mkdir(parents=True)
        (tmp_path / folder / "task" / "mine.yaml").write_text(text, encoding="utf-8")
    monkeypatch.setattr(Trainer, "run", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    own = [named.format(tmp_path), "task=mine"]
    assert cli.main(["train", *SMALL, *own, f"out={tmp_path}/run"]) == 130
    told = capsys.readouterr().err.split("; koopdqn ")[1].partition(" goes on")[0]
    assert shlex.split(told)[:2] == ["train", own[0]]
    assert cli.main([*shlex.split(told), "train.max_steps=7779"]) == 130
    assert "train.max_steps=7779" in (tmp_path / "run" / RECORD).read_text(encoding="utf-8")


def test_a_policy_holds_the_settings_that_its_intent_was_fitted_with(
    begun: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [f"demos={begun}/demos.hdf5", f"intent={begun}/intent.npz", "trust=box"]
    given += ["train.max_steps=1500", "train.check_every=2"]
    assert cli.main(["train", *SMALL, *given, f"out={tmp_path / 'run'}"]) in (0, 1)
    assert "trust: as the intent was fitted, from which the config differs" in capsys.readouterr().err
    about = [read_artifact(folder / "policy.safetensors", "policy").about for folder in (begun, tmp_path / "run")]
    assert about[0]["trust"] == about[1]["trust"]
    record = (tmp_path / "run" / RECORD).read_text(encoding="utf-8")
    # An unfinished run of an earlier version holds the config's trust.
    path = tmp_path / "run" / "checkpoints" / "latest.safetensors"
    held = read_artifact(path, "checkpoint")
    other = described(load_parts("trust=box", *SMALL).trust)
    assert held.about["shaped_by"]["trust"] != other
    held.about["shaped_by"]["trust"] = other
    write_artifact(path, held)
    assert cli.main(["train", f"run={tmp_path / 'run'}", "train.max_steps=1600"]) in (0, 1)
    after = (tmp_path / "run" / RECORD).read_text(encoding="utf-8")
    assert after.splitlines() == [
        *(line for line in record.splitlines() if "max_steps" not in line),
        "- train.max_steps=1600",
    ]
    held_now = (tmp_path / "run" / RECORD.with_name("config.yaml")).read_text(encoding="utf-8")
    assert f"intent_file: {begun}/intent.npz" in held_now
    assert "max_steps: 1600" in held_now


def test_the_command_that_goes_on_names_the_config_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cn").mkdir()
    mine = "defaults: [config, _self_]\ntrain: {max_steps: 12345}\n"
    (tmp_path / "cn" / "mine.yaml").write_text(mine, encoding="utf-8")
    own = [f"--config-dir={tmp_path}/cn", "--config-name=mine"]
    composed_anew: list[Any] = []

    def interrupted(*_: object) -> None:
        composed_anew.append(composed([]))
        raise KeyboardInterrupt

    monkeypatch.setattr(Trainer, "run", interrupted)
    assert cli.main(["train", *own, *SMALL, f"out={tmp_path}/run"]) == 130
    # What a command composes once more is its own config, too.
    assert composed_anew[0].train.max_steps == 12345
    told = capsys.readouterr().err.split("; koopdqn ")[1].partition(" goes on")[0]
    assert shlex.split(told)[1:3] == own
    assert cli.main(shlex.split(told)) == 130


def test_a_run_made_with_a_search_path_is_read_and_compared_with_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "mine" / "task").mkdir(parents=True)
    text = "defaults: [shelf, _self_]\nname: mine\n"
    (tmp_path / "mine" / "task" / "mine.yaml").write_text(text, encoding="utf-8")
    run, path = f"run={tmp_path}/run", f"hydra.searchpath=[file://{tmp_path}/mine]"
    few = ("eval.episodes=2", "eval.dynamics=false", "eval.baselines=false")
    assert cli.main(["train", path, "task=mine", *SMALL, "train.max_steps=1500", f"out={tmp_path}/run"]) == 1
    assert cli.main(["eval", path, run, "reward.size=2", *few, f"out={tmp_path}/eval"]) == 0
    assert cli.main(["compare", path, run, run, "view.starts=1", "eval.episodes=2", f"out={tmp_path}/both"]) == 0
