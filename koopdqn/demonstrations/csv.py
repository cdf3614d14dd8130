"""Demonstration files: CSV with one sample a row."""

from collections.abc import Callable, Sequence
from io import StringIO
from pathlib import Path
from typing import Final, Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.demonstrations.csv_table import Table, read_table
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.files import write_text
from koopdqn.pose import Array

Rotation = Literal["quaternion", "vector", "angles"]
"""How a CSV file gives orientation: unit quaternion, rotation vector, or roll, pitch and yaw."""

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
# Rounded to three decimals a quaternion's length is off by up to 0.001; more than ten times that is no rounding.
_LENGTH_TOLERANCE = 0.01
# The largest angle [rad] that a file may hold; one in degrees soon holds a larger one.
_LARGEST_ANGLE = 2.0 * np.pi + 0.1
# The largest coordinate [m]; no arm here reaches so far, but a file in millimetres does.
_FARTHEST_M = 10.0
# Loggers that round times repeat one now and then; a file in which more than this share repeat has no such times.
_MOST_REPEATED = 0.1


def read_csv(path: Path) -> list[Demonstration]:
    """Read the demonstrations of a CSV file, in the order in which they first appear.

    Columns, in any order and case: ``demo`` (optional; rows with the same text are one demonstration), ``t`` [s],
    ``x y z`` [m] and exactly one of ``qw qx qy qz``, ``rx ry rz`` [rad] and ``roll pitch yaw`` [rad]; others are
    left out. Poses are of the flange in UR Base. Two repairs are made: quaternions are scaled to unit length if
    they have it within 1 %, and of rows that repeat the time before them the first is kept, if that leaves nine
    tenths of the rows. :func:`koopdqn.demonstrations.csv_table.read_table` says what else is read.

    Raises:
        BadInputError: the file is no such file, a cell is no number, times do not increase, there are fewer than
            two samples, or positions or angles look like millimetres or degrees.
    """
    table = read_table(path)
    if not len(table):
        raise BadInputError(f"demonstrations {path}: must hold at least 2 samples below the header, found none")
    rotation = _rotation_of(table)
    position = np.stack([table.numbers(name) for name in _POSITION], axis=1)
    turned = np.stack([table.numbers(name) for name in ROTATIONS[rotation]], axis=1)
    times = table.numbers(_TIME)
    _check_units(table, position, turned, rotation)
    poses = np.concatenate([position, _QUATERNIONS[rotation](turned)], axis=1)
    names = table.cells.get(_DEMONSTRATION, ["0"] * len(table))
    found = []
    for name in dict.fromkeys(names):
        rows = np.array([index for index, each in enumerate(names) if each == name])
        found.append(_demonstration(table, name, rows, times[rows], poses[rows]))
    return found


def write_csv(path: Path, demonstrations: Sequence[Demonstration], rotation: Rotation = "quaternion") -> None:
    """Write demonstrations as :func:`read_csv` reads them, without their joint angles; numbers keep every digit."""
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
    names = set(table.cells)
    missing = [name for name in (_TIME, *_POSITION) if name not in names]
    choices = " or ".join(" ".join(columns) for columns in ROTATIONS.values())
    given = [rotation for rotation, columns in ROTATIONS.items() if names >= set(columns)]
    found = ", ".join(name or "''" for name in table.cells)
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
    where = f"demonstrations {table.path}: " + (f"demo {name}: " if _DEMONSTRATION in table.cells else "")
    if len(rows) < 2:
        raise BadInputError(f"{where}there must be at least 2 samples, found {len(rows)}")
    step = np.diff(times)
    back = np.flatnonzero(step < 0)
    if len(back):
        row = back[0] + 1
        hint = "" if _DEMONSTRATION in table.cells else "; a column demo tells several demonstrations apart"
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
