"""A file to demonstrations: recognised by what it holds, read, converted, and cut if that is asked for."""

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from koopdqn.confined import SECONDS, Content, confined
from koopdqn.demonstrations.csv import is_own
from koopdqn.demonstrations.dataset import Demonstration, Placement
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.demonstrations.recordings import arrays, datasets, ros, text
from koopdqn.demonstrations.recordings.convert import converted, of_one_unit
from koopdqn.demonstrations.recordings.cutting import Cut, cut_between, motions_of
from koopdqn.demonstrations.recordings.recording import ImportSettings, Recording
from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm

# More demonstrations than this in one file are a sign that rows were taken for demonstrations.
_MOST: Final = 10_000
_NUMBER: Final = r"\d+(?:\.\d+)?(?:e[+-]\d+)?"
MEASURED: Final = re.compile(rf"(?<=\(largest ){_NUMBER}(?=\))|{_NUMBER}(?=° apart)")
"""What a reason measured in one recording: the largest coordinate or angle, how far apart two orientations are."""
# A large file may take longer to read by this [bytes/s].
_READ_PER_SECOND: Final = 1 << 23


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: for people.
        read: its recordings.
        library: the module that reads it, or None.
        extra: the extra of koopdqn that brings the library, or an empty text.
    """

    name: str
    read: Callable[[Path, ImportSettings, Arm | None], list[Recording]]
    library: str | None = None
    extra: str = ""

    def load_library(self, path: Path) -> None:
        """Import the library, for the file in the message; BadInputError if its extra is missing."""
        if self.library is None:
            return
        try:
            import_module(self.library)
        except ImportError as error:
            name = self.library.partition(".")[0]
            raise BadInputError(
                f"demos {path}: must be read with {name}, found none; python -m pip install 'koopdqn[{self.extra}]'"
                " brings it"
            ) from error


_BAG: Final = Kind("ROS bag", ros.read, "rosbags.highlevel", "ros")
_HDF5: Final = Kind("HDF5", lambda path, declared, _: datasets.read_hdf5(path, declared))
_PARQUET: Final = Kind(
    "Parquet", lambda path, declared, _: datasets.read_parquet(path, declared), "pyarrow.parquet", "lerobot"
)
_NUMPY: Final = Kind("NumPy", lambda path, declared, _: arrays.read_numpy(path, declared))
_MATLAB: Final = Kind("MATLAB", lambda path, declared, _: arrays.read_matlab(path, declared), "scipy.io")
_TEXT: Final = Kind("text", lambda path, declared, _: text.read(path, declared))
KINDS: Final = (_BAG, _HDF5, _PARQUET, _NUMPY, _MATLAB, _TEXT)
"""The kinds of file."""

# Bytes at a place in a file that, with a suffix if it must have one, show its kind, and why. What shows none is text.
_SIGNS: Final = (
    (0, b"#ROSBAG V2.0", "", _BAG, "it begins as a ROS 1 bag"),
    (0, b"\x89MCAP0\r\n", "", _BAG, "it begins as MCAP"),
    (0, b"SQLite format 3\x00", ".db3", _BAG, "it is SQLite named .db3, as a ROS 2 bag"),
    (0, b"\x89HDF\r\n\x1a\n", "", _HDF5, "it begins as HDF5"),
    (512, b"\x89HDF\r\n\x1a\n", "", _HDF5, "it is HDF5 as MATLAB 7.3 writes it"),
    (0, b"PAR1", "", _PARQUET, "it begins as Parquet"),
    (0, b"\x93NUMPY", "", _NUMPY, "it begins as a NumPy array"),
    (0, b"PK\x03\x04", ".npz", _NUMPY, "it is a zip archive named .npz"),
    (0, b"MATLAB 5.0 MAT-file", "", _MATLAB, "it begins as a MATLAB 5 file"),
)
_PICKLES: Final = (".pkl", ".pickle", ".p", ".pt", ".pth", ".joblib", ".dill")
_STRUCTURED: Final = {".json": "JSON", ".yaml": "YAML", ".yml": "YAML"}
"""Text that is no table, such as exported trajectories."""


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

    A folder is a ROS 2 bag or a LeRobot data set. koopdqn's own HDF5 is read as it stands. All is read in a process of
    its own, bounded in time and memory (:mod:`koopdqn.confined`). The arm gives the flange where only joints were
    recorded; None refuses those.

    Raises:
        BadInputError: it is of no kind that is read, is damaged or too large, or something must be declared.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise BadInputError(f"demos {path}: must be a file or a folder, found a pipe or a device")
    head = _head_of(path) if path.is_file() else b""
    if path.is_file() and _is_own_hdf5(path, head):
        read = read_hdf5(path)
        kind, items = "HDF5, as koopdqn writes it", tuple(read.items)
        motions = tuple(motions_of(items[0])) if declared.cut and len(items) == 1 else ()
        return Loaded(path, kind, (), items, motions, read.task, read.arm, read.placement, own=True)
    found, why = _kind_of(path, head)
    # Here, so that it need not be loaded again for the next file.
    found.load_library(path)
    own = found is _TEXT and not declared.given() and is_own(text.header_of(head))
    # Our own tell demonstrations apart: a rest within one is no end.
    cut = declared.cut is True or not own
    about, numbers = _bounded(path, lambda: _read(path, found, declared, arm, cut))
    if own:
        return Loaded(path, "CSV, as koopdqn writes it", (), *_unpacked(about, numbers), own=True)
    return Loaded(path, f"{found.name}, as {why}", tuple(about["reasons"]), *_unpacked(about, numbers))


def _head_of(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(text.HEAD)
    except OSError as error:
        raise BadInputError(f"demos {path} must be readable, the system says: {error.strerror or error}") from error


def _kind_of(path: Path, head: bytes) -> tuple[Kind, str]:
    """Return the kind of a file that begins with some bytes, or of a folder, and why it is of that kind."""
    if not path.exists():
        raise BadInputError(f"demonstrations must be a file, found nothing at {path}")
    if path.is_dir():
        if (path / "metadata.yaml").is_file():
            return _BAG, "it holds metadata.yaml, as a ROS 2 bag"
        if (path / datasets.INFO).is_file():
            return _PARQUET, "it holds meta/info.json, as a LeRobot data set"
        raise BadInputError(
            f"demonstrations must be a file, found something else at {path}: a folder that is neither a ROS 2 bag nor a"
            " LeRobot data set"
        )
    # PROTO and its number open every pickle since 2003.
    if path.suffix.lower() in _PICKLES or (head[:1] == b"\x80" and head[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05")):
        raise BadInputError(f"demos {path}: {arrays.PICKLED}")
    for place, sign, suffix, kind, why in _SIGNS:
        if head[place:].startswith(sign) and suffix in ("", path.suffix.lower()):
            return kind, why
    structured = _STRUCTURED.get(path.suffix.lower())
    if text.is_text(head) and structured is None:
        return _TEXT, "it is text"
    found = (structured or "something else") if head else "an empty file"
    raise BadInputError(
        f"demonstrations must be a table in text, HDF5, npy, npz, MATLAB, Parquet, a ROS bag or MCAP, found {found} at"
        f" {path}"
    )


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
    """Return demonstrations, and the motions of a single one if it is to be cut, in the form that leaves a process."""
    recordings = kind.read(path, declared, arm)
    if len(recordings) > _MOST:
        raise BadInputError(f"demos {path}: must hold at most {_MOST} demonstrations, found {len(recordings)}")
    done = [converted(each, declared, arm) for each in of_one_unit(recordings)]
    items = [item for item, _ in done]
    motions = motions_of(items[0]) if cut and len(items) == 1 else []
    about = {
        "reasons": _alike_once(line for _, reasons in done for line in reasons),
        "joints": [item.joints is not None for item in items],
        "motions": [(motion.begin, motion.end, motion.kept, motion.why) for motion in motions],
    }
    parts = ((item.times, item.poses, item.joints) for item in items)
    return about, [values for part in parts for values in part if values is not None]


def _alike_once(lines: Iterable[str]) -> list[str]:
    """Return lines once each; of those that differ in what was measured alone, that of the largest."""
    found: dict[str, list[str]] = {}
    for line in lines:
        found.setdefault(MEASURED.sub("", line), []).append(line)
    return [max(alike, key=lambda line: [float(each) for each in MEASURED.findall(line)]) for alike in found.values()]


def _unpacked(about: Any, arrays: list[np.ndarray]) -> tuple[tuple[Demonstration, ...], tuple[Cut, ...]]:
    every = iter(arrays)
    items = tuple(
        Demonstration(next(every), next(every), next(every) if joints else None) for joints in about["joints"]
    )
    return items, tuple(cut_between(items[0], *motion) for motion in about["motions"])


def _is_own_hdf5(path: Path, head: bytes) -> bool:
    if not any(head[place:].startswith(sign) for place, sign, _, kind, _ in _SIGNS if kind is _HDF5):
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
