"""The number of threads is the config's, whatever the surroundings ask for."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from small_run import SMALL
from threadpoolctl import threadpool_info, threadpool_limits

from koopdqn import console
from koopdqn.app import cli
from koopdqn.errors import BadInputError
from koopdqn.threads import threads

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


def test_a_fit_does_not_follow_the_surroundings(tmp_path: Path) -> None:
    given = ["fit", *SMALL, "intent.count=600", "--json"]
    with threadpool_limits(limits=1):
        assert cli.main([*given, f"out={tmp_path / 'here'}"]) == 0
    done = subprocess.run(
        [sys.executable, "-m", "koopdqn", *given, f"out={tmp_path / 'elsewhere'}"],
        capture_output=True,
        env={**os.environ, "PYTHONPATH": CHECKOUT, "OMP_NUM_THREADS": "2"},
        check=False,
    )
    assert done.returncode == 0, done.stderr
    sha = {hashlib.sha256((tmp_path / name / "intent.npz").read_bytes()).hexdigest() for name in ("here", "elsewhere")}
    assert len(sha) == 1


def test_a_replay_takes_the_threads_of_its_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    console.err.cache_clear()
    (tmp_path / "feedback.jsonl").touch()
    (tmp_path / "train.json").write_text(json.dumps({"threads": 2}))
    given = ["train", *SMALL, "oracle=replay", f"journal={tmp_path}/feedback.jsonl", f"out={tmp_path}/again"]
    assert cli.main(given) == 2
    assert "train.threads: must be that of the run whose journal is given again (2, " in capsys.readouterr().err


@pytest.mark.parametrize("stopped_at", ["demos.hdf5", "intent.npz"])
def test_a_run_stopped_before_its_first_checkpoint_goes_on_with_its_own_threads(
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
    for damaged in ("[]", "{}", '{"threads": true}'):
        (tmp_path / "run" / "begun.json").write_text(damaged)
        assert cli.main(["train", f"run={tmp_path}/run"]) == 2


def test_a_number_that_a_library_does_not_take_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("threadpoolctl.threadpool_info", lambda: [{"internal_api": "blis", "num_threads": 4}])
    with pytest.raises(BadInputError, match="found 3, of which blis takes 4"), threads(3):
        pass
