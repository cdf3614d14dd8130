"""What commands share: a run is evaluated as it was trained, whatever the defaults are by now."""

from pathlib import Path

import pytest
from small_run import SMALL

from koopdqn.app import cli
from koopdqn.files import read_json

RECORD = Path(".hydra") / "overrides.yaml"
EVALUATING = ("eval.episodes=3", "eval.dynamics=false", "eval.baselines=false")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose record no longer says what today's defaults say otherwise, as after a change of the defaults."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    given = ["task=shelf", *SMALL, "task.lip_m=0.012", "robot.step_seconds=0.3", "reward.goal=2.0"]
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


def test_an_evaluation_tells_of_obstacles_that_the_policy_was_trained_without(run: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("- {name: ball, shape: sphere, center_m: [-0.5, 0.5, 0.2], radius_m: 0.05}")
    for name, given in {"plain": [], "among": [f"obstacles={tmp_path / 'scene.yaml'}"]}.items():
        assert cli.main(["eval", f"run={run}", *given, *EVALUATING, f"out={tmp_path / name}"]) == 0
        assert read_json(tmp_path / name / "eval.json", "the evaluation")["as_trained"] == (name == "plain")


def test_a_run_is_shown_with_its_own_task(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["view", f"run={run}", "view.starts=1", f"out={tmp_path / 'view'}"]) == 0
    assert "task: as in the run" in capsys.readouterr().err


def test_what_the_command_line_changes_stays_changed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval", f"run={run}", "task.lip_m=0.005", f"out={tmp_path / 'eval'}"]) == 2
    assert "differing: lip_m" in capsys.readouterr().err
