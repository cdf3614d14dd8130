"""The lines of ``keys.jsonl``: every key with its unit."""

from typing import Annotated, Literal

from pydantic import Field

from koopdqn.config.settings import Name, NonNegative, NonNegativeInt, Positive
from koopdqn.schema import ReportModel, Sha256


class SessionLine(ReportModel):
    """What the keys were pressed for; the same keys for the same make the same demonstrations."""

    kind: Literal["session"] = Field(description="what the line is")
    task: Name = Field(description="the task")
    workcell: Sha256 = Field(description="SHA-256 of the settings of task and robot")
    seed: NonNegativeInt = Field(description="by which the starts are drawn")
    step_m: Positive = Field(description="what a key moves to begin with [m]")
    turn_rad: Positive = Field(description="what a key turns to begin with [rad]")
    rounding_m: NonNegative = Field(description="over how much of the path corners are rounded off [m]")
    speed_m_s: Positive = Field(description="with which the path is played [m/s]")
    sample_seconds: Positive = Field(description="between two samples [s]")


class KeyLine(ReportModel):
    """A key that changed something; what was refused is not written."""

    kind: Literal["key"] = Field(description="what the line is")
    key: Annotated[str, Field(min_length=1, max_length=1)] = Field(description="the key")
