"""A file to demonstrations: recognised, read, converted, and cut if that is asked for."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import h5py

from koopdqn.demonstrations.csv import ROTATIONS, read_csv
from koopdqn.demonstrations.dataset import Demonstration, Placement
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.demonstrations.recordings import datasets
from koopdqn.demonstrations.recordings.convert import converted
from koopdqn.demonstrations.recordings.cutting import Cut, motions_of
from koopdqn.demonstrations.recordings.declared import ImportSettings
from koopdqn.demonstrations.recordings.kinds import kind_of
from koopdqn.demonstrations.recordings.text import header_of
from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm

# More demonstrations than this in one file are a sign that rows were taken for demonstrations.
_MOST: Final = 10_000


@dataclass(frozen=True)
class Loaded:
    """What a file holds.

    Attributes:
        path: the file.
        kind: what kind of file it is, and why.
        reasons: what was taken for what, a line each; what holds for all demonstrations once.
        items: the demonstrations, uncut.
        motions: the motions in it where it is a single recording; none if its demonstrations are told apart.
        task: the task it names, or None. So is ``arm``.
        placement: how it says it was moved.
        own: whether the file says all of this itself, as koopdqn's own do.
    """

    path: Path
    kind: str
    reasons: tuple[str, ...]
    items: tuple[Demonstration, ...]
    motions: tuple[Cut, ...] = ()
    task: str | None = None
    arm: str | None = None
    placement: Placement | None = None
    own: bool = False

    def parts(self, cut: bool) -> tuple[Demonstration, ...]:
        """Return the demonstrations, cut into their motions, without ways back, if that is wanted."""
        if not cut or len(self.motions) < 2:
            return self.items
        return tuple(motion.item for motion in self.motions if motion.kept)


def load(path: Path, declared: ImportSettings, arm: Arm | None) -> Loaded:
    """Return what a file or a folder holds.

    koopdqn's own CSV and HDF5 are read as they stand; with something declared, CSV as any other text.

    Args:
        path: the file, or the folder of a ROS 2 bag or a LeRobot data set.
        declared: what it does not say.
        arm: gives the flange where only joints were recorded; None refuses those.

    Raises:
        BadInputError: it is of no kind that is read, is damaged, or something must be declared.
    """
    own = _own(path, declared)
    if own is not None:
        return own
    kind, why = kind_of(path)
    recordings = kind.read(path, declared, arm)
    if len(recordings) > _MOST:
        raise BadInputError(f"demos {path}: must hold at most {_MOST} demonstrations, found {len(recordings)}")
    done = [converted(each, declared, arm) for each in recordings]
    reasons = tuple(dict.fromkeys(line for each in done for line in each.reasons))
    items = tuple(each.item for each in done)
    return Loaded(path, f"{kind.name}, as {why}", reasons, items, _motions(items))


def _motions(items: tuple[Demonstration, ...]) -> tuple[Cut, ...]:
    return tuple(motions_of(items[0])) if len(items) == 1 else ()


def _own(path: Path, declared: ImportSettings) -> Loaded | None:
    """Return what koopdqn's own file holds; None if it is another's."""
    if not path.is_file():
        return None
    if _is_own_hdf5(path):
        read = read_hdf5(path)
        kind = "HDF5, as koopdqn writes it"
        return Loaded(path, kind, (), tuple(read.items), (), read.task, read.arm, read.placement, own=True)
    if declared.given() or not _is_own_csv(path):
        return None
    items = tuple(read_csv(path))
    return Loaded(path, "CSV, as koopdqn writes it", (), items, _motions(items) if declared.cut else (), own=True)


def _is_own_csv(path: Path) -> bool:
    names = set(header_of(path))
    return names >= {"t", "x", "y", "z"} and sum(names >= set(columns) for columns in ROTATIONS.values()) == 1


def _is_own_hdf5(path: Path) -> bool:
    if not datasets.recognise_hdf5(path):
        # What is named so and is none is told by the reader that misses most.
        return path.suffix.lower() in (".hdf5", ".h5")
    try:
        with h5py.File(path, "r") as file:
            data = file.get("data")
            return "frame" in data.attrs if isinstance(data, h5py.Group) else False
    except (OSError, RuntimeError, KeyError, ValueError):
        return True
