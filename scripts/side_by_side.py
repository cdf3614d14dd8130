"""Runs made side by side, each command in a process that ends with ours."""

import subprocess
import sys
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from threading import Event, Lock
from time import monotonic
from typing import Protocol, TypeVar

from study_runs import IMITATE, Launch

from koopdqn import console


class Work(Protocol):
    """What can be carried out beside other work."""

    @property
    def name(self) -> str:
        """Shown while it is carried out."""

    @property
    def chain(self) -> Hashable:
        """Works of one chain are carried out one after another."""

    def finished(self) -> bool:
        """Return whether nothing is left to do."""

    def carry_out(self, launch: Launch) -> str:
        """Do what is left; return what went wrong, or nothing."""


W = TypeVar("W", bound=Work)

_processes: set[subprocess.Popen[bytes]] = set()


def launch(command: str, arguments: Sequence[str], output: Path) -> int:
    """Carry out a koopdqn command, or ``imitate.py``, appending what it prints to a file."""
    script = [str(Path(__file__).with_name("imitate.py"))]
    return call([*(script if command == IMITATE else ["-m", "koopdqn", command]), *arguments], output)


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


def measure(
    title: str,
    runs: Sequence[W],
    finished: Callable[[W], None],
    launch: Launch = launch,
    minutes: float | None = None,
    jobs: int = 1,
) -> int:
    """Carry out what is left of runs; return the exit status: 1 if a command crashed, else 0.

    Args:
        title: of the progress shown.
        runs: in their order; those of one chain, which may share folders, are made one after another.
        finished: called with every run that is finished, also before this call; never twice at a time.
        launch: carries out commands.
        minutes: after which no new run is begun; None for no limit.
        jobs: how many runs are made side by side.
    """
    chains: dict[Hashable, list[W]] = {}
    for run in runs:
        chains.setdefault(run.chain, []).append(run)
    began, stopped, one_at_a_time = monotonic(), Event(), Lock()
    crashes: list[str] = []

    def carry_on(chain: Iterable[W]) -> None:
        try:
            for run in chain:
                late = minutes is not None and monotonic() - began >= 60 * minutes
                if stopped.is_set() or (late and not run.finished()):
                    return
                stage.advance(0, run.name)
                crash = run.carry_out(launch)
                with one_at_a_time:
                    if stopped.is_set():
                        return
                    if crash:
                        crashes.append(crash)
                        console.warn(crash)
                    else:
                        finished(run)
                    stage.advance(1)
        except BaseException:
            stopped.set()  # before this thread takes the next chain
            raise

    with console.stage(title, len(runs)) as stage, ThreadPoolExecutor(jobs) as pool:
        futures = [pool.submit(carry_on, chain) for chain in chains.values()]
        try:
            for future in as_completed(futures):
                future.result()
        except BaseException:
            stopped.set()
            for process in list(_processes):
                process.terminate()
            raise
    if crashes:
        console.warn(f"{len(crashes)} of {len(runs)} runs came to no result: {'; '.join(crashes)}")
    if minutes is not None and (left := sum(not run.finished() for run in runs) - len(crashes)):
        console.note(f"{left} runs are left after {minutes:g} minutes; the same command goes on with them")
    return 1 if crashes else 0
