"""The number of threads is the config's, whatever the surroundings ask for."""

import hashlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_run import SMALL
from threadpoolctl import threadpool_info, threadpool_limits

from koopdqn import console
from koopdqn.app import cli
from koopdqn.errors import BadInputError
from koopdqn.threads import in_halves, threads

CHECKOUT = str(Path(cli.__file__).resolve().parent.parent.parent)


def taken() -> set[int]:
    return {library["num_threads"] for library in threadpool_info()}


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_library_takes_the_number_and_gives_it_back(count: int) -> None:
    import scipy.linalg  # noqa: F401
    import torch

    with threadpool_limits(limits=2):
        before = torch.get_num_threads(), dict(os.environ)
        with threads(count):
            assert taken() == {count}
            assert torch.get_num_threads() == count
        assert (torch.get_num_threads(), dict(os.environ)) == before
        assert taken() == {2}


def test_sums_are_the_same_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(700, 700))
    results = []
    for surrounding in (1, 2, 8):
        with threadpool_limits(limits=surrounding), threads(1):
            results.append(np.linalg.solve(matrix @ matrix.T + np.eye(700), matrix).tobytes())
    assert results[0] == results[1] == results[2]


@given(count=st.integers(0, 3000))
def test_halves_are_all_rows_once_however_many_there_are(count: int) -> None:
    seen = np.zeros(count, dtype=int)
    parts: list[slice] = []

    def work(rows: slice) -> None:
        seen[rows] += 1
        parts.append(rows)

    in_halves(count, work)
    assert (seen == 1).all()
    assert len(parts) == (2 if count >= 128 else 1)


@pytest.mark.parametrize("row", [0, 999])
def test_what_goes_wrong_in_a_half_is_raised(row: int) -> None:
    def work(rows: slice) -> None:
        if rows.start <= row < rows.stop:
            raise ValueError(f"row {row}")

    with pytest.raises(ValueError, match=f"row {row}"):
        in_halves(1000, work)


@pytest.mark.parametrize("count", [1, 2])
def test_both_halves_compute_with_the_same_threads_and_without_gradients(count: int) -> None:
    import torch

    weight, found = torch.ones(4, requires_grad=True), []

    def work(rows: slice) -> None:
        found.append((torch.get_num_threads(), torch.is_grad_enabled(), (weight * rows.start).requires_grad))

    with threads(count), torch.no_grad():
        in_halves(1000, work)
    assert found == [(count, False, False)] * 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_forked_process_has_a_thread_of_its_own_for_the_second_half() -> None:
    in_halves(1000, lambda rows: None)
    child = os.fork()
    if child == 0:
        signal.alarm(20)
        in_halves(1000, lambda rows: None)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0


SURROUNDINGS = {
    "plain": {"OMP_NUM_THREADS": "1", "LC_ALL": "C", "TZ": "UTC", "PYTHONHASHSEED": "0"},
    "Büro 2": {"OMP_NUM_THREADS": "8", "LC_ALL": "C.UTF-8", "TZ": "Asia/Tokyo", "PYTHONHASHSEED": "7"},
}
"""By the folder in which a training runs: the environment."""
MORE = ("intent.count=600", "train.max_steps=500")


def test_a_training_does_not_follow_its_surroundings(tmp_path: Path) -> None:
    digests = []
    for name, around in SURROUNDINGS.items():
        folder = tmp_path / name
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-m", "koopdqn", "train", *SMALL, *MORE, "out=run", "--json"],
            capture_output=True,
            cwd=folder,
            env={**os.environ, "PYTHONPATH": CHECKOUT, **around},
            check=False,
        )
        assert done.returncode in (0, 1), done.stderr
        files = ("demos.hdf5", "intent.npz", "fit.json", "feedback.jsonl", "policy.safetensors")
        digests.append([hashlib.sha256((folder / "run" / file).read_bytes()).hexdigest() for file in files])
    assert digests[0] == digests[1]


def test_a_replay_takes_the_threads_of_its_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    console.err.cache_clear()
    (tmp_path / "feedback.jsonl").touch()
    (tmp_path / "train.json").write_text(json.dumps({"threads": 2}))
    given = ["train", *SMALL, "oracle=replay", f"journal={tmp_path}/feedback.jsonl", f"out={tmp_path}/again"]
    assert cli.main(given) == 2
    assert "train.threads: must be that of the run whose journal is given again (2, " in capsys.readouterr().err


@pytest.mark.parametrize("stopped_at", ["demos.hdf5", "intent.npz"])
def test_a_run_stopped_before_its_first_checkpoint_goes_on_with_its_own_threads_and_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, stopped_at: str
) -> None:
    console.err.cache_clear()
    place = {"demos.hdf5": "fitted_intent", "intent.npz": "agent_steps"}[stopped_at]
    where = "koopdqn.app.commands." + ("pipeline." if place == "fitted_intent" else "train.") + place
    with monkeypatch.context() as patched:
        patched.setattr(where, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert cli.main(["train", *SMALL, f"out={tmp_path}/run"]) == 130
    assert (tmp_path / "run" / stopped_at).is_file()
    assert not (tmp_path / "run" / "checkpoints").exists()
    capsys.readouterr()
    assert cli.main(["train", f"run={tmp_path}/run", "train.threads=2"]) == 2
    assert "train.threads: must be 1, with which the run in " in capsys.readouterr().err
    # The demonstrations that lie there were made with the settings of before, and fitted with them.
    for name, value in {"seed": "9", "demo.count": "7", "reward.prediction": "raw", "task.person.name": "wide"}.items():
        override = "person=wide" if name.startswith("task") else f"{name}={value}"
        assert cli.main(["train", f"run={tmp_path}/run", override]) == 2
        said = " ".join(capsys.readouterr().err.split())
        assert "can only go on with the config it began with" in said
        assert name in said
    for damaged in ("[]", "{}", '{"threads": true}'):
        (tmp_path / "run" / "begun.json").write_text(damaged)
        assert cli.main(["train", f"run={tmp_path}/run"]) == 2


def test_a_number_that_a_library_does_not_take_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("threadpoolctl.threadpool_info", lambda: [{"internal_api": "blis", "num_threads": 4}])
    with pytest.raises(BadInputError, match="found 3, of which blis takes 4"), threads(3):
        pass
