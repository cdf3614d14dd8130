"""Demonstration files in CSV, one sample a row."""

import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.files import write_text
from koopdqn.pose import Array
from koopdqn.settings import Settings, shown

_SEPARATORS = (",", ";", "\t")
_COMMENT = "#"


# Reading takes some ten times as much memory.
_LARGEST = 2**27
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Table:
    """The content of a CSV file.

    Attributes:
        path: the file.
        names: of the columns, in lower case.
        rows: the text of each row, (N,).
        lines: (N,) line of each row in the file, from 1.
        separator: what stands between cells; None for any blanks.
        quoted: whether quotes may hold separators.
    """

    path: Path
    names: list[str]
    rows: list[str]
    lines: np.ndarray
    separator: str | None
    quoted: bool

    def __len__(self) -> int:
        """Return the number of rows below the header."""
        return len(self.lines)

    def column(self, name: str) -> list[str]:
        """Return a column's texts (N,), without blanks around them."""
        place = self.names.index(name)
        if self.quoted:
            return [_split(row, self.separator)[place].strip() for row in self.rows]
        return [row.split(self.separator, place + 1)[place].strip() for row in self.rows]

    def numbers(self, names: Sequence[str]) -> Array:
        """Return columns as numbers (N, columns).

        Raises:
            BadInputError: a cell is no finite number.
        """
        places = [self.names.index(name) for name in names]
        try:
            values = np.loadtxt(
                self.rows, delimiter=self.separator, usecols=places, comments=None, quotechar='"', ndmin=2
            )
        except ValueError:
            values = np.array([[_number(cell) for cell in self.column(name)] for name in names]).T
        for column, row in np.argwhere(~np.isfinite(values.T))[:1]:
            raise BadInputError(
                f"demonstrations {self.path}: line {self.lines[row]}: {names[column]} must be a finite number,"
                f" found {shown(self.column(names[column])[row])}"
            )
        return values


def read_table(path: Path) -> Table:
    """Read a CSV file: a header line of column names, then one row a line.

    The separator is the first of comma, semicolon, tab and blank that the header contains. Blanks around names and
    cells, the case of names, empty lines and lines that begin with # are ignored. With a separator other than the comma
    a decimal comma is read as a point.

    Raises:
        BadInputError: the file is missing, is too large or no text, has no header, a name occurs twice, or a row has
            another number of cells than the header.
    """
    text = _text(path)
    quoted = '"' in text
    everything = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    said = [i for i, line in enumerate(everything) if line.strip(" \t,;")]
    if _COMMENT in text:
        said = [i for i in said if not everything[i].lstrip().startswith(_COMMENT)]
    if not said:
        raise BadInputError(f"demonstrations {path}: must hold a header line and samples, found an empty file")
    header, *rows = (everything[index] for index in said)
    lines = np.array(said[1:], dtype=int) + 1
    separator = next((each for each in _SEPARATORS if each in header), None)
    if separator != ",":
        # One within a cell is a decimal comma.
        rows = [row.replace(",", ".") for row in rows]
    try:
        names = [name.strip().lower() for name in _split(header, separator)]
        if quoted or separator is None:
            counts = np.array([len(_split(row, separator)) for row in rows], dtype=int)
        else:
            counts = np.array([row.count(separator) for row in rows], dtype=int) + 1
    except csv.Error as error:
        raise BadInputError(f"demonstrations {path}: must be CSV text, found: {error}") from error
    twice = sorted(name for name, count in Counter(names).items() if name and count > 1)
    if twice:
        raise BadInputError(f"demonstrations {path}: every column must have its own name, found two named {twice[0]}")
    for index in np.flatnonzero(counts != len(names)):
        # Some loggers end every row with a separator.
        if counts[index] != len(names) + 1 or _split(rows[index], separator)[-1].strip():
            raise BadInputError(
                f"demonstrations {path}: line {lines[index]} must have {len(names)} cells as the header,"
                f" found {counts[index]}"
            )
    return Table(path, names, rows, lines, separator, quoted)


