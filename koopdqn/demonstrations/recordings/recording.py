"""The one form between a file and demonstrations: what was recorded, as it was recorded, and what is declared of it."""

from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal, Protocol, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from koopdqn.demonstrations.csv import Rotation
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.settings import Positive, Settings, Vector4, Vector6, shown

Units = Literal["m", "cm", "mm"]
Angles = Literal["rad", "deg"]
QuaternionOrder = Literal["wxyz", "xyzw"]
Clock = Literal["s", "ms", "us", "ns"]

METRES: Final[dict[Units, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""What one of each unit is [m]."""
SECONDS: Final[dict[Clock, float]] = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""What one of each tick is [s]."""

ROLES: Final = (
    *("demo", "t", "x", "y", "z", "qw", "qx", "qy", "qz", "rx", "ry", "rz", "roll", "pitch", "yaw"),
    *(f"j{index}" for index in range(1, 8)),
)
"""What a column may be."""
IGNORED: Final = "_"
# A shorter one tells no orientation.
_SHORTEST_QUATERNION: Final = 1e-6


def _columns(value: object) -> object:
    """Check the roles of declared columns: a list in the order of the file, or names by role."""
    if value is None:
        return None
    if isinstance(value, list | tuple):
        odd = [each for each in value if each not in (*ROLES, IGNORED)]
        twice = [each for each in set(value) if each != IGNORED and list(value).count(each) > 1]
        if odd or twice or not value:
            found = f"{(odd or twice)[0]!r}" if value else "none"
            raise ValueError(f"must name each column once, by {', '.join(ROLES)} or {IGNORED}, found {found}")
        return tuple(value)
    if isinstance(value, dict) and value:
        for role, name in value.items():
            if role not in ROLES:
                raise ValueError(f"must name columns by {', '.join(ROLES)}, found {role!r}")
            if not isinstance(name, str | int) or isinstance(name, bool):
                raise ValueError(f"must give a column's name or its number from 0, found {role}: {name!r}")
        return {role: str(name) for role, name in value.items()}
    raise ValueError("must be a list of columns in their order, or names by role such as {x: pos_x}")


class ImportSettings(Settings):
    """The settings ``import``: what a person declares of recordings that files do not say; None where they shall."""

    units: Units | None = Field(description="of positions: m, cm or mm")
    angles: Angles | None = Field(description="of rotation vectors, of roll, pitch and yaw and of joints: rad or deg")
    quaternion: QuaternionOrder | None = Field(description="the order of quaternions that name no components")
    rotation: Rotation | None = Field(description="what three numbers of orientation are: vector or angles")
    clock: Clock | None = Field(description="the unit of the time column: s, ms, us or ns")
    columns: Annotated[tuple[str, ...] | dict[str, str] | None, BeforeValidator(_columns)] = Field(
        description="columns in their order (`_` leaves one out), or names by role"
    )
    pose: str | None = Field(description="which pose to read where there are several: a part of its name")
    rate_hz: Positive | None = Field(description="rows a second, in place of a time column")
    speed_m_s: Positive | None = Field(description="constant speed along the path, in place of a time column")
    orientation: Vector4 | None = Field(description="quaternion w x y z of every pose, where positions stand alone")
    tool: Vector6 | None = Field(description="of the recorded point in the flange: x y z [m], rotation vector [rad]")
    base: Vector6 | None = Field(description="of the arm's base in the recording's frame: x y z [m], vector [rad]")
    cut: bool | None = Field(description="whether a file with several motions becomes several demonstrations")

    @model_validator(mode="after")
    def _check_clock(self) -> Self:
        if self.rate_hz is not None and self.speed_m_s is not None:
            raise ValueError(
                f"rate_hz and speed_m_s must not both be given, found {self.rate_hz:g} and {self.speed_m_s:g}: each is"
                " the clock in place of a time column"
            )
        if self.orientation is not None and np.linalg.norm(self.orientation) < _SHORTEST_QUATERNION:
            raise ValueError(f"orientation must be a quaternion, of length 1, found {list(self.orientation)}")
        return self

    def given(self) -> dict[str, Any]:
        """Return what is declared of how to read a file; whether it is cut is another matter."""
        return {key: value for key, value in self.model_dump().items() if value is not None and key != "cut"}


NOTHING: Final = ImportSettings(**dict.fromkeys(ImportSettings.model_fields))
"""Nothing declared."""


RowRotation = Literal["quaternion", "vector", "angles", "kuka", "matrix", "transform"]
"""What the numbers of orientation of a row are: as in CSV, or KUKA's C B A, which are such angles, in degrees as KUKA
writes them; or a rotation matrix by rows, or a 4×4 that holds it."""


@dataclass(frozen=True)
class Recording:
    """One motion, in the units and the order of its file.

    Attributes:
        where: file, and the part of it, for messages.
        position: (N, 3) in ``units``, or None where there are joints alone.
        turn: (N, k) what ``rotation`` says, or None.
        joints: joint angles (N, J) in ``joint_angles``, or None.
        times: (N,) in ticks of ``clock``, or None.
        rotation: what ``turn`` holds; None where the file does not say.
        order: of quaternions; None where the file does not say. So are ``units``, ``angles``, ``joint_angles`` and
            ``clock``.
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
    joint_angles: Angles | None = None
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

    @property
    def of_joints(self) -> bool:
        """Whether there are joints alone, and no pose."""
        return self.position is None and self.turn is None

    @property
    def origin(self) -> Array:
        """Positions (N, 3) in ``units``, also of 4×4 matrices."""
        if self.rotation != "transform":
            assert self.position is not None
            return self.position
        assert self.turn is not None
        return self.turn[:, [12, 13, 14]] if self.by_columns else self.turn[:, [3, 7, 11]]

    @property
    def by_columns(self) -> bool:
        """Whether 4×4 matrices stand by columns, as where 0 0 0 1 stands shows.

        Raises:
            BadInputError: it stands in both places, or in neither.
        """
        assert self.turn is not None
        last = np.array([0.0, 0.0, 0.0, 1.0])
        rows, columns = (
            bool(np.allclose(self.turn[:, places], last, atol=1e-6)) for places in ([12, 13, 14, 15], [3, 7, 11, 15])
        )
        if rows == columns:
            raise BadInputError(
                f"demos {self.where}: sixteen numbers must be a 4×4 matrix with the row 0 0 0 1, by rows or by"
                f" columns, found {'both' if rows else 'neither'}"
            )
        return columns


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
        return [f"{value:.17g}" for value in self.values[:, column].tolist()]
