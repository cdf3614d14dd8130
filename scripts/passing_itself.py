"""Drawn paths that pass themselves, learned with and without unfolding; the table of docs/demonstrations.md.

    scripts/passing_itself.py FOLDER [SHAPE ...]

Of each shape seven demonstrations are drawn, waved aside by 5 mm, of which the last is held out. A line of the table is
printed a shape; what FOLDER holds already is not made again, and a training that was stopped goes on.
"""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.app.exit_status import guard
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError, WorkFailedError, unknown_name
from koopdqn.paths import arc_lengths, at_arc_lengths
from koopdqn.tasks.unfolding import Unfolding

# Points that a spline passes, sideways and up, and out of the plane where there is a third; 0.2 m wide when drawn.
SHAPES: Final[dict[str, list[tuple[float, ...]]]] = {
    "fish": [(8, 3), (3, 0.5), (-3, -2.5), (-7, 0), (-3, 2.5), (3, -0.5), (8, -3)],
    "figure eight": [(-4, 3), (-7, 0), (-4, -3), (0, 0), (4, 3), (7, 0), (4, -3), (0, 0), (-2, 1.2)],
    "two loops": [
        *[(-12, 0), (-6, 0), (-2, 3), (-5, 6), (-8, 3), (-4, 0)],
        *[(2, 0), (8, 0), (11, 3), (8, 6), (5, 3), (9, 0), (14, 0)],
    ],
    "pretzel": [(-5, 7), (-1, 1), (4, -2), (7, 2), (4, 5), (0, 3), (-4, 5), (-7, 2), (-4, -2), (1, 1), (5, 7)],
    "loop in space": [(-9, 0, 0), (-3, 0, 1), (2, 2, 2), (2, 6, 4), (-2, 6, 5), (-2, 2, 6), (3, 0, 7), (9, 0, 8)],
    "loop with a turn": [(-9, 0), (-3, 0), (2, 2), (3, 5), (0, 7), (-3, 5), (-2, 2), (3, 0), (9, 0)],
    "straight": [(-8, 0), (-3, 1), (3, 1), (8, 0)],
    "drawer": [(0, 0), (5, 0), (10, 0), (5, 0), (3, 0)],
    "hole": [(-6, 5), (-2, 5), (0, 3), (0, -1), (0, -5), (0, -1), (0.3, 3), (3, 6)],
    "hole with a turn": [(-7, 3), (-2, 4), (0, 1), (0.2, -5), (0, 1), (2, 4), (6, 4)],
    "four strokes": [(-7, 0), (0, 0.2), (7, 0), (0, -0.2), (-7, 0), (0, 0.2), (7, 0), (0, -0.2), (-5, 0)],
    "ring": [(0, 0), (4, -1.5), (7, 2), (4, 6), (0, 5), (-2, 2), (0, 0)],
    "through its goal": [(-9, -2), (-4, -1), (0, 0), (3, 3), (0, 6), (-3, 3), (0, 0)],
    "cursive ee": [
        *[(0, 0), (4, 2), (5, 4.5), (4, 6), (3, 4), (4.5, 0.5)],
        *[(8, 2), (9, 4.5), (8, 6), (7, 4), (8.5, 0.5), (12, 1.5)],
    ],
}
_WIDE_M, _WAVED_M, _COUNT, _POINTS, _SECONDS = 0.2, 0.005, 7, 300, 6.0
_DOWN: Final = np.array([0.70710678, 0.0, 0.70710678, 0.0])
_WITH, _WITHOUT = "--unfolded", "--plain"
_TURNED_RAD: Final = {"loop with a turn": np.radians(60), "hole with a turn": np.radians(60)}