def _text(path: Path) -> str:
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise BadInputError(f"demonstrations must be a file, found {found} at {path}")
    size = path.stat().st_size
    if size > _LARGEST:
        raise BadInputError(f"demonstrations {path}: must hold at most {_LARGEST} bytes, found {size}")
    content = path.read_bytes()
    # Spreadsheets write UTF-16 with a byte order mark.
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise BadInputError(f"demonstrations {path}: must be CSV text in UTF-8, found another encoding") from error
    if "\0" in text:
        raise BadInputError(f"demonstrations {path}: must be CSV text in UTF-8, found binary content")
    return text


def _split(line: str, separator: str | None) -> list[str]:
    if separator is not None and '"' in line:
        return next(csv.reader([line], delimiter=separator))
    return line.split(separator)


def _number(cell: str) -> float:
    return float(cell) if _NUMBER.fullmatch(cell) else float("nan")


Rotation = Literal["quaternion", "vector", "angles"]
"""Orientation in a CSV file: unit quaternion, rotation vector, or roll, pitch and yaw."""

ROTATIONS: Final[dict[Rotation, tuple[str, ...]]] = {
    "quaternion": ("qw", "qx", "qy", "qz"),
    "vector": ("rx", "ry", "rz"),
    "angles": ("roll", "pitch", "yaw"),
}
"""The columns of each, angles in radians."""


class ExportSettings(Settings):
    """How demonstrations are written as CSV."""

    rotation: Rotation = Field(description="unit quaternion, rotation vector, or roll, pitch and yaw")


_POSITION = ("x", "y", "z")
_TIME, _DEMONSTRATION = "t", "demo"
# Rounding to three decimals changes a quaternion's length by up to 0.001; ten times that is no rounding.
_LENGTH_TOLERANCE = 0.01
# Largest angle [rad]; a file in degrees exceeds it.
_LARGEST_ANGLE = 2.0 * np.pi + 0.1
# Largest coordinate [m]; a file in millimetres exceeds it.
_FARTHEST_M = 10.0
# Largest share of repeated times, which loggers that round times write.
_MOST_REPEATED = 0.1


def read_csv(path: Path) -> list[Demonstration]:
    """Read the demonstrations of a CSV file, in the order in which they first appear.

    Columns, in any order and case: ``demo`` (optional; rows with the same text are one demonstration), ``t`` [s],
    ``x y z`` [m] and exactly one of ``qw qx qy qz``, ``rx ry rz`` [rad] and ``roll pitch yaw`` [rad]; others are
    ignored. Poses are of the flange in UR Base. Quaternions within 1 % of unit length are normalised. Of rows with the
    same time the first is kept, if at most a tenth are removed. :func:`read_table` describes the format.

    Raises:
        BadInputError: the file is no such file, a cell is no number, times do not increase, there are fewer than
            two samples, or positions or angles look like millimetres or degrees.
    """
    table = read_table(path)
    if not len(table):
        raise BadInputError(f"demonstrations {path}: must hold at least 2 samples below the header, found none")
    rotation = _rotation_of(table)
    numbers = table.numbers((*_POSITION, *ROTATIONS[rotation], _TIME))
    position, turned, times = numbers[:, :3], numbers[:, 3:-1], numbers[:, -1]
    _check_units(table, position, turned, rotation)
    poses = np.concatenate([position, _QUATERNIONS[rotation](turned)], axis=1)
    if _DEMONSTRATION not in table.names:
        return [_demonstration(table, "0", np.arange(len(table)), times, poses)]
    rows = rows_by_text(table.column(_DEMONSTRATION))
    return [_demonstration(table, name, own, times[own], poses[own]) for name, own in rows.items()]


