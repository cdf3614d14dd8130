"""Reads demonstrations from files, HDF5 or CSV: one, several or a glob."""

import re
from collections.abc import Sequence
from pathlib import Path

from koopdqn.demonstrations.csv import read_csv
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations, Placement
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.errors import BadInputError

_CSV = (".csv", ".tsv", ".txt")


def files_of(sources: Sequence[str]) -> list[Path]:
    """Return the files of sources, paths or globs, in the given order; those of a glob in natural order.

    Raises:
        BadInputError: a glob matches nothing, or a file is named twice.
    """
    found: list[Path] = []
    for source in sources:
        named = str(Path(source).expanduser())
        # A file may have a bracket or an asterisk in its name.
        path = Path(named)
        if path.exists() or not any(sign in named for sign in "*?["):
            paths = [path]
        else:
            folder = Path(path.anchor or ".")
            paths = sorted(folder.glob(str(path.relative_to(path.anchor))), key=_natural)
            if not paths:
                raise BadInputError(f"demos: must name files, found none that match {source}")
        found += paths
    twice = sorted({str(path) for path in found if found.count(path) > 1})
    if twice:
        raise BadInputError(f"demos: must name every file once, found twice {twice[0]}")
    return found


def read_demonstrations(sources: Sequence[str], task: str, arm: str, any_task: bool = False) -> Demonstrations:
    """Return the demonstrations of all files of sources (:func:`files_of`), in their order.

    Files that end in .csv, .tsv or .txt are CSV, all others HDF5.

    Args:
        sources: paths or globs, at least one.
        task: name of their task; CSV files have none.
        arm: name of the arm for CSV files, which have none.
        any_task: whether HDF5 files of other tasks are accepted.

    Raises:
        BadInputError: a file is missing, damaged or of another task.
    """
    items: list[Demonstration] = []
    placements: dict[str, Placement | None] = {}
    for path in files_of(sources):
        if is_csv(path):
            items += read_csv(path)
            placements["none"] = None
            continue
        read = read_hdf5(path)
        if not any_task and read.task != task:
            raise BadInputError(f"demos {path}: must be of task {task}, found task {read.task}")
        items += read.items
        arm = read.arm
        placements["none" if read.placement is None else str(read.placement)] = read.placement
    if len(placements) > 1:
        raise BadInputError(f"demos: all files must have been moved alike, found {' and '.join(sorted(placements))}")
    return Demonstrations(task, arm, items, placement=next(iter(placements.values())))


def is_csv(path: Path) -> bool:
    """Return whether a file of demonstrations is read as CSV, by its ending."""
    return path.suffix.lower() in _CSV


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that puts demo_9 before demo_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", str(path))]
