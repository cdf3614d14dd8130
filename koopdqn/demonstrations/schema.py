"""The schema of inspect.json."""

from typing import Literal

from pydantic import Field

from koopdqn.settings import ReportModel


class InspectedFile(ReportModel):
    """A file that was read."""

    file: str = Field(description="its path, as it was given")
    kind: str = Field(description="what it was recognised as, and why")
    reasons: list[str] = Field(description="what was taken for what, and why")


class InspectedDemonstration(ReportModel):
    """What was found of one demonstration."""

    samples: int = Field(description="as recorded")
    kept: int = Field(description="samples after the steps")
    seconds: float = Field(description="time it takes, idle ends included")
    nearest_m: float = Field(description="least distance of the flange from the arm's base")
    farthest_m: float = Field(description="the largest")
    length_m: float = Field(description="path length after the steps")
    turn_deg: float = Field(description="angle between first and last orientation")
    idle_before_seconds: float = Field(description="idle time at the start")
    idle_after_seconds: float = Field(description="idle time at the end")
    repeated: int = Field(description="samples that repeat the one before while the clock runs")
    outliers: int = Field(description="single samples far off their neighbours")
    jump_mm: float = Field(
        description="the longest step that is over five times as fast as those beside it and nearly all others; 0 if"
        " there is none"
    )
    noise_mm: float = Field(description="standard deviation of the sensor noise of positions")
    noise_deg: float = Field(description="the same of orientations")
    largest_gap: float = Field(description="longest time step, in median time steps")
    reached: float = Field(ge=0, le=1, description="share of its way that the arm can follow")
    stopped: str = Field(description="why the arm can follow no further; empty if it can")
    singular: float | None = Field(
        description="least singular value of the Jacobian (m and rad) on the way; null if its start is out of reach"
    )
    joint_speed: float | None = Field(
        description="largest joint speed as recorded, in shares of its limit; null if its start is out of reach"
    )
    deviation_mm: float | None = Field(
        description="mean distance from the mean of the others, matched by path length; null if it is alone"
    )


class Pair(ReportModel):
    """Two demonstrations."""

    first: int = Field(description="number of the one")
    second: int = Field(description="number of the other")


class Finding(ReportModel):
    """One line of the table."""

    name: str = Field(description="what was looked at")
    state: Literal["good", "look", "bad"] = Field(description="good; look: worth a look; bad: learning will suffer")
    text: str = Field(description="what was found")


class InspectionFile(ReportModel):
    """The content of inspect.json."""

    files: list[InspectedFile] = Field(description="what was read")
    arm: str = Field(description="the arm that reach and speed are judged for")
    steps: list[str] = Field(description="steps that cleaned the demonstrations, in order")
    demonstrations: list[InspectedDemonstration] = Field(description="one object a demonstration")
    duplicates: list[Pair] = Field(description="demonstrations that are the same")
    odd: list[int] = Field(description="demonstrations far off all others")
    spread_mm: list[float] | None = Field(
        min_length=5,
        max_length=5,
        description="RMS distance from the mean at 0, 25, 50, 75 and 100 % of the path; null for a single one [mm]",
    )
    spread_deg: list[float] | None = Field(
        min_length=5, max_length=5, description="RMS turn from the mean at the same places; null for a single one [°]"
    )
    left_out_mm: list[float] = Field(
        description="mean distance of a demonstration left out from the mean of 1, 2, … others [mm]"
    )
    enough: bool = Field(description="whether one more demonstration would hardly tell more")
    findings: list[Finding] = Field(description="the table")
    file: str = Field(description="the cleaned demonstrations; the source is never changed")
    picture: str = Field(description="the picture")
