"""Measure koopdqn on motions of people: each demonstration held out in turn, beside what does the same for free.

    python scripts/people.py --data ../shared/data --out runs/people

Every set of at least three demonstrations below the data folder is taken: a CSV file of several, or a folder of files
of one each (CSV, or what ``rostopic echo -p`` prints). A run that is finished is not made again.
"""

import argparse
import csv
import json
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import measured_runs
import numpy as np
from primitives import PRIMITIVES, learn
from rich import box
from rich.table import Table

from koopdqn import console, pose
from koopdqn.demonstrations.csv import read_csv
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.paths import mean_poses, to_count
from koopdqn.pose import Array

LEAST = 3
"""Demonstrations of a set worth measuring: two to learn from and one held out."""
METHODS = {
    "policy": "policy",
    "greedy": "greedy",
    "nearest_velocity": "velocity",
    "mean_pursuit": "pursuit",
    "nearest_demonstration": "replay",
    "dmp": "DMP",
    "promp": "ProMP",
}
"""What is compared, by its key in a result, and what its column is called."""
_TURNING = [method for method in METHODS if method not in PRIMITIVES]
_LEARNING = ("folds", "learned", "success", "seconds", "asked", "right")
_SAMPLES = 200
_NANOSECONDS = 1e-9


@dataclass(frozen=True)
class PeopleSet:
    """Demonstrations of one motion.

    Attributes:
        name: of the set and of its folder.
        items: the demonstrations.
    """

    name: str
    items: tuple[Demonstration, ...]


def sets_below(data: Path) -> list[PeopleSet]:
    """Return the sets of at least :data:`LEAST` demonstrations below a folder; what cannot be read is said."""
    found = []
    for folder in sorted({path.parent for path in data.rglob("*") if path.suffix in (".csv", ".txt")}):
        single: list[Demonstration] = []
        for path in sorted(folder.iterdir()):
            if path.suffix not in (".csv", ".txt"):
                continue
            try:
                items = _rostopic(path) if path.suffix == ".txt" else read_csv(path)
            except BadInputError as error:
                console.note(f"left out: {error}")
                continue
            if len(items) >= LEAST:
                found.append(PeopleSet(f"{folder.name}-{path.stem}", tuple(items)))
            else:
                single += items
        if len(single) >= LEAST:
            found.append(PeopleSet(folder.name, tuple(single)))
    return found


