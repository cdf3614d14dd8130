"""What a person declares of a recording that its file does not say: the settings ``import``."""

from typing import Annotated, Any, Final, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from koopdqn.demonstrations.csv import Rotation
from koopdqn.settings import Positive, Settings, Vector4, Vector6

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
    """What is declared of recordings; None where the files shall say."""

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
        return self

    def given(self) -> dict[str, Any]:
        """Return what is declared of how to read a file; whether it is cut is another matter."""
        return {key: value for key, value in self.model_dump().items() if value is not None and key != "cut"}


NOTHING: Final = ImportSettings(**dict.fromkeys(ImportSettings.model_fields))
"""Nothing declared."""