def rows_by_text(column: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the rows that hold each text of a column, both in the order in which they appear."""
    numbered = {text: number for number, text in enumerate(dict.fromkeys(column))}
    label = np.array([numbered[text] for text in column])
    order = np.argsort(label, kind="stable")
    parts = np.split(order, np.searchsorted(label[order], np.arange(1, len(numbered))))
    return dict(zip(numbered, parts, strict=True))


def write_csv(path: Path, demonstrations: Sequence[Demonstration], rotation: Rotation = "quaternion") -> None:
    """Write demonstrations for :func:`read_csv`, with all digits and without joint angles."""
    lines = StringIO()
    lines.write(",".join((_DEMONSTRATION, _TIME, *_POSITION, *ROTATIONS[rotation])) + "\n")
    for index, item in enumerate(demonstrations):
        turned = _COLUMNS[rotation](item.poses[:, pose.QUATERNION])
        for row in np.concatenate([item.times[:, None], item.poses[:, pose.POSITION], turned], axis=1).tolist():
            lines.write(",".join([str(index), *map(repr, row)]) + "\n")
    write_text(path, lines.getvalue())


def _unit(quaternions: Array) -> Array:
    return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))


def _same(quaternions: Array) -> Array:
    return quaternions


_QUATERNIONS: Final[dict[Rotation, Callable[[Array], Array]]] = {
    "quaternion": _unit,
    "vector": pose.from_rotation_vector,
    "angles": pose.from_roll_pitch_yaw,
}
_COLUMNS: Final[dict[Rotation, Callable[[Array], Array]]] = {
    "quaternion": _same,
    "vector": pose.to_rotation_vector,
    "angles": pose.to_roll_pitch_yaw,
}


def _rotation_of(table: Table) -> Rotation:
    names = set(table.names)
    missing = [name for name in (_TIME, *_POSITION) if name not in names]
    choices = " or ".join(" ".join(columns) for columns in ROTATIONS.values())
    given = [rotation for rotation, columns in ROTATIONS.items() if names >= set(columns)]
    found = ", ".join(name or "''" for name in table.names)
    if missing:
        raise BadInputError(
            f"demonstrations {table.path}: must have the columns t, x, y, z and {choices}; missing:"
            f" {', '.join(missing)}; found {found}"
        )
    if len(given) != 1:
        raise BadInputError(
            f"demonstrations {table.path}: must have exactly one of {choices}, found {len(given)} of them among {found}"
        )
    return given[0]


def _check_units(table: Table, position: Array, turned: Array, rotation: Rotation) -> None:
    where = f"demonstrations {table.path}"
    farthest = float(np.abs(position).max(initial=0.0))
    if farthest > _FARTHEST_M:
        raise BadInputError(
            f"{where}: x, y and z must be in metres and within {_FARTHEST_M:g} m, found {farthest:g}, as if in mm"
        )
    if rotation == "quaternion":
        length = np.linalg.norm(turned, axis=1)
        wrong = np.flatnonzero(np.abs(length - 1.0) > _LENGTH_TOLERANCE)
        if len(wrong):
            raise BadInputError(
                f"{where}: line {table.lines[wrong[0]]}: qw qx qy qz must have length 1 within {_LENGTH_TOLERANCE},"
                f" found {length[wrong[0]]:.4g}"
            )
        return
    largest = float((np.linalg.norm(turned, axis=1) if rotation == "vector" else np.abs(turned)).max(initial=0.0))
    if largest > _LARGEST_ANGLE:
        names = ", ".join(ROTATIONS[rotation])
        raise BadInputError(
            f"{where}: {names} must be in radians and turn at most once around, found {largest:g}, as if in degrees"
        )


def _demonstration(table: Table, name: str, rows: np.ndarray, times: Array, poses: Array) -> Demonstration:
    where = f"demonstrations {table.path}: " + (f"demo {name}: " if _DEMONSTRATION in table.names else "")
    if len(rows) < 2:
        raise BadInputError(f"{where}there must be at least 2 samples, found {len(rows)}")
    step = np.diff(times)
    back = np.flatnonzero(step < 0)
    if len(back):
        row = back[0] + 1
        hint = "" if _DEMONSTRATION in table.names else "; a column demo tells several demonstrations apart"
        raise BadInputError(
            f"{where}line {table.lines[rows[row]]}: t must increase,"
            f" found {times[row]:g} after {times[row - 1]:g}{hint}"
        )
    kept = np.concatenate([[True], step > 0])
    repeated = int(np.sum(~kept))
    if repeated > _MOST_REPEATED * len(rows):
        raise BadInputError(
            f"{where}t must increase from row to row, found {repeated} of {len(rows)} that repeat the time before"
        )
    try:
        return Demonstration(times[kept], poses[kept])
    except BadInputError as error:
        raise BadInputError(f"{where}{error}") from error
