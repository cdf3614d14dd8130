"""Speed of starting: the command's help, and the way from PyTorch's import to the first training step."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.rows import Row

_REPEATS = 5
# Each prints what it took [s], so that starting Python and PyTorch does not count.
_LIBRARIES = """
import json, time
import torch
began = time.perf_counter()
import dm_control.mjcf, h5py, hydra, mujoco, pydantic, safetensors, scipy.interpolate, scipy.spatial.transform
import torch.utils.tensorboard
print(json.dumps(time.perf_counter() - began))
"""
_FIRST_STEP = """
import json, os, sys, time
import torch
began = time.perf_counter()
from koopdqn.app import cli
from koopdqn.rl.algorithm1 import Trainer
def first(trainer, *called):
    trainer.collect()
    print(json.dumps(time.perf_counter() - began), flush=True)
    os._exit(0)
Trainer.run = first
cli.main(["train", *sys.argv[1:]])
"""


def rows(folder: Path) -> list[Row]:
    """Return the rows of starting; the intent that the first step needs is fitted below ``folder`` first."""
    return [_help(), _first_step(folder)]


def _help() -> Row:
    command = [str(Path(sys.executable).with_name("koopdqn")), "--help"]
    bare = [sys.executable, "-c", "import typer.rich_utils"]
    mine, theirs = _medians(lambda: _wall(command), lambda: _wall(bare))
    note = "whole processes"
    return Row("`koopdqn --help`", mine, "s", "importing Typer and Rich alone", theirs, 0.3, note=note)


def _first_step(folder: Path) -> Row:
    fitted = folder / "fit"
    koopdqn = str(Path(sys.executable).with_name("koopdqn"))
    subprocess.run([koopdqn, "fit", "task=shelf", f"out={fitted}"], check=True, capture_output=True)
    given = [f"demos={fitted / 'demos.hdf5'}", f"intent={fitted / 'intent.npz'}"]
    count = 0

    def ours() -> float:
        nonlocal count
        count += 1
        return _printed(_FIRST_STEP, ["task=shelf", f"out={folder / f'step-{count}'}", *given])

    mine, theirs = _medians(ours, lambda: _printed(_LIBRARIES, []))
    note = "demonstrations and intent given; PyTorch's import before"
    return Row("first training step", mine, "s", "importing the libraries it uses", theirs, 1.5, note=note)


def _medians(ours: Callable[[], float], theirs: Callable[[], float]) -> tuple[float, float]:
    times = [(ours(), theirs()) for _ in range(_REPEATS)]
    return statistics.median(a for a, _ in times), statistics.median(b for _, b in times)


def _wall(command: Sequence[str]) -> float:
    """Return how long a whole process takes [s]."""
    began = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True)
    return time.perf_counter() - began


def _printed(code: str, arguments: Sequence[str]) -> float:
    """Return the time [s] that a Python process prints at last."""
    done = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    return float(json.loads(done.stdout.splitlines()[-1]))
