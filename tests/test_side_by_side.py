"""Runs made side by side."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Barrier, Lock
from time import monotonic

import pytest
from side_by_side import call, measure
from study_runs import Launch

from koopdqn.errors import BadInputError


@dataclass
class Errand:
    """A run that is finished when its folder is there, in a chain named by the first letter."""

    name: str
    root: Path

    @property
    def chain(self) -> str:
        return self.name[0]

    def finished(self) -> bool:
        return (self.root / self.name).exists()

    def carry_out(self, launch: Launch) -> str:
        status = 0 if self.finished() else launch("eval", [self.name], self.root / "eval.txt")
        return f"{self.name}: eval ended with exit status {status}" if status else ""


@dataclass
class Together:
    """Carries out commands, the first ones only when ``count`` of them are under way at once."""

    root: Path
    count: int
    begun: list[str] = field(default_factory=list)
    most: int = 0
    _under_way: int = 0
    _lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self._meeting = Barrier(self.count)

    def __call__(self, command: str, arguments: Sequence[str], output: Path) -> int:
        with self._lock:
            self.begun.append(arguments[0])
            first = len(self.begun) <= self.count
            self._under_way += 1
            self.most = max(self.most, self._under_way)
        if first:
            self._meeting.wait(timeout=60)
        (self.root / arguments[0]).mkdir(parents=True)
        with self._lock:
            self._under_way -= 1
        return 0


def test_as_many_runs_as_jobs_are_made_at_once_and_those_of_a_chain_in_their_order(tmp_path: Path) -> None:
    runs = [Errand(f"{chain}{place}", tmp_path) for place in range(3) for chain in "abc"]
    finished: list[Errand] = []
    launcher = Together(tmp_path, 2)
    assert measure("Runs", runs, finished.append, launcher, jobs=2) == 0
    assert launcher.most == 2
    assert sorted(run.name for run in finished) == sorted(run.name for run in runs)
    for chain in "abc":
        assert [name for name in launcher.begun if name[0] == chain] == [f"{chain}{place}" for place in range(3)]


def test_no_run_is_begun_after_one_could_not_be_told_of(tmp_path: Path) -> None:
    launcher = Together(tmp_path, 1)

    def finished(run: Errand) -> None:
        raise BadInputError(f"{run.name}: the page must be readable")

    with pytest.raises(BadInputError, match="a: the page must be readable"):
        measure("Runs", [Errand(name, tmp_path) for name in "abcde"], finished, launcher)
    assert launcher.begun == ["a"]


def test_no_run_is_begun_after_the_time_but_finished_ones_are_told_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "done").mkdir()
    finished: list[Errand] = []
    launcher = Together(tmp_path, 1)
    runs = [Errand("done", tmp_path), Errand("late", tmp_path)]
    assert measure("Runs", runs, finished.append, launcher, minutes=0) == 0
    assert (launcher.begun, finished) == ([], runs[:1])
    assert "1 runs are left after 0 minutes" in capsys.readouterr().err


def test_a_crash_is_told_and_listed_at_the_end_and_the_others_go_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finished: list[Errand] = []
    good = Together(tmp_path, 1)

    def launch(command: str, arguments: Sequence[str], output: Path) -> int:
        return 1 if arguments[0] == "bad" else good(command, arguments, output)

    runs = [Errand(name, tmp_path) for name in ("bad", "good")]
    assert measure("Runs", runs, finished.append, launch) == 1
    assert finished == runs[1:]
    told = capsys.readouterr().err
    assert told.count("bad: eval ended with exit status 1") == 2
    assert "1 of 2 runs came to no result" in told


def test_commands_under_way_are_ended_with_the_measurement(tmp_path: Path) -> None:
    runs, began = [Errand("slow", tmp_path), Errand("broken", tmp_path)], monotonic()

    def launcher(command: str, arguments: Sequence[str], output: Path) -> int:
        if "slow" in arguments[0]:
            return call(["-c", "print('begun', flush=True); import time; time.sleep(600)"], output)
        while not output.is_file() or not output.read_text(encoding="utf-8"):
            assert monotonic() - began < 60
        raise BadInputError("broken: must be whole")

    with pytest.raises(BadInputError, match="broken: must be whole"):
        measure("Runs", runs, lambda run: None, launcher, jobs=2)
    assert monotonic() - began < 300
