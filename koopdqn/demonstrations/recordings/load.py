"""A file to demonstrations: recognised, read, converted, and cut if that is asked for."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from koopdqn.confined import SECONDS, Content, confined
from koopdqn.demonstrations.csv import is_own
from koopdqn.demonstrations.dataset import Demonstration, Placement
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.demonstrations.recordings import datasets
from koopdqn.demonstrations.recordings.convert import converted
from koopdqn.demonstrations.recordings.cutting import Cut, cut_between, motions_of
from koopdqn.demonstrations.recordings.declared import ImportSettings
from koopdqn.demonstrations.recordings.kinds import Kind, kind_of
from koopdqn.demonstrations.recordings.text import header_of
from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm

# More demonstrations than this in one file are a sign that rows were taken for demonstrations.
_MOST: Final = 10_000
# A large file may take longer to read by this [bytes/s].
_READ_PER_SECOND: Final = 1 << 23


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

    koopdqn's own HDF5 is read as it stands. All is read in a process of its own, bounded in time and memory
    (:mod:`koopdqn.confined`).

    Args:
        path: the file, or the folder of a ROS 2 bag or a LeRobot data set.
        declared: what it does not say.
        arm: gives the flange where only joints were recorded; None refuses those.

    Raises:
        BadInputError: it is of no kind that is read, is damaged or too large, or something must be declared.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise BadInputError(f"demos {path}: must be a file or a folder, found a pipe or a device")
    if path.is_file() and _is_own_hdf5(path):
        read = read_hdf5(path)
        kind, items = "HDF5, as koopdqn writes it", tuple(read.items)
        motions = tuple(motions_of(items[0])) if declared.cut and len(items) == 1 else ()
        return Loaded(path, kind, (), items, motions, read.task, read.arm, read.placement, own=True)
    found, why = kind_of(path)
    # Here, so that it need not be loaded again for the next file.
    found.load_library(path)
    own = found.name == "text" and not declared.given() and is_own(header_of(path))
    # Our own tell demonstrations apart: a rest within one is no end.
    cut = declared.cut is True or not own
    about, arrays = _bounded(path, lambda: _read(path, found, declared, arm, cut))
    if own:
        return Loaded(path, "CSV, as koopdqn writes it", (), *_unpacked(about, arrays), own=True)
    return Loaded(path, f"{found.name}, as {why}", tuple(about["reasons"]), *_unpacked(about, arrays))


def _bounded(path: Path, read: Callable[[], Content]) -> Content:
    try:
        return confined(read, SECONDS + _size_of(path) / _READ_PER_SECOND)
    except BadInputError as error:
        if str(path) in str(error):
            raise
        raise BadInputError(f"demos {path}: {error}") from error


def _size_of(path: Path) -> int:
    """Return the bytes of a file, or of the files in a folder and those below it."""
    if path.is_file():
        return path.stat().st_size
    return sum((Path(folder) / name).lstat().st_size for folder, _, names in os.walk(path) for name in names)


def _read(path: Path, kind: Kind, declared: ImportSettings, arm: Arm | None, cut: bool) -> Content:
    recordings = kind.read(path, declared, arm)
    if len(recordings) > _MOST:
        raise BadInputError(f"demos {path}: must hold at most {_MOST} demonstrations, found {len(recordings)}")
    done = [converted(each, declared, arm) for each in recordings]
    reasons = tuple(dict.fromkeys(line for each in done for line in each.reasons))
    return _packed(tuple(each.item for each in done), reasons, cut)


def _packed(items: tuple[Demonstration, ...], reasons: tuple[str, ...], cut: bool) -> Content:
    """Return demonstrations, and the motions of a single one if it is to be cut, in the form that leaves a process."""
    motions = motions_of(items[0]) if cut and len(items) == 1 else []
    about = {
        "reasons": reasons,
        "joints": [item.joints is not None for item in items],
        "motions": [(motion.begin, motion.end, motion.kept, motion.why) for motion in motions],
    }
    parts = ((item.times, item.poses, item.joints) for item in items)
    return about, [values for part in parts for values in part if values is not None]


def _unpacked(about: Any, arrays: list[np.ndarray]) -> tuple[tuple[Demonstration, ...], tuple[Cut, ...]]:
    every = iter(arrays)
    items = tuple(
        Demonstration(next(every), next(every), next(every) if joints else None) for joints in about["joints"]
    )
    return items, tuple(cut_between(items[0], *motion) for motion in about["motions"])


def _is_own_hdf5(path: Path) -> bool:
    if not datasets.recognise_hdf5(path):
        # What is named so and is none is told by the reader that misses most.
        return path.suffix.lower() in (".hdf5", ".h5")

    def says_frame() -> Content:
        try:
            with h5py.File(path, "r") as file:
                data = file.get("data")
                return isinstance(data, h5py.Group) and "frame" in data.attrs, []
        except (OSError, RuntimeError, KeyError, ValueError):
            return True, []

    return bool(_bounded(path, says_frame)[0])
