"""Runs of scripts, made side by side."""

from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Barrier, Lock
from time import monotonic

import pytest
from measured_runs import JOBS, Command, add_jobs, call, measure

from koopdqn.errors import BadInputError


@dataclass
class Errand:
    """A run that is finished when its folder is there."""

    name: str
    root: Path

    @property
    def folder(self) -> Path:
        return self.root / self.name

    def commands(self) -> list[Command]:
        return [] if self.folder.exists() else [("eval", [f"out={self.folder}"])]


@dataclass
class Together:
    """Carries out commands, the first ones only when ``count`` of them are under way at once."""

    count: int
    begun: list[str] = field(default_factory=list)
    most: int = 0
    _under_way: int = 0
    _lock: Lock = field(default_factory=Lock)

    def __post_init__(self) -> None:
        self._meeting = Barrier(self.count)

    def __call__(self, command: str, arguments: Sequence[str], output: Path) -> int:
        folder = Path(arguments[0].removeprefix("out="))
        with self._lock:
            self.begun.append(folder.name)
            first = len(self.begun) <= self.count
            self._under_way += 1
            self.most = max(self.most, self._under_way)
        if first:
            self._meeting.wait(timeout=60)
        folder.mkdir(parents=True)
        with self._lock:
            self._under_way -= 1
        return 0


def test_as_many_runs_as_jobs_are_made_at_once_and_those_of_a_chain_in_their_order(tmp_path: Path) -> None:
    runs = [Errand(f"{chain}{place}", tmp_path) for place in range(3) for chain in "abc"]
    launcher = Together(2)
    finished: list[Errand] = []
    status = measure("Runs", runs, finished.append, launcher, jobs=2, together=lambda run: run.name[0])
    assert status == 0
    assert launcher.most == 2
    assert sorted(run.name for run in finished) == sorted(run.name for run in runs)
    for chain in "abc":
        assert [name for name in launcher.begun if name[0] == chain] == [f"{chain}{place}" for place in range(3)]


def test_no_run_is_begun_after_one_could_not_be_told_of(tmp_path: Path) -> None:
    runs = [Errand(f"run{place}", tmp_path) for place in range(5)]
    launcher = Together(1)

    def finished(run: Errand) -> None:
        raise BadInputError(f"{run.name}: the page must be readable")

    with pytest.raises(BadInputError, match="run0: the page must be readable"):
        measure("Runs", runs, finished, launcher)
    assert launcher.begun == ["run0"]


def test_commands_under_way_are_ended_with_the_measurement(tmp_path: Path) -> None:
    runs = [Errand("slow", tmp_path), Errand("broken", tmp_path)]
    began = monotonic()

    def launcher(command: str, arguments: Sequence[str], output: Path) -> int:
        if "slow" in arguments[0]:
            return call(["-c", "print('begun', flush=True); import time; time.sleep(600)"], output)
        while not (tmp_path / "eval.txt").is_file() or not (tmp_path / "eval.txt").read_text(encoding="utf-8"):
            assert monotonic() - began < 60
        raise BadInputError("broken: must be whole")

    with pytest.raises(BadInputError, match="broken: must be whole"):
        measure("Runs", runs, lambda run: None, launcher, jobs=2)
    assert monotonic() - began < 300


@pytest.mark.parametrize("given", ["0", "-1", "two", "1.5"])
def test_a_number_of_jobs_that_is_none_is_bad_input(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser = ArgumentParser()
    add_jobs(parser)
    assert parser.parse_args([]).jobs == JOBS
    assert parser.parse_args(["--jobs", "3"]).jobs == 3
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args([f"--jobs={given}"])
    assert f"must be a whole number of at least 1, found {given}" in capsys.readouterr().err
