"""Settings of the report: which runs it shows."""

from typing import Annotated

from pydantic import Field, Strict

from koopdqn.config.settings import NonNegativeInt, PathText, Settings


class ReportSettings(Settings):
    """Which runs the report shows, and whether missing ones are made."""

    make: bool = Field(description="train and evaluate what is missing first")
    runs: Annotated[tuple[PathText, ...], Strict(False)] = Field(
        description="folders to search for finished runs; empty: the folder runs/, less its ablations"
    )
    seeds: Annotated[tuple[NonNegativeInt, ...], Strict(False), Field(min_length=1)] = Field(
        description="the seeds that `make` trains each task with"
    )
