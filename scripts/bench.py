"""Measures koopdqn's speed beside peers and limits, all in one run: `make bench`.

The rows go to ``docs/performance.json``, and as a table between the markers of ``docs/performance.md``, unless some are
left out by ``--short``. Peers are the optional extra ``bench``; a row whose peer is missing says so.
"""

import json
import os
import platform
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
from benchmarks import edmd, environments, kinematics, learning, startup
from benchmarks.rows import Row, line, table

from docs import replaced

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs" / "performance.json"
PAGE = ROOT / "docs" / "performance.md"
_PACKAGES = (
    "mujoco",
    "numpy",
    "torch",
    "dm_control",
    "eaik",
    "gymnasium",
    "kooplearn",
    "stable_baselines3",
    "ur-analytic-ik",
)


def measured(folder: Path, pykoopman: Path | None, *, long: bool) -> Iterator[Row]:
    """Yield all rows as they are measured; what they write on the way goes below a folder."""
    yield from startup.rows(folder)
    prepared = learning.prepare("task=shelf")
    yield from kinematics.rows(prepared.workcell)
    yield learning.update_row(prepared)
    yield environments.row()
    yield from edmd.rows(folder, pykoopman, long=long)
    for task in ("shelf", "knife"):
        yield from learning.learning_rows(task, folder, long=long)


def machine(load: float) -> str:
    """Return what the figures were measured on, given the load average before."""
    found = []
    for name in _PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return (
        f"Measured on {os.cpu_count()} cores, one thread of BLAS and torch, Python {platform.python_version()},"
        f" load average {load:.1f} before; {', '.join(found)}."
    )


def main(arguments: Sequence[str]) -> int:
    """Measure and write; return the exit status."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--short", action="store_true", help="learn no whole tasks, fit no ten million pairs, and print the rows alone"
    )
    parser.add_argument("--pykoopman", type=Path, metavar="PYTHON", help="an interpreter that has pykoopman")
    options = parser.parse_args(arguments)
    load = os.getloadavg()[0]
    # What is measured starts as on most machines, where Python keeps the bytecode of the start before.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="koopdqn-bench-") as folder:
        rows = []
        for row in measured(Path(folder), options.pykoopman, long=not options.short):
            print(line(row), file=sys.stderr, flush=True)
            rows.append(row)
    print(table(rows))
    if options.short:
        return 0
    about = machine(load)
    content = {"machine": about, "rows": [row.described() for row in rows]}
    DATA.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replaced(text, "performance", f"{about}\n\n{table(rows)}"), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
