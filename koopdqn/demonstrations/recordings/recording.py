"""The one form between a file and demonstrations: what was recorded, as it was recorded."""

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from koopdqn.demonstrations.recordings.declared import Angles, Clock, QuaternionOrder, Units
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.settings import shown

RowRotation = Literal["quaternion", "vector", "angles", "matrix", "transform"]
"""What the numbers of orientation of a row are: as in CSV, or a rotation matrix by rows, or a 4×4 that holds it."""


@dataclass(frozen=True)
class Recording:
    """One motion, in the units and the order of its file.

    Attributes:
        where: file, and the part of it, for messages.
        position: (N, 3) in ``units``, or None where there are joints alone.
        turn: (N, k) what ``rotation`` says, or None.
        joints: joint angles (N, J) in ``angles``, or None.
        times: (N,) in ticks of ``clock``, or None.
        rotation: what ``turn`` holds; None where the file does not say.
        order: of quaternions; None where the file does not say. So are ``units``, ``angles`` and ``clock``.
        rate_hz: rows a second where the file says that instead of times.
        tool: pose (7,) of the recorded point in the flange, where the file says it, or (N, 7) where that changes.
        rows: (N,) what to call each row in messages; counted from 0 if None.
        frame: the frame's name, or an empty text.
        other: another orientation of the same poses, which must agree; ``where`` names both.
        unused: names of columns that were taken for nothing.
        reasons: why it was read so, a line each.
    """

    where: str
    position: Array | None = None
    turn: Array | None = None
    joints: Array | None = None
    times: Array | None = None
    rotation: RowRotation | None = None
    order: QuaternionOrder | None = None
    units: Units | None = None
    angles: Angles | None = None
    clock: Clock | None = None
    rate_hz: float | None = None
    tool: Array | None = None
    rows: np.ndarray | None = None
    frame: str = ""
    other: "Recording | None" = None
    unused: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()

    def row(self, index: int) -> str:
        """Return what to call a row."""
        return f"row {index}" if self.rows is None else f"line {self.rows[index]}"


class Columns(Protocol):
    """A table whose columns have names; only those asked for are made numbers."""

    @property
    def where(self) -> str:
        """The file, and the part of it, for messages."""

    @property
    def names(self) -> tuple[str, ...]:
        """The columns' names, in their order."""

    @property
    def lines(self) -> np.ndarray | None:
        """What to call each row (N,) in messages; counted from 0 if None."""

    def numbers(self, columns: tuple[int, ...]) -> Array:
        """Return columns, given by their places, as numbers (N, k); BadInputError where a cell is none."""

    def texts(self, column: int) -> list[str]:
        """Return the N texts of a column, given by its place."""


@dataclass(frozen=True)
class ArrayColumns:
    """Columns of numbers that are in memory.

    Attributes:
        where: the file, and the part of it, for messages.
        names: the columns' names.
        values: (N, columns).
        lines: (N,) what to call each row in messages; counted from 0 if None.
    """

    where: str
    names: tuple[str, ...]
    values: Array
    lines: np.ndarray | None = None

    def numbers(self, columns: tuple[int, ...]) -> Array:
        """Return columns as numbers (N, k)."""
        values = self.values[:, list(columns)]
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            row, column = bad[0].tolist()
            raise BadInputError(
                f"demos {self.where}: row {row}: {self.names[columns[column]]} must be a finite number,"
                f" found {shown(float(values[row, column]))}"
            )
        return np.ascontiguousarray(values, dtype=float)

    def texts(self, column: int) -> list[str]:
        """Return the texts of a column."""
        return [f"{value:g}" for value in self.values[:, column].tolist()]
