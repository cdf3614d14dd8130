"""What the dashboard of a training costs: CPU time of the same run with it and without, in pairs.

``python scripts/watching.py --pairs 4 task=shelf seed=0 demos=FILE`` prints a row a pair. Both runs of a
pair have a terminal of the same size; without the dashboard its kind is ``dumb``. They alternate, so that what else the
machine does meets both alike. CPU time is the process's own, user and system, from start to end. On a busy machine it
differs by a few per cent from run to run. The first row therefore tells, of one training in this process, on
demonstrations that it makes, which share of its CPU time was spent in the dashboard.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from statistics import fmean, median, stdev

import pexpect
from benchmarks.learning import prepare

from koopdqn.console import LiteralConsole
from koopdqn.errors import WorkFailedError
from koopdqn.view.dashboard import Dashboard

SIZE = (24, 80)


def cpu_seconds(term: str, overrides: list[str], out: Path) -> float:
    """Return the CPU time [s] of a training at a terminal of a kind.

    Raises:
        WorkFailedError: it wrote no report.
    """
    before = os.times()
    child = pexpect.spawn(
        sys.executable,
        ["-m", "koopdqn", "train", *overrides, f"out={out}"],
        dimensions=SIZE,
        env={**os.environ, "TERM": term},
        timeout=None,
    )
    # The terminal must be read, or its writer waits.
    while child.isalive():
        try:
            child.read_nonblocking(1 << 16, timeout=0.2)
        except pexpect.TIMEOUT:
            continue
        except pexpect.EOF:
            break
    child.wait()
    after = os.times()
    if not (out / "train.json").is_file():
        raise WorkFailedError(f"a training must write {out / 'train.json'}, found none")
    return after.children_user - before.children_user + after.children_system - before.children_system


def share(overrides: list[str]) -> float:
    """Return the share of a training's CPU time that the dashboard takes, drawn into nothing."""
    prepared = prepare(*overrides)
    trainer = prepared.trainer()
    taken = 0.0
    with Path(os.devnull).open("w") as nowhere:
        console = LiteralConsole(file=nowhere, force_terminal=True, height=SIZE[0], width=SIZE[1])
        with Dashboard(trainer, prepared.shown, None, console) as board:

            def on_round() -> None:
                nonlocal taken
                began = time.process_time()
                board.round()
                taken += time.process_time() - began

            began = time.process_time()
            trainer.run(on_round=on_round)
            return taken / (time.process_time() - began)


def main() -> int:
    """Measure the share and the pairs and print them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument("overrides", nargs="*")
    given = parser.parse_args()
    print(f"share of the CPU time of a training: {share(given.overrides):.2%}", flush=True)
    kinds = {"with": "xterm-256color", "without": "dumb"}
    shares = []
    with tempfile.TemporaryDirectory() as folder:
        for pair in range(given.pairs):
            order = list(kinds) if pair % 2 == 0 else list(kinds)[::-1]
            runs = {name: Path(folder) / f"{pair}-{name}" for name in order}
            taken = {name: cpu_seconds(kinds[name], given.overrides, out) for name, out in runs.items()}
            same = len({(out / "policy.safetensors").read_bytes() for out in runs.values()}) == 1
            shares.append(taken["with"] / taken["without"] - 1.0)
            print(
                f"pair {pair}: with {taken['with']:.1f} s, without {taken['without']:.1f} s, {shares[-1]:+.1%},"
                f" policies {'the same' if same else 'DIFFER'}",
                flush=True,
            )
    spread = f", standard deviation {stdev(shares):.2%}" if len(shares) > 1 else ""
    print(f"median {median(shares):+.2%}, mean {fmean(shares):+.2%}{spread}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
