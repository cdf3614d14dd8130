"""The report's settings, and what ``report.json`` and ``sweep.json`` hold."""

from typing import Annotated

from pydantic import Field, Strict

from koopdqn.evaluation.results import SweptRun, Variant
from koopdqn.settings import Name, NonNegativeInt, PathText, ReportModel, Settings


class ReportSettings(Settings):
    """Which runs the report shows, and whether missing ones are made."""

    make: bool = Field(description="train and evaluate what is missing first; of a sweep evaluate only")
    runs: Annotated[tuple[PathText, ...], Strict(False)] = Field(
        description="folders to search for finished runs; empty: the folder runs/, less its ablations"
    )
    seeds: Annotated[tuple[NonNegativeInt, ...], Strict(False), Field(min_length=1)] = Field(
        description="the seeds that `make` trains each task with"
    )
    sweep: PathText | None = Field(description="folder of a sweep, shown in place of the paper's figures; null: none")


class ShownRun(ReportModel):
    """A run that the page shows."""

    folder: Name = Field(description="its folder, as it was given or found")
    task: Name = Field(description="name of the task")
    preset: Name = Field(description="name of the preset")
    seed: NonNegativeInt = Field(description="of the run")
    evaluation: str | None = Field(description="file of its evaluation; null if there is none")


class LeftOut(ReportModel):
    """A run that the page does not show."""

    folder: Name = Field(description="its folder")
    reason: Name = Field(description="why")


class DrawnFigure(ReportModel):
    """A figure of the page."""

    number: Name = Field(description="as the paper counts")
    title: Name = Field(description="in a few words")
    files: list[Name] = Field(description="its PNGs, relative to the page")


class MissingPart(ReportModel):
    """A figure or table that the page lacks."""

    what: Name = Field(description="its name")
    reason: Name = Field(description="what it needs")
    command: str = Field(default="", description="what makes it; empty where no command would")


class ReportFile(ReportModel):
    """The content of ``report.json``."""

    page: Name = Field(description="the page")
    runs: list[ShownRun] = Field(description="runs that it shows")
    left_out: list[LeftOut] = Field(description="runs that were found and are not shown")
    figures: list[DrawnFigure] = Field(description="figures, in order")
    tables: list[Name] = Field(description="titles of its tables, in order")
    missing: list[MissingPart] = Field(description="what it lacks")


class SweepFile(ReportModel):
    """The content of ``sweep.json``."""

    page: Name = Field(description="the page")
    sweep: Name = Field(description="the folder that was searched")
    runs: list[SweptRun] = Field(description="every training run below it")
    variants: list[Variant] = Field(description="its runs by what they were given")
