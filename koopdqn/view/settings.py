"""What ``koopdqn view``, ``koopdqn explain`` and ``koopdqn compare`` show."""

import math
from typing import Annotated

from pydantic import Field, Strict, field_validator

from koopdqn.settings import NonNegativeInt, PathText, Settings, Vector7


class ViewSettings(Settings):
    """What ``koopdqn view`` shows."""

    starts: int = Field(ge=1, le=12, description="held-out starts, the first of those that eval measures")
    video: PathText | None = Field(description="also a film of the first start: a new .mp4 or .gif; null: none")
    window: bool = Field(description="also open MuJoCo's viewer, where there is a display")


class ExplainSettings(Settings):
    """Which state ``koopdqn explain`` explains."""

    start: NonNegativeInt | None = Field(
        description="number of the held-out start, as eval draws them; null: the first that fails, or 0"
    )
    step: NonNegativeInt | None = Field(description="of the path from there, from 0; null: the most telling one")
    pose: Vector7 | None = Field(description="a pose in place of one of the path; null: none")

    @field_validator("pose")
    @classmethod
    def _check_pose(cls, pose: Vector7 | None) -> Vector7 | None:
        length = 1.0 if pose is None else math.hypot(*pose[3:])
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"must have a quaternion of length 1 within 0.001, found {length:g}")
        return pose


class CompareSettings(Settings):
    """Which runs ``koopdqn compare`` sets side by side."""

    runs: Annotated[tuple[PathText, ...], Strict(False)] = Field(description="folders of 2 to 6 trained runs of a task")