def _rostopic(path: Path) -> list[Demonstration]:
    """Return the one demonstration of what ``rostopic echo -p`` printed: nanoseconds, quaternions x y z w."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows or "%time" not in rows[0]:
        raise BadInputError(f"{path}: must have a column %time, found {sorted(rows[0]) if rows else 'no rows'}")
    before = next((name.removesuffix("position.x") for name in rows[0] if name.endswith("position.x")), None)
    if before is None:
        raise BadInputError(f"{path}: must have a column that ends in position.x, found {sorted(rows[0])}")
    columns = [f"{before}position.{axis}" for axis in "xyz"] + [f"{before}orientation.{axis}" for axis in "wxyz"]
    times = np.array([int(row["%time"]) for row in rows])
    poses = np.array([[float(row[name]) for name in columns] for row in rows])
    new = np.concatenate([[True], np.diff(times) > 0])
    return [Demonstration((times[new] - times[0]) * _NANOSECONDS, poses[new])]


def measure(people: PeopleSet, held_out: int, folder: Path, seed: int) -> dict[str, Any]:
    """Return what one fold came to: trained and evaluated in a folder, or as was found there."""
    result = folder / "result.json"
    if result.is_file():
        return dict(json.loads(result.read_text()))
    # What was begun and not finished would be taken for a run that the arm cannot follow.
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    others = tuple(item for index, item in enumerate(people.items) if index != held_out)
    shown = folder / "shown.hdf5"
    write_hdf5(shown, Demonstrations("demonstrated", "unknown", (*others, people.items[held_out])))
    log, run, placed = folder / "log.txt", folder / "run", False
    given = [f"demos={shown}", "task=demonstrated", "task.holdout=1", f"seed={seed}"]
    status = measured_runs.launch("train", [*given, f"out={run}"], log)
    if status == 2:
        placed, run = True, folder / "placed"
        status = measured_runs.launch("train", [*given, "demos.place=auto", f"out={run}"], log)
    if status not in (0, 1):
        return {"set": people.name, "held_out": held_out, "placed": placed, "failed": _last_line(log)}
    measured = folder / "eval"
    if measured_runs.launch("eval", [f"run={run}", "eval.dynamics=false", f"out={measured}"], log):
        return {"set": people.name, "held_out": held_out, "placed": placed, "failed": _last_line(log)}
    train, report = (json.loads(path.read_text()) for path in (run / "train.json", measured / "eval.json"))
    content = {"set": people.name, "held_out": held_out, "placed": placed, **_figures(train, report, run)}
    result.write_text(json.dumps(content, indent=1))
    return content


def _figures(train: dict[str, Any], report: dict[str, Any], run: Path) -> dict[str, Any]:
    held = report["holdout"]
    beside = {"policy": held["policy"], **held["baselines"]}
    kept = read_hdf5(run / "demos.hdf5")
    *others, last = (to_count(item.poses, _SAMPLES) for item in kept.items)
    apart = {name: float(values[0]) for name, values in held["hausdorff_mm"].items()}
    return {
        "learned": train["learned"],
        "seconds": train["seconds"],
        "questions": train["oracle_queries"],
        "trusted_right": train["reward_agreement"]["trusted"],
        "success_rate": report["success_rate"],
        "final_rotation_error_deg": report["final_rotation_error_deg"]["max"],
        "hausdorff_mm": {**apart, **_primitives(others, last)},
        "rotation_deviation_deg": {name: method["rotation_deviation_deg"]["mean"] for name, method in beside.items()},
    }


def _primitives(shown: Sequence[Array], held_out: Array) -> dict[str, float]:
    """Return the Hausdorff distance [mm] of movement primitives of poses (N, 7), from start and to goal given."""
    from koopdqn.paths import hausdorff

    goal, found = mean_poses(list(shown), len(shown[0]))[-1], {}
    for name in PRIMITIVES:
        path = learn(name, shown)(held_out[0], goal)
        found[name] = 1e3 * hausdorff(path[:, pose.POSITION], held_out[:, pose.POSITION])
    return found


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text().splitlines() if line.strip()]
    return lines[-1] if lines else "nothing was printed"


def tables(results: list[dict[str, Any]]) -> tuple[Table, ...]:
    """Return what learning took, and how far and how turned every method is from what was held out: a row a set."""
    learning = _table("Each demonstration held out in turn; medians over folds, the least success", _LEARNING)
    apart = _table("Hausdorff distance from the one held out in mm", METHODS.values())
    turned = _table("Mean turn off the one held out in °", [METHODS[method] for method in _TURNING])
    for name in dict.fromkeys(result["set"] for result in results):
        rows = [result for result in results if result["set"] == name]
        done = [result for result in rows if "failed" not in result]
        if not done:
            learning.add_row(name, f"0/{len(rows)}")
            continue
        label = name + (" (placed)" if any(row["placed"] for row in done) else "")
        learning.add_row(
            label,
            f"{len(done)}/{len(rows)}",
            f"{sum(row['learned'] for row in done)}",
            f"{min(row['success_rate'] for row in done):.0%}",
            f"{_median([row['seconds'] for row in done]):.0f}",
            f"{_median([row['questions'] for row in done]):.0f}",
            f"{_median([row['trusted_right'] for row in done]):.1%}",
        )
        for found, key, methods in ((apart, "hausdorff_mm", METHODS), (turned, "rotation_deviation_deg", _TURNING)):
            medians = [_median([row[key][method] for row in done]) for method in methods]
            found.add_row(label, *(f"{value:.1f}" for value in medians))
    return learning, apart, turned


def _table(title: str, headings: Iterable[str]) -> Table:
    found = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    found.add_column("set")
    for heading in headings:
        found.add_column(heading, justify="right", no_wrap=True)
    return found


def _median(values: list[float | None]) -> float:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else float("nan")


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure all sets and print the tables; also written to ``people.json`` in the output folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="folder of the sets")
    parser.add_argument("--out", type=Path, default=Path("runs/people"), help="folder of the runs")
    parser.add_argument("--sets", nargs="*", default=[], help="names of sets; default: all")
    parser.add_argument("--folds", type=int, default=None, help="demonstrations held out; default: each")
    parser.add_argument("--seed", type=int, default=100)
    given = parser.parse_args(arguments)
    known = {people.name: people for people in sets_below(given.data)}
    unknown = sorted(set(given.sets) - set(known))
    if unknown or not known:
        console.fail(f"--sets: must be among {', '.join(known) or 'none found'}, found {', '.join(unknown) or 'none'}")
        return 2
    results = []
    for people in (known[name] for name in (given.sets or known)):
        for held_out in range(len(people.items))[: given.folds]:
            results.append(measure(people, held_out, given.out / people.name / f"held-out-{held_out}", given.seed))
            last = results[-1]
            said = last.get("failed") or f"success {last['success_rate']:.0%}, {last['seconds']:.0f} s"
            console.note(f"{people.name}, held out {held_out}: {said}")
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "people.json").write_text(json.dumps(results, indent=1))
    for found in tables(results):
        console.say(found)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
