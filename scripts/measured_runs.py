"""Runs of koopdqn commands that scripts make in folders of their own, and go on with where they stopped."""

import subprocess
import sys
from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Lock
from time import monotonic
from typing import Protocol, TypeVar

from omegaconf import OmegaConf

from koopdqn import console
from koopdqn.errors import BadInputError

Command = tuple[str, list[str]]
"""Name and arguments of a koopdqn command."""
Launch = Callable[[str, Sequence[str], Path], int]
"""Carries out a koopdqn command: its name, its arguments, the file for its output; gives its exit status."""

JOBS = 2
"""How many runs are made side by side by default; each keeps one core busy."""

_SECONDS = 60.0

_processes: set[subprocess.Popen[bytes]] = set()


def add_jobs(parser: ArgumentParser) -> None:
    """Let a script be told how many runs it makes side by side: ``--jobs``."""
    parser.add_argument("--jobs", type=_jobs, default=JOBS, help="runs side by side; default: %(default)s")


def _jobs(given: str) -> int:
    if not given.isdecimal() or int(given) < 1:
        raise ArgumentTypeError(f"must be a whole number of at least 1, found {given}")
    return int(given)


def launch(command: str, arguments: Sequence[str], output: Path) -> int:
    """Carry out a koopdqn command in a process of its own, so that its end is not ours."""
    return call(["-m", "koopdqn", command, *arguments], output)


def call(arguments: Sequence[str], output: Path) -> int:
    """Run this Python with arguments, appending what it prints to a file, and return its exit status."""
    output.parent.mkdir(parents=True, exist_ok=True)
    with output.open("a", encoding="utf-8") as file:
        process = subprocess.Popen([sys.executable, *arguments], stdin=subprocess.DEVNULL, stdout=file, stderr=file)
    _processes.add(process)
    try:
        return process.wait()
    finally:
        _processes.discard(process)


@dataclass(frozen=True)
class Training:
    """A training in a folder of its own.

    Attributes:
        folder: its run folder.
        overrides: what it is given beside that.
        remove: the folder to remove in order to measure anew, for messages.
    """

    folder: Path
    overrides: tuple[str, ...]
    remove: Path

    def finished(self) -> bool:
        """Return whether it came to a result.

        Raises:
            BadInputError: the folder holds a training with other overrides.
        """
        recorded = self._recorded()
        if recorded is not None and sorted(recorded) != sorted(self.overrides):
            raise BadInputError(
                f"{self.folder}: must be a training with {' '.join(self.overrides)}, found one with"
                f" {' '.join(recorded)}; remove {self.remove} to measure anew"
            )
        return recorded is not None and (self.folder / "train.json").is_file()

    def commands(self) -> list[Command]:
        """Return what is left to do: nothing, or one command that begins it or goes on with it.

        Raises:
            BadInputError: the folder holds a training with other overrides.
        """
        if self.finished():
            return []
        begun = self._recorded() is not None
        return [("train", [f"run={self.folder}"] if begun else [*self.overrides, f"out={self.folder}"])]

    def _recorded(self) -> list[str] | None:
        path = self.folder / ".hydra" / "overrides.yaml"
        if not path.is_file():
            return None
        recorded = [str(item) for item in OmegaConf.load(path)]
        return [item for item in recorded if item.partition("=")[0] not in ("command", "out")]


class Run(Protocol):
    """What :func:`carry_out` and :func:`measure` need of a run."""

    @property
    def name(self) -> str:
        """What the run is called in messages."""

    def commands(self) -> list[Command]:
        """Return what is left to do, in order; nothing if the run is finished.

        Raises:
            BadInputError: a folder holds a training with other overrides.
        """


R = TypeVar("R", bound=Run)


def carry_out(run: Run, launch: Launch = launch) -> str:
    """Do what is left of a run; return "" or, if a command crashed, one line that says so.

    What a command prints goes to a file beside its run folder.

    Raises:
        BadInputError: a folder holds a training with other overrides.
    """
    for command, arguments in run.commands():
        folder = _folder(arguments)
        output = folder.parent / f"{command}.txt"
        status = launch(command, arguments, output)
        # A training that did not learn ends with 1 too, but with its report.
        if status != 0 and not (command == "train" and status == 1 and (folder / "train.json").is_file()):
            return f"{run.name}: {command} ended with exit status {status}, see {output}"
    return ""


def _folder(arguments: Sequence[str]) -> Path:
    given = dict(item.partition("=")[::2] for item in arguments)
    return Path(given["out"] if "out" in given else given["run"])


def measure(
    title: str,
    runs: Sequence[R],
    finished: Callable[[R], None],
    launch: Launch = launch,
    minutes: float | None = None,
    jobs: int = 1,
    together: Callable[[R], Hashable] = lambda run: run.name,
) -> int:
    """Carry out what is left of runs; return the exit status: 1 if a command crashed, else 0.

    Args:
        title: of the progress shown.
        runs: in their order.
        finished: called with every run that is finished, also before this call; never twice at a time.
        launch: carries out commands.
        minutes: after which no new run is begun; None for no limit.
        jobs: how many runs are made side by side.
        together: runs for which it gives the same, that may use each other's folders, are made one after the other.

    Raises:
        BadInputError: the folder of a run holds a training with other overrides.
    """
    for run in runs:
        run.commands()  # other overrides are found out before hours are spent
    chains: dict[Hashable, list[R]] = {}
    for run in runs:
        chains.setdefault(together(run), []).append(run)
    began, crashes, late = monotonic(), 0, Event()
    one_at_a_time, stopped = Lock(), Event()

    with console.stage(title, len(runs)) as stage, ThreadPoolExecutor(jobs) as pool:

        def work(chain: Iterable[R]) -> None:
            try:
                carry_on(chain)
            except BaseException:
                stopped.set()
                raise

        def carry_on(chain: Iterable[R]) -> None:
            nonlocal crashes
            for run in chain:
                if stopped.is_set():
                    return
                if minutes is not None and monotonic() - began >= _SECONDS * minutes and run.commands():
                    late.set()
                    return
                stage.advance(0, run.name)
                crash = carry_out(run, launch)
                with one_at_a_time:
                    if stopped.is_set():
                        return
                    if crash:
                        crashes += 1
                        console.warn(crash)
                    else:
                        finished(run)
                    stage.advance(1)

        futures = [pool.submit(work, chain) for chain in chains.values()]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            stopped.set()
            for process in list(_processes):
                process.terminate()
            raise
    if late.is_set():
        left = sum(bool(run.commands()) for run in runs)
        console.note(f"{left} runs are left after {minutes:g} minutes; the same command goes on with them")
    return 1 if crashes else 0
