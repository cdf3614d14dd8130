"""Kills trainings at random moments, lets them go on, and compares every byte with a run that was never stopped."""

import hashlib
import os
import shutil
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Final

import numpy as np
from prove import KILLS, LONGEST_S, cpu_seconds

from koopdqn.app import cli
from koopdqn.errors import WorkFailedError

_LEARNER: Final = (
    *("demo.count=3", "intent.count=60", "agent.network.hidden=[32]", "agent.network.fourier_features=32"),
    *("agent.batch=64", "agent.warm_up=400", "agent.episodes_at_once=16", "train.check_every=10"),
    *("train.stop=limit", "train.extend=50", "train.max_steps=2500"),
)
_RESULTS: Final = ("demos.hdf5", "intent.npz", "fit.json", "feedback.jsonl", "policy.safetensors")
_SIGNALS: Final = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
_MOST_KILLS: Final = 3


def soak(seed: int, minutes: float, folder: Path) -> Counter[tuple[str, str]]:
    """Return how often each end of each scenario was seen, and how often a signal ended its process (``kills``)."""
    # Loaded once: what follows is forked, and begins at once.
    import matplotlib.pyplot  # noqa: F401
    import torch  # noqa: F401

    import koopdqn.app.commands.train
    import koopdqn.plots.train  # noqa: F401

    until, rng, counts = time.monotonic() + 60.0 * minutes, np.random.default_rng(seed), Counter[tuple[str, str]]()
    whole: dict[str, tuple[dict[str, str], float]] = {}
    while time.monotonic() < until:
        for name, words in _scenarios(folder).items():
            if time.monotonic() > until:
                break
            if name not in whole:
                began, kept = time.monotonic(), folder / name.replace(", ", "-")
                status = _wait(_begun([*words, f"out={kept}"]), 600.0)
                if status not in (0, 1):
                    raise WorkFailedError(f"{name}: a run that is never stopped must end, found status {status}")
                whole[name] = _digests(kept), time.monotonic() - began
            end, kills, detail = _stopped_and_gone_on(words, folder / "run", *whole[name], rng)
            counts[name, end] += 1
            counts[name, KILLS] += kills
            print(f"seed {seed}: {name}: {end} {detail}", flush=True)
    return counts


def _scenarios(folder: Path) -> dict[str, list[str]]:
    shelf = ["train", "task=shelf", *_LEARNER]
    knife = ["train", "task=knife", *_LEARNER]
    shown = ["train", "task=demonstrated", f"demos={folder}/shelf-scripted/demos.hdf5", *_LEARNER]
    tasks = {"shelf": shelf, "knife": knife, "demonstrated": shown}
    found = {f"{name}, scripted": words for name, words in tasks.items()}
    for name, words in tasks.items():
        journal = f"journal={folder}/{name}-scripted/feedback.jsonl"
        found[f"{name}, journalled"] = [*words, "oracle=replay", journal]
    return found


def _begun(words: list[str]) -> int:
    child = os.fork()
    if child == 0:
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        status = 70
        try:
            status = cli.main(words)
        finally:
            os._exit(status)
    return child


def _wait(child: int, seconds: float) -> int | None:
    """Return the exit status of a process, minus the signal that ended it, or None if it had to be ended.

    Args:
        child: its number.
        seconds: of computing that it may take, in ten times as many of the clock.
    """
    most = cpu_seconds(child) + seconds
    until = time.monotonic() + 10.0 * seconds
    while time.monotonic() < until and cpu_seconds(child) < most:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def _stopped_and_gone_on(
    words: list[str], run: Path, expected: dict[str, str], seconds: float, rng: np.random.Generator
) -> tuple[str, int, str]:
    """Return what comes of a run that is stopped once to thrice, how often it was stopped, and when.

    A signal that comes after the end stops nothing. A run stopped before it had begun begins again.
    """
    shutil.rmtree(run, ignore_errors=True)
    # What lies outside the run is named again: a record alone reads nothing there.
    again = [f"run={run}", *(word for word in words if word.startswith(("journal=", "demos=")))]
    said, kills = [], 0
    for _ in range(int(rng.integers(1, _MOST_KILLS + 1))):
        record = run / ".hydra" / "overrides.yaml"
        begun = record.is_file() and record.stat().st_size > 0
        if not begun:
            shutil.rmtree(run, ignore_errors=True)
        child = _begun(["train", *again] if begun else [*words, f"out={run}"])
        moment, number = float(rng.uniform(0.0, seconds)), signal.Signals(rng.choice(_SIGNALS))
        said.append(f"{number.name} after {moment:.2f} s")
        time.sleep(moment)
        os.kill(child, number)
        status = _wait(child, LONGEST_S)
        if status is None:
            return "hang", kills, ", ".join(said)
        if status not in (0, 1, 130, -number):
            return "wrong", kills, f"status {status}: {', '.join(said)}"
        kills += status in (130, -number)
    begun = (run / ".hydra" / "overrides.yaml").is_file() and (run / ".hydra" / "overrides.yaml").stat().st_size > 0
    if not begun:
        shutil.rmtree(run, ignore_errors=True)
    status = _wait(_begun(["train", *again] if begun else [*words, f"out={run}"]), max(600.0, 20.0 * seconds))
    if status is None:
        return "hang", kills, ", ".join(said)
    if status not in (0, 1):
        return "wrong", kills, f"went on with status {status}: {', '.join(said)}"
    found = _digests(run)
    other = [name for name in _RESULTS if found[name] != expected[name]]
    if other:
        return "wrong", kills, f"other bytes in {', '.join(other)}: {', '.join(said)}"
    return "done", kills, ", ".join(said)


def _digests(folder: Path) -> dict[str, str]:
    return {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest() if (folder / name).is_file() else "missing"
        for name in _RESULTS
    }
