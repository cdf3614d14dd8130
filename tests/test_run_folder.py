"""A run folder holds files of its own only, and one process works in it at a time."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from questions import written

from koopdqn.app import feedback
from koopdqn.app.hydra.overrides import prepare
from koopdqn.errors import BadInputError
from koopdqn.files import write_text
from koopdqn.oracles.base import Answer
from koopdqn.oracles.journal import JournalFile
from koopdqn.report.runs import find_runs
from koopdqn.run_folder import JOURNAL, LOCK, RECORD, check_plain, locked

CHECKOUT = str(Path(__file__).resolve().parent.parent)
HOLD = """
import sys, time
from pathlib import Path
from koopdqn.run_folder import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    (folder / RECORD).parent.mkdir(parents=True)
    (folder / RECORD).write_text("- command=train\n")
    (folder / "checkpoints").mkdir()
    return folder


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    path = tmp_path / "precious.txt"
    path.write_text("precious, and the last line is open")
    return path


@pytest.mark.parametrize(
    "name", ["feedback.jsonl", "demos.hdf5", "checkpoints/latest.safetensors", ".policy.part", "x"]
)
def test_a_link_in_a_run_folder_is_refused_by_every_command(run: Path, outside: Path, name: str) -> None:
    (run / name).symlink_to(outside)
    for command in ("eval", "train"):
        with pytest.raises(BadInputError, match=f"must hold files and folders only, found a link: {name}"):
            prepare(command, [f"run={run}"])
    with pytest.raises(BadInputError, match="found a link"):
        feedback.show([run], as_json=False)
    for missing in ("train.json", "policy.safetensors"):
        (run / missing).touch()
    [skipped] = find_runs([run])[1]
    assert "found a link" in skipped.reason
    assert outside.read_text() == "precious, and the last line is open"


def test_a_linked_folder_a_pipe_and_a_loop_are_refused(run: Path, tmp_path: Path) -> None:
    (run / "events").symlink_to(tmp_path)
    with pytest.raises(BadInputError, match="found a link: events"):
        check_plain(run)
    (run / "events").unlink()
    os.mkfifo(run / "train.json")
    with pytest.raises(BadInputError, match="found something else: train"):
        check_plain(run)
    (run / "train.json").unlink()
    check_plain(run)
    (tmp_path / "name").symlink_to(run)
    check_plain(tmp_path / "name")


@pytest.mark.parametrize("link", [Path.symlink_to, Path.hardlink_to])
def test_a_journal_is_never_written_through_a_link(run: Path, outside: Path, link: object) -> None:
    link(run / JOURNAL, outside)  # type: ignore[operator]  # either is a method of Path
    with pytest.raises(BadInputError, match="must be writable, the system says"):
        JournalFile(run / JOURNAL)
    assert outside.read_text() == "precious, and the last line is open"


def test_a_file_is_never_written_through_a_link(tmp_path: Path, outside: Path) -> None:
    for name in (".x.json.part", "x.json"):
        (tmp_path / name).symlink_to(outside)
    write_text(tmp_path / "x.json", "{}")
    assert outside.read_text() == "precious, and the last line is open"
    assert not (tmp_path / "x.json").is_symlink()


def holder(folder: Path) -> "subprocess.Popen[str]":
    """Return a process that holds a folder's lock until it reads a line or ends."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": CHECKOUT},
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    return process


def test_a_second_process_is_told_who_holds_the_folder(run: Path) -> None:
    written(run / JOURNAL, [Answer(True, "anna", 0.5)])
    before = (run / JOURNAL).read_bytes()
    process = holder(run)
    try:
        with pytest.raises(BadInputError, match=f"found it in use by process {process.pid} on "), locked(run):
            raise AssertionError("it must not come so far")
        with pytest.raises(BadInputError, match=f"process {process.pid}"):
            feedback.edit(run, 0, "wrong", None, drop_later=False)
        assert (run / JOURNAL).read_bytes() == before
    finally:
        process.communicate("\n")
    with locked(run), locked(run):
        assert (run / LOCK).read_text().startswith(f"process {os.getpid()} ")
    assert not (run / LOCK).exists()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_lock_ends_with_its_process(run: Path, number: signal.Signals) -> None:
    process = holder(run)
    process.send_signal(number)
    process.wait()
    with locked(run):
        pass


def test_of_many_processes_one_gets_the_lock(run: Path) -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", HOLD, str(run)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env={**os.environ, "PYTHONPATH": CHECKOUT},
        )
        for _ in range(4)
    ]
    # Whoever has it keeps it until all others have said what became of them.
    said = [process.stdout.readline() for process in processes if process.stdout is not None]
    for process in processes:
        process.communicate("\n")
    assert sorted(said) == ["", "", "", "held\n"]
    assert [process.returncode == 0 for process in processes] == [out == "held\n" for out in said]
