"""Speed of EDMD with the paper's lift: beside kooplearn, and pykoopman in an environment of its own."""

import json
import subprocess
import tracemalloc
from pathlib import Path

import numpy as np

from benchmarks.rows import NOT_INSTALLED, NOT_MEASURED, Row, compared, installed
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.intent.observables import SecondOrder
from koopdqn.pose import Array

PAIRS = 1_000_000
MANY = 10_000_000
# It holds every power of every pair at once, several times over.
_FEWER = 100_000
_BAR_SECONDS = 2.0
_PYKOOPMAN = """
import json, sys, time, warnings
import numpy as np
warnings.simplefilter("ignore")
import pykoopman
states = np.load(sys.argv[1])
began = time.perf_counter()
lift = pykoopman.observables.Polynomial(degree=2)
pykoopman.Koopman(observables=lift, regressor=pykoopman.regression.EDMD()).fit(states[:-1], states[1:])
print(json.dumps(time.perf_counter() - began))
"""


def rows(folder: Path, pykoopman: Path | None, *, long: bool) -> list[Row]:
    """Return the rows of EDMD.

    Args:
        folder: for the pairs that another interpreter is to read.
        pykoopman: a Python that has pykoopman, or None.
        long: whether to fit ten times as many pairs too.
    """
    return [_beside_kooplearn(), _beside_pykoopman(folder, pykoopman), _many(long=long)]


def _motion(count: int) -> Array:
    """Return states (count, 3) of a noisy, damped and bent motion that never dies out."""
    rng = np.random.default_rng(0)
    states = rng.normal(size=(count, 3))
    turned = states[:-1] * [0.9, 0.8, 0.7] + 0.05 * states[:-1, [1, 2, 0]] ** 2
    states[1:] = turned + 0.1 * states[1:]
    return states


def _fit(states: Array) -> None:
    KoopmanModel.fit(SecondOrder(), states[:-1], states[1:], np.zeros(3), 1.0)


def _beside_kooplearn() -> Row:
    states = _motion(PAIRS + 1)
    work = None
    if installed("kooplearn"):
        from kooplearn.linear_model import Ridge

        def work() -> None:
            lifted = SecondOrder().lift(states)
            Ridge(reduced_rank=False, alpha=None, eigen_solver="dense", copy_X=False).fit(lifted)

    mine, theirs = compared(lambda: _fit(states), work, repeats=3)
    other = NOT_INSTALLED if theirs is None else theirs
    note = "lift included; kooplearn squares the condition number"
    return Row(f"EDMD, {PAIRS:,} pairs", mine, "s", "kooplearn `Ridge`, same lift", other, _BAR_SECONDS, note=note)


def _beside_pykoopman(folder: Path, python: Path | None) -> Row:
    states = _motion(_FEWER + 1)
    mine, _ = compared(lambda: _fit(states), None, repeats=3)
    theirs: float | str = NOT_INSTALLED
    if python is not None:
        path = folder / "states.npy"
        np.save(path, states)
        done = subprocess.run([python, "-c", _PYKOOPMAN, path], check=True, capture_output=True, text=True)
        theirs = float(json.loads(done.stdout.splitlines()[-1]))
    return Row(
        f"EDMD, {_FEWER:,} pairs", mine, "s", "pykoopman `EDMD`, same lift", theirs, note="in its own environment"
    )


def _many(*, long: bool) -> Row:
    what, peer = f"EDMD, {MANY:,} pairs", f"ten times {PAIRS:,} pairs"
    if not long:
        return Row(what, None, "s", peer, NOT_MEASURED, least_ratio=0.8)
    few, many = _motion(PAIRS + 1), _motion(MANY + 1)
    mine, theirs = compared(lambda: _fit(many), lambda: _fit(few), repeats=3)
    assert theirs is not None
    tracemalloc.start()
    _fit(many)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    note = f"{peak / 1e6:.0f} MB beside the {many.nbytes / 1e6:.0f} MB of states"
    return Row(what, mine, "s", peer, 10.0 * theirs, least_ratio=0.8, note=note)