def drawn(name: str, rng: np.random.Generator) -> Demonstrations:
    """Return demonstrations of a shape."""
    points = np.array([(*each, 0.0)[:3] for each in SHAPES[name]])
    arc = np.append(0.0, np.cumsum(np.sqrt(pose.norm(np.diff(points, axis=0)))))
    fine = CubicSpline(arc, points)(np.linspace(0.0, arc[-1], 2000))
    way = arc_lengths(fine)
    line = at_arc_lengths(fine, way, np.linspace(0.0, way[-1], _POINTS))
    line = (line - line[-1]) * _WIDE_M / np.ptp(line, axis=0).max()
    # Sideways, up and out of the plane are y, z and x of the arm.
    line = np.array([0.45, 0.0, 0.35]) + line[:, [2, 0, 1]]
    turn = _TURNED_RAD.get(name, 0.0) * np.linspace(1.0, 0.0, _POINTS)
    quaternion = pose.multiply(_DOWN, pose.from_rotation_vector(turn[:, None] * [0.0, 0.0, 1.0]))
    items = []
    for _ in range(_COUNT):
        wave = gaussian_filter1d(rng.normal(size=(3 * _POINTS, 3)), 60, axis=0)[_POINTS : 2 * _POINTS]
        wave *= _WAVED_M / wave.std() * np.minimum(1.0, np.linspace(3.0, 0.0, _POINTS))[:, None]
        items.append(Demonstration(np.linspace(0.0, _SECONDS, _POINTS), pose.make(line + wave, quaternion)))
    return Demonstrations("drawn", "UR5", items)


def learned(demos: Path, folder: Path, seed: int, *, unfolded: bool) -> dict[str, Any] | None:
    """Return ``eval.json`` of a training on demonstrations, with its ``train.json``, made if it is not there.

    None if they are refused.

    Raises:
        WorkFailedError: a command did not come to a result.
    """
    run, measured = folder / "train", folder / "eval"
    if not (measured / "eval.json").is_file():
        if not (run / "train.json").is_file():
            given = ["task=demonstrated", f"demos={demos}", "task.holdout=1", f"seed={seed}", f"out={run}"]
            begun = (run / ".hydra").is_dir()
            status = _command(["train", *([f"run={run}"] if begun else given)], unfolded=unfolded)
            if status == BadInputError.exit_status and not begun:
                shutil.rmtree(run, ignore_errors=True)
                return None
            if not (run / "train.json").is_file():
                raise WorkFailedError(f"{run}: the training ended with exit status {status}")
        shutil.rmtree(measured, ignore_errors=True)
        if status := _command(["eval", f"run={run}", f"out={measured}", "eval.dynamics=false"], unfolded=unfolded):
            raise WorkFailedError(f"{measured}: the evaluation ended with exit status {status}")
    report: dict[str, Any] = json.loads((measured / "eval.json").read_text())
    return {**report, "train": json.loads((run / "train.json").read_text())}


def _command(words: list[str], *, unfolded: bool) -> int:
    call = [sys.executable, __file__, _WITH if unfolded else _WITHOUT, *words]
    return subprocess.run(call, stdout=subprocess.DEVNULL, check=False).returncode


def main(folder: Path, names: list[str]) -> int:
    """Measure shapes and print a line of the table each.

    Raises:
        BadInputError: a shape is not known.
        WorkFailedError: see :func:`learned`.
    """
    for name in names:
        if name not in SHAPES:
            raise unknown_name("shape", name, SHAPES)
    for number, name in enumerate(SHAPES):
        demos = folder / f"{name.replace(' ', '-')}.hdf5"
        if names and name not in names:
            continue
        if not demos.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            write_hdf5(demos, drawn(name, np.random.default_rng([2000, number])))
        cells, replayed = [name], "–"
        for unfolded in (True, False):
            kept = folder / demos.stem / ("unfolded" if unfolded else "plain")
            report = learned(demos, kept, 2000 + number, unfolded=unfolded)
            if report is None:
                cells += ["refused", "–"]
                continue
            away = report["holdout"]["hausdorff_mm"]
            cells += [f"{100 * report['success_rate']:.0f}", f"{away['policy'][0]:.1f}"]
            if unfolded:
                cells.append(f"{report['train']['seconds']:.0f}")
                replayed = f"{away['nearest_demonstration'][0]:.1f}"
        cells.append(replayed)
        print("| " + " | ".join(cells) + " |", flush=True)
    return 0


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    if sys.argv[1] == _WITHOUT:
        # What a path that does not pass itself gets.
        Unfolding.of = classmethod(lambda *_: None)  # type: ignore[assignment, method-assign]
    if sys.argv[1] in (_WITH, _WITHOUT):
        sys.exit(cli.main(sys.argv[2:]))
    sys.exit(guard(lambda: main(Path(sys.argv[1]), sys.argv[2:]), debug=False))
