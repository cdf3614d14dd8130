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
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.demonstrations.preprocess import on_straight_turn
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.recording import NOTHING
from koopdqn.errors import BadInputError
from koopdqn.files import read_json, write_json
from koopdqn.paths import hausdorff, mean_poses, to_count
from koopdqn.pose import Array

LEAST: Final = 3
"""Demonstrations of a set worth measuring: two to learn from and one held out."""
_SAMPLES: Final = 200


def sets_below(data: Path) -> dict[str, tuple[Demonstration, ...]]:
    """Return the sets below a folder by their names; what cannot be read is said.

    Raises:
        BadInputError: two sets have one name.
    """
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
                _add(found, f"{folder.name}-{path.stem}", items, path)
            else:
                single += items
        if len(single) >= LEAST:
            _add(found, folder.name, single, folder)
    return found


def _add(found: dict[str, tuple[Demonstration, ...]], name: str, items: Sequence[Demonstration], place: Path) -> None:
    if name in found:
        raise BadInputError(f"--data: sets must have different names, found {name} twice, once in {place}")
    found[name] = tuple(items)


def arranged(items: Sequence[Demonstration], held_out: int) -> Demonstrations:
    """Return a set with the demonstration held out at its end."""
    others = [item for index, item in enumerate(items) if index != held_out]
    return Demonstrations("demonstrated", "unknown", (*others, items[held_out]))


def beside(folder: Path, run: Path) -> dict[str, Any]:
    """Return how far movement primitives of the demonstrations are from the one held out, and keep it in the folder.

    Returns:
        ``placed``: whether the demonstrations were moved to where the arm can follow them; ``hausdorff_mm``: by the
        name of the primitive, which is given the start of the one held out and the mean of the others' ends; and
        :func:`turns`.
    """
    path = folder / "result.json"
    if not path.is_file():
        *shown, held_out = (to_count(item.poses, _SAMPLES) for item in read_hdf5(run / "demos.hdf5").items)
        goal = mean_poses(shown, _SAMPLES)[-1]
        found = {}
        for name in PRIMITIVES:
            way = learn(name, shown)(held_out[0], goal)
            found[name] = 1e3 * hausdorff(way[:, pose.POSITION], held_out[:, pose.POSITION])
        write_json(path, {"placed": run.name == "placed", "hausdorff_mm": found, **turns(shown, held_out)})
    content: dict[str, Any] = read_json(path, "the result")
    return content


def turns(shown: Sequence[Array], held_out: Array) -> dict[str, float]:
    """Return how near to the turn of a demonstration held out (N, 7) Table 1's can come, mean angles [°].

    Table 1 turns straight to the goal's orientation alone.

    Args:
        shown: the others (N, 7), whose ends' mean is the goal; all at the same shares of arc length.
        held_out: it begins the way.

    Returns:
        ``geodesic_deg``: of the nearest straight turn, at any time; ``mean_turn_deg``: of the one nearest to the mean
        of the others, at the same share of arc length, as anyone turns who has seen them alone.
    """
    mean = mean_poses(list(shown), len(held_out))
    wished = {"geodesic_deg": held_out, "mean_turn_deg": mean}
    made = {name: on_straight_turn(rows, held_out[0], mean[-1]) for name, rows in wished.items()}
    return {name: float(np.degrees(pose.rotation_distance(rows, held_out).mean())) for name, rows in made.items()}
