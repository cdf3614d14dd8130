"""The examples run, and are as short as they promise."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SMALL = ["demo.count=3", "intent.count=60"]
SHORT = [*SMALL, "train.max_steps=4000", "eval.episodes=3", "eval.dynamics=false", "eval.baselines=false"]
CASES = [
    ("own_task.py", SHORT, "of 3 starts"),
    ("pouring.py", SHORT, "questions asked"),
    ("own_oracle.py", SHORT, "questions answered"),
    ("own_observables.py", ["demo.count=3"], "the default"),
    ("own_environment.py", ["600", *SMALL], "success_rate"),
    ("reward_in_another_loop.py", ["10", *SMALL], "actions right"),
    ("stable_baselines.py", ["DQN", "2000", "0", *SMALL], "DQN after 2048 steps"),
    ("stable_baselines.py", ["PPO", "4000", "0", *SMALL], "PPO after 4096 steps"),
    ("stable_baselines.py", ["SAC", "2000", "0", *SMALL], "SAC after 2048 steps"),
    ("skrl_double_dqn.py", ["2000", "0", *SMALL], "double DQN after 1984 steps"),
    ("sweep.py", ["SWEEP", "seed=0", "agent.gamma=0", *SHORT], "0: seed 0, learned"),
]


def test_every_example_is_run_and_under_sixty_lines() -> None:
    found = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in EXAMPLES.glob("*.py")}
    assert found.keys() == {name for name, _, _ in CASES}
    assert max(found.values()) < 60, found


@pytest.mark.parametrize(("name", "arguments", "words"), CASES)
def test_an_example_runs(
    name: str,
    arguments: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = [str(tmp_path / "sweep") if argument == "SWEEP" else argument for argument in arguments]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *given])
    # As a script finds what lies beside it.
    monkeypatch.syspath_prepend(EXAMPLES)
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")
    assert words in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("learner", "steps"), [("DQN", 32768), ("PPO", 49152), ("SAC", 20000)])
def test_stable_baselines_learns_the_shelf(learner: str, steps: int, tmp_path: Path) -> None:
    told = printed("stable_baselines.py", [learner, str(steps), "2"], tmp_path)
    share = re.search(r"(\d+)% of 100 starts", told)
    assert share is not None, told
    assert int(share[1]) >= 95


@pytest.mark.slow
def test_skrls_double_dqn_learns_the_shelf(tmp_path: Path) -> None:
    share = re.search(r"(\d+)% of 100 starts", printed("skrl_double_dqn.py", ["60000", "2"], tmp_path))
    assert share is not None
    assert int(share[1]) >= 95


def printed(name: str, arguments: list[str], folder: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout
