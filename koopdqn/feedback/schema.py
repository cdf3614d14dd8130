"""The lines of ``feedback.jsonl``: every key with its unit."""

from typing import Annotated, Literal

from pydantic import Field

from koopdqn.config.settings import Name, NonNegative, NonNegativeInt
from koopdqn.environment.actions import COUNT
from koopdqn.schema import ReportModel

PoseList = Annotated[list[float], Field(min_length=7, max_length=7)]


class AnswerLine(ReportModel):
    """An answer of the oracle. Poses are of the flange in the base frame: x y z [m], qw qx qy qz."""

    kind: Literal["answer"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer, from 0")
    episode: NonNegativeInt = Field(description="number of the episode, from 0")
    step: NonNegativeInt = Field(description="step within it, from 0")
    pose: PoseList = Field(description="(7,) before the action [m, 1]")
    action: Annotated[int, Field(ge=0, lt=COUNT)] = Field(description="index of the action in Table 1, from 0")
    reached: PoseList = Field(description="(7,) after the action [m, 1]")
    predicted: PoseList = Field(description="(7,) where the intent model would have gone [m, 1]")
    reason: str = Field(description="why it was asked, in words")
    right: bool | None = Field(description="the answer; null for a skipped question, which is not a no")
    source: Name = Field(description="who answered")
    seconds: NonNegative = Field(description="how long the answer took; shapes nothing [s]")
