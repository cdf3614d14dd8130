"""What a robot program is to be like: where it starts, how it is smoothed, what limits it keeps, how it is written."""

import math
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import BeforeValidator, Field

from koopdqn.settings import Fraction, Positive, Settings

NOMINAL: Final = "nominal"
# How the controller's servo follows: it looks ahead [s] and pulls by a gain; the maker's defaults.
LOOKAHEAD_S: Final = 0.1
GAIN: Final = 300
_FEWEST: Final = 6


def _to_start(value: Any) -> Any:
    if value == NOMINAL:
        return value
    if _are_numbers(value) and len(value) >= _FEWEST:
        return tuple(value)
    if isinstance(value, dict) and value.keys() == {"joints"} and _are_numbers(value["joints"]):
        return {"joints": tuple(value["joints"])}
    raise ValueError(
        f"must be {NOMINAL}, 6 joint angles [rad], a pose of 7 numbers (x y z [m], qw qx qy qz) or {{joints: […]}}"
    )


def _are_numbers(value: object) -> Any:
    return isinstance(value, list | tuple) and all(
        isinstance(each, int | float) and not isinstance(each, bool) and math.isfinite(each) for each in value
    )


Start = Annotated[
    Literal["nominal"] | tuple[float, ...] | dict[Literal["joints"], tuple[float, ...]], BeforeValidator(_to_start)
]
"""The task's nominal start, a pose (7,) or joint angles (n,) [rad]; of an arm with seven joints ``{joints: […]}``."""

Format = Literal["urscript", "ros_yaml", "ros_json", "rtde", "robomimic", "mcap"]


def _to_formats(value: object) -> object:
    if not isinstance(value, list | tuple) or not value:
        raise ValueError(f"must be a list of one or more of {', '.join(get_args(Format))}")
    return tuple(value)


class ProgramSettings(Settings):
    """How a learned path becomes a robot program."""

    start: Start = Field(description="where it starts")
    formats: Annotated[tuple[Format, ...], BeforeValidator(_to_formats)] = Field(description="what is written")
    urscript: Literal["servoj", "movep"] = Field(
        description="moves of the URScript: a stream of joint angles, or straight lines with blends"
    )
    frame: Literal["recorded", "placed"] = Field(
        description="where demonstrations were recorded, or where demos.place moved them"
    )
    tolerance_m: Positive = Field(description="most that smoothing moves a pose of the learned path [m]")
    tolerance_rad: Positive = Field(description="most that it turns one [rad]")
    period_s: float = Field(ge=0.001, le=0.1, description="between two samples [s]")
    speed_share: Fraction = Field(gt=0, description="share of the arm's joint speed limits that is used")
    acceleration_rad_s2: Positive = Field(description="most of every joint")
    jerk_rad_s3: Positive = Field(description="most of every joint")
    tool_speed_m_s: Positive = Field(description="most of the flange")
    tracking_m: Positive = Field(description="most that the flange may be off its sample in dynamics [m]")
