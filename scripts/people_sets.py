"""Motions of people: sets of demonstrations of one motion below a folder, one of which at a time is held out.

A set is a CSV file of several demonstrations, or a folder of files of one each (CSV, or what ``rostopic echo -p``
prints), of at least three.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from imitation.primitives import PRIMITIVES, learn

from koopdqn import console, pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.demonstrations.recordings.declared import NOTHING
from koopdqn.demonstrations.recordings.load import load
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json
from koopdqn.paths import hausdorff, mean_poses, to_count

LEAST: Final = 3
"""Demonstrations of a set worth measuring: two to learn from and one held out."""
_SAMPLES: Final = 200


def sets_below(data: Path) -> dict[str, tuple[Demonstration, ...]]:
    """Return the sets below a folder by their names; what cannot be read is said."""
    found: dict[str, tuple[Demonstration, ...]] = {}
    for folder in sorted({path.parent for path in data.rglob("*") if path.suffix in (".csv", ".txt")}):
        single: list[Demonstration] = []
        for path in sorted(path for path in folder.iterdir() if path.suffix in (".csv", ".txt")):
            try:
                items = load(path, NOTHING, None).items
            except BadInputError as error:
                console.note(f"left out: {error}")
                continue
            if len(items) >= LEAST:
                found[f"{folder.name}-{path.stem}"] = tuple(items)
            else:
                single += items
        if len(single) >= LEAST:
            found[folder.name] = tuple(single)
    return found


def write(items: Sequence[Demonstration], held_out: int, path: Path) -> None:
    """Write a set with the demonstration held out at its end, unless the file is there."""
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        others = [item for index, item in enumerate(items) if index != held_out]
        write_hdf5(path, Demonstrations("demonstrated", "unknown", (*others, items[held_out])))


def beside(folder: Path, run: Path) -> dict[str, Any]:
    """Return how far movement primitives of the demonstrations are from the one held out, and keep it in the folder.

    Returns:
        ``placed``: whether the demonstrations were moved to where the arm can follow them; ``hausdorff_mm``: by the
        name of the primitive, which is given the start of the one held out and the mean of the others' ends;
        ``geodesic_deg``: the mean angle of the one held out to the nearest turn on the way from its start's straight to
        the goal's, the only way that Table 1 turns.
    """
    path = folder / "result.json"
    if not path.is_file():
        *shown, held_out = (to_count(item.poses, _SAMPLES) for item in read_hdf5(run / "demos.hdf5").items)
        goal = mean_poses(shown, _SAMPLES)[-1]
        found = {}
        for name in PRIMITIVES:
            way = learn(name, shown)(held_out[0], goal)
            found[name] = 1e3 * hausdorff(way[:, pose.POSITION], held_out[:, pose.POSITION])
        straight = np.linspace(0.0, float(pose.rotation_distance(held_out[0], goal)), _SAMPLES)
        turns = pose.make(goal[:3], pose.turned_toward(held_out[0, pose.QUATERNION], goal[pose.QUATERNION], straight))
        off = np.degrees(pose.rotation_distance(held_out[:, None], turns[None]).min(axis=1).mean())
        write_json(path, {"placed": run.name == "placed", "hausdorff_mm": found, "geodesic_deg": float(off)})
    content: dict[str, Any] = read_json(path, "the result")
    return content
