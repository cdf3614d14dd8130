"""Stopped in any way at any moment, a run goes on and ends with the bytes of one that was never stopped."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from small_run import SOON

from koopdqn import console
from koopdqn.app import cli
from koopdqn.files import read_json

LONGER = ("train.stop=limit", "train.extend=4")
RESULTS = ("policy.safetensors", "feedback.jsonl", "demos.hdf5", "intent.npz", "fit.json")
PICTURES = ("fit.png", "train.png")


@pytest.fixture(autouse=True)
def fresh_consoles() -> None:
    console.err.cache_clear()
    console.out.cache_clear()


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """SHA-256 of each result of a run that was never stopped."""
    folder = tmp_path_factory.mktemp("uninterrupted") / "run"
    assert cli.main(["train", *SOON, *LONGER, f"out={folder}", "--json"]) == 0
    return digests(folder)


def digests(folder: Path) -> dict[str, str]:
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in RESULTS}


def stop(folder: Path, when: str, number: signal.Signals) -> subprocess.CompletedProcess[str]:
    """Run in a process of its own and send it a signal as soon as something stands in the file ``when``."""
    checkout = str(Path(cli.__file__).resolve().parent.parent.parent)
    path = os.pathsep.join(filter(None, [checkout, os.environ.get("PYTHONPATH")]))
    process = subprocess.Popen(
        [sys.executable, "-m", "koopdqn", "train", *SOON, *LONGER, f"out={folder}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    try:
        while process.poll() is None and not any(path.stat().st_size for path in folder.glob(when)):
            time.sleep(0.005)
        process.send_signal(number)
        out, err = process.communicate(timeout=180)
    finally:
        process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


@pytest.mark.parametrize(
    ("when", "number", "not_yet"),
    [
        (".hydra/overrides.yaml", signal.SIGTERM, "intent.npz"),
        pytest.param("fit.json", signal.SIGKILL, "intent.npz", marks=pytest.mark.slow),
        ("checkpoints/latest.safetensors", signal.SIGKILL, "policy.safetensors"),
        ("checkpoints/latest.safetensors", signal.SIGHUP, "policy.safetensors"),
        pytest.param("train.json", signal.SIGINT, "train.png", marks=pytest.mark.slow),
    ],
)
def test_a_stopped_run_goes_on_to_the_same_bytes(
    uninterrupted: dict[str, str], tmp_path: Path, when: str, number: signal.Signals, not_yet: str
) -> None:
    folder = tmp_path / "run"
    stopped = stop(folder, when, number)
    assert not (folder / not_yet).exists()
    assert "Traceback" not in stopped.stderr
    if number == signal.SIGKILL:
        assert stopped.returncode == -signal.SIGKILL
    else:
        assert stopped.returncode == 130
        assert "interrupted; everything so far is kept" in stopped.stderr
        # Earlier than that the command has not begun.
        assert (f"koopdqn train run={folder} goes on" in stopped.stderr) or when.startswith(".hydra")
        assert not list(folder.rglob("*.part"))
    kept = {path: path.read_bytes() for path in folder.rglob("*") if path.suffix in (".hdf5", ".npz")}
    assert cli.main(["train", f"run={folder}", "--json"]) == 0
    assert digests(folder) == uninterrupted
    assert all(path.read_bytes() == content for path, content in kept.items())
    assert all((folder / name).is_file() for name in PICTURES)


def test_a_finished_run_goes_on_to_itself(uninterrupted: dict[str, str], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert cli.main(["train", *SOON, "train.stop=limit", "train.extend=2", f"out={folder}", "--json"]) == 0
    assert cli.main(["train", f"run={folder}", "train.extend=4", "--json"]) == 0
    assert digests(folder) == uninterrupted
    assert cli.main(["train", f"run={folder}", "train.extend=4", "--json"]) == 0
    assert digests(folder) == uninterrupted


def test_a_run_with_nothing_left_to_do_says_so_and_keeps_its_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    assert cli.main(["train", *SOON, f"out={folder}", "--json"]) == 0
    report = (folder / "train.json").read_bytes()
    assert "nothing was left to do" not in capsys.readouterr().err
    assert cli.main(["train", f"run={folder}", "--json"]) == 0
    assert "nothing was left to do" in capsys.readouterr().err
    assert (folder / "train.json").read_bytes() == report


def test_a_training_cut_short_by_a_limit_says_by_which(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    assert cli.main(["train", *SOON, f"out={folder}"]) == 0
    assert "went on" not in capsys.readouterr().out
    reached = read_json(folder / "train.json", "training report")["env_steps"]
    limited = f"train.max_steps={reached + 1}"
    assert cli.main(["train", f"run={folder}", "train.stop=limit", "train.extend=40", limited]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"less than train.extend=40: {limited} came first" in said
