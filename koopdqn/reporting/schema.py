"""The content of ``report.json``: what the page shows, and from what."""

from pydantic import Field

from koopdqn.config.settings import Name, NonNegativeInt
from koopdqn.schema import ReportModel


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
    command: str = Field(description="what makes it; empty where no command would")


class ReportFile(ReportModel):
    """The content of ``report.json``."""

    page: Name = Field(description="the page")
    runs: list[ShownRun] = Field(description="runs that it shows")
    left_out: list[LeftOut] = Field(description="runs that were found and are not shown")
    figures: list[DrawnFigure] = Field(description="figures, in order")
    tables: list[Name] = Field(description="titles of its tables, in order")
    missing: list[MissingPart] = Field(description="what it lacks")
