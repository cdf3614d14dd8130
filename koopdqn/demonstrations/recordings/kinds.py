"""Which kind of file it is: asked of every kind in turn, by what the file holds."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

from koopdqn.demonstrations.recordings import arrays, datasets, ros, text
from koopdqn.demonstrations.recordings.declared import ImportSettings
from koopdqn.demonstrations.recordings.recording import Recording
from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: for people.
        recognise: why a file is of this kind, or None.
        read: its recordings.
        library: the module that reads it, or None.
        extra: the extra of koopdqn that brings the library, or an empty text.
    """

    name: str
    recognise: Callable[[Path], str | None]
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


KINDS: Final = (
    Kind("ROS bag", ros.recognise, ros.read, "rosbags.highlevel", "ros"),
    Kind("HDF5", datasets.recognise_hdf5, lambda path, declared, _: datasets.read_hdf5(path, declared)),
    Kind(
        "Parquet",
        datasets.recognise_parquet,
        lambda path, declared, _: datasets.read_parquet(path, declared),
        "pyarrow.parquet",
        "lerobot",
    ),
    Kind("NumPy", arrays.recognise_numpy, lambda path, declared, _: arrays.read_numpy(path, declared)),
    Kind("MATLAB", arrays.recognise_matlab, lambda path, declared, _: arrays.read_matlab(path, declared), "scipy.io"),
    Kind("text", text.recognise, lambda path, declared, _: text.read(path, declared)),
)
"""The kinds, text last: it is what no other is."""

_PICKLES: Final = (".pkl", ".pickle", ".p", ".pt", ".pth", ".joblib", ".dill")


def kind_of(path: Path) -> tuple[Kind, str]:
    """Return the kind of a file or folder, and why it is of that kind.

    Raises:
        BadInputError: it is missing, is a pickle, or is of no kind that is read.
    """
    if not path.exists():
        raise BadInputError(f"demonstrations must be a file, found nothing at {path}")
    if path.is_file() and _is_pickle(path):
        raise BadInputError(f"demos {path}: {arrays.PICKLED}")
    for kind in KINDS:
        if path.is_dir() and kind.name not in ("ROS bag", "Parquet"):
            continue
        try:
            reason = kind.recognise(path)
        except OSError as error:
            raise BadInputError(f"demos {path} must be readable, the system says: {error.strerror or error}") from error
        if reason is not None:
            return kind, reason
    if path.is_dir():
        raise BadInputError(
            f"demonstrations must be a file, found something else at {path}: a folder that is neither a ROS 2 bag nor a"
            " LeRobot data set"
        )
    found = "something else" if path.stat().st_size else "an empty file"
    raise BadInputError(
        f"demonstrations must be a file of text, HDF5, npy, npz, MATLAB, Parquet, a ROS bag or MCAP, found {found}"
        f" at {path}"
    )


def _is_pickle(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(2)
    # PROTO and its number open every pickle since 2003.
    return path.suffix.lower() in _PICKLES or (
        head[:1] == b"\x80" and head[1:2] in b"\x02\x03\x04\x05" and len(head) == 2
    )
