"""What ``koopdqn view``, ``explain`` and ``compare`` show, and what ``explain.json`` and ``compare.json`` hold."""

import math
from typing import Annotated, Literal

from pydantic import Field, Strict, field_validator

from koopdqn.settings import (
    Count,
    Fraction,
    Name,
    NonNegative,
    NonNegativeInt,
    PathText,
    PoseList,
    ReportModel,
    Settings,
    Vector7,
)


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
        if pose is None:
            return None
        length = math.hypot(*pose[3:])
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"must have a quaternion of length 1 within 0.001, found {length:g}")
        x, y, z, *turn = pose
        a, b, c, d = (each / length for each in turn)
        return x, y, z, a, b, c, d


class CompareSettings(Settings):
    """Which runs ``koopdqn compare`` sets side by side."""

    runs: Annotated[tuple[PathText, ...], Strict(False)] = Field(description="folders of 2 to 6 trained runs of a task")


class ExplainedAction(ReportModel):
    """What is known of one action in the explained state."""

    number: int = Field(ge=0, le=9, description="in Table 1, counted from 0")
    name: Name = Field(description="in a word or two")
    chosen: bool = Field(description="whether the policy takes it")
    q: float = Field(description="its value Q")
    reward: float = Field(description="by rule, intent model or answer; of `asked` what the untrusted model would give")
    off: NonNegative | None = Field(
        description="distance of the reached pose from the prediction in tolerances, at most 1 if it is right; null"
        " where a rule forbids the action"
    )
    source: Literal["rule", "trusted", "asked", "remembered", "certified"] = Field(
        description="where the reward comes from; asked: a question would be asked"
    )
    why: Name = Field(
        description="why it comes from there; the way out is from the middle of the trust domain to its edge"
    )
    person: bool | None = Field(description="whether the scripted person agrees with it; null without one")
    refused: str = Field(description="why the arm cannot carry it out; empty if it can, or where it is not known")
    reached: PoseList = Field(description="pose that it reaches (x y z [m], quaternion)")


class ExplainFile(ReportModel):
    """The content of ``explain.json``; a given pose is on no path, and what tells of one is null."""

    run: Name = Field(description="folder of the explained run")
    task: Name = Field(description="name of the task")
    start: NonNegativeInt | None = Field(
        description="number of the held-out start, as `koopdqn eval` draws them; of a given pose the one that"
        " `start=` names, as if the episode had begun there; null if it names none (the task's nominal start)"
    )
    outcome: Name | None = Field(
        description="of the path from there: success, or the cause of failure; null of a given pose"
    )
    detail: str | None = Field(description="more about a failure, in words; null of a given pose")
    steps: NonNegativeInt | None = Field(description="steps of the path; null of a given pose")
    step: NonNegativeInt | None = Field(description="the explained step, counted from 0; null of a given pose")
    why_step: Name = Field(description="why that step is shown, or that the pose was given")
    left_at: NonNegativeInt | None = Field(
        description="the step from which on the path stays off; null if none does, and of a given pose"
    )
    off_path_mm: NonNegative | None = Field(
        description="distance of the explained pose from the person's own path from the same start, or else from the"
        " intent's roll-out; null of a given pose"
    )
    leg: int = Field(ge=1, description="which leg of the path the pose is on, from 1; of a given pose the nearest")
    legs: int = Field(ge=1, description="how many legs there are: 1 but where the path passes itself")
    pose: PoseList = Field(description="the explained pose (x y z [m], quaternion)")
    predicted: PoseList = Field(description="what the reached poses are compared with")
    trusted: bool = Field(description="whether the pose is in the trust domain")
    trust: Name = Field(description="why, or why not")
    actions: list[ExplainedAction] = Field(min_length=10, max_length=10, description="all ten actions, in order")


class ComparedRun(ReportModel):
    """One of the runs that are compared."""

    label: Name = Field(description="letter by which the page and the tables name it")
    folder: Name = Field(description="its folder")
    seed: NonNegativeInt = Field(description="of the run")
    learned: bool = Field(description="whether it learned")
    seconds: NonNegative = Field(description="time the training took [s]")
    env_steps: NonNegativeInt = Field(description="actions tried")
    oracle_queries: NonNegativeInt = Field(description="questions that reached the oracle")
    evaluation: Name | None = Field(description="file of its newest evaluation; null if none was found")
    episodes: Count | None = Field(description="held-out starts of that evaluation")
    success_rate: Fraction | None = Field(description="of that evaluation")
    deviation_mm: NonNegative | None = Field(description="mean path deviation of that evaluation")
    reached: NonNegativeInt = Field(description="how many of the shown paths reach the goal")


class Difference(ReportModel):
    """A key of the config in which runs differ."""

    key: Name = Field(description="dotted")
    values: list[str] = Field(
        description="of each run, in the order of `runs`, as JSON; empty where there is no such key"
    )


class CompareFile(ReportModel):
    """The content of ``compare.json``."""

    page: Name = Field(description="the page")
    task: Name = Field(description="name of the task")
    starts: list[NonNegativeInt] = Field(description="numbers of the held-out starts that are shown")
    runs: list[ComparedRun] = Field(description="the runs, in the order in which they were given")
    differences: list[Difference] = Field(description="of their configs")
