"""The lines of ``feedback.jsonl``: every key with its unit."""

from typing import Annotated, Literal

from pydantic import Field

from koopdqn.config.settings import Fraction, Name, NonNegative, NonNegativeInt
from koopdqn.environment.actions import COUNT
from koopdqn.schema import ReportModel

PoseList = Annotated[list[float], Field(min_length=7, max_length=7)]


Action = Annotated[int, Field(ge=0, lt=COUNT)]


class AnswerLine(ReportModel):
    """An answer of the oracle. Poses are of the flange in the base frame: x y z [m], qw qx qy qz."""

    kind: Literal["answer"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer, from 0")
    episode: NonNegativeInt = Field(description="number of the episode, from 0")
    step: NonNegativeInt = Field(description="step within it, from 0")
    pose: PoseList = Field(description="(7,) before the action [m, 1]")
    start: PoseList | None = Field(
        None, description="(7,) where the episode began; null in journals that do not say [m, 1]"
    )
    action: Action = Field(description="index of the action in Table 1, from 0")
    reached: PoseList = Field(description="(7,) after the action [m, 1]")
    predicted: PoseList = Field(description="(7,) where the intent model would have gone [m, 1]")
    reason: str = Field(description="why it was asked, in words")
    right: bool | None = Field(description="the answer; null for a skipped question, which is not a no")
    better: Action | None = Field(None, description="index of the action that would have been right; null if not said")
    source: Name = Field(description="who answered")
    seconds: NonNegative = Field(description="how long the answer took; shapes nothing [s]")


class UndoLine(ReportModel):
    """The latest answer that stands is withdrawn, from the question on that stood then."""

    kind: Literal["undo"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer that is withdrawn")
    before: NonNegativeInt = Field(description="number of the question that stood then")
    episode: NonNegativeInt = Field(description="number of that question's episode")
    step: NonNegativeInt = Field(description="its step")


class EditLine(ReportModel):
    """An answer was changed afterwards, by ``koopdqn feedback edit`` or ``merge``."""

    kind: Literal["edit"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer that is changed")
    right: bool | None = Field(description="the answer from now on; null for a skipped question")
    better: Action | None = Field(description="index of the action that would have been right; null if not said")
    source: Name = Field(description="who changed it")
    learned: bool = Field(description="whether the run in the journal's folder had learned from the answer by then")


class DropLine(ReportModel):
    """All answers after one no longer count, and are asked anew, by ``koopdqn feedback edit --drop-later``."""

    kind: Literal["drop"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the last answer that still counts")


class OpinionLine(ReportModel):
    """What another teacher says to an answered question, by ``koopdqn feedback merge``."""

    kind: Literal["opinion"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer")
    right: bool | None = Field(description="the other teacher's answer; null for a skipped question")
    better: Action | None = Field(description="index of the action that would have been right; null if not said")
    source: Name = Field(description="who says it")


Line = Annotated[AnswerLine | UndoLine | EditLine | DropLine | OpinionLine, Field(discriminator="kind")]
"""Any line of a journal."""


class TeacherSummary(ReportModel):
    """What one teacher answered; withdrawn answers are left out."""

    name: Name = Field(description="who answered")
    answers: NonNegativeInt = Field(description="answers given")
    right: NonNegativeInt = Field(description="of these, right")
    wrong: NonNegativeInt = Field(description="of these, wrong")
    skipped: NonNegativeInt = Field(description="of these, skipped")
    better: NonNegativeInt = Field(description="of these, how many named the action that would have been right")
    median_seconds: NonNegative = Field(description="median time of an answer [s]")


class AgreementSummary(ReportModel):
    """How far two teachers agree on the questions that both answered."""

    one: Name = Field(description="one teacher")
    other: Name = Field(description="the other")
    questions: NonNegativeInt = Field(description="questions that both answered")
    same: NonNegativeInt = Field(description="of these, how many alike")
    share: Fraction = Field(description="their share")


class FeedbackSummary(ReportModel):
    """What ``koopdqn feedback show --json`` prints."""

    answers: NonNegativeInt = Field(description="answers in the journals")
    withdrawn: NonNegativeInt = Field(description="of these, withdrawn")
    edited: NonNegativeInt = Field(description="of these, changed afterwards")
    teachers: list[TeacherSummary] = Field(description="by teacher")
    agreement: list[AgreementSummary] = Field(description="by pair of teachers who answered the same questions")
