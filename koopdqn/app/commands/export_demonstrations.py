"""``koopdqn export``: write demonstrations as CSV."""

from pathlib import Path

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.result import CommandResult
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.errors import BadInputError

CSV = "demos.csv"


def run(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.csv``, one sample a row."""
    sources = config.inputs.demos
    if sources is None:
        raise BadInputError("demos: must name the files to export (one, several in brackets, or a glob), found none")
    demonstrations = read_demonstrations(sources, config.chosen.name, config.robot.name, any_task=True)
    if demonstrations.placement is not None:
        console.note(f"moved back to where they were recorded: they had been {demonstrations.placement}")
        demonstrations = demonstrations.placement.undone(demonstrations)
    path = folder / CSV
    write_csv(path, demonstrations.items, config.export.rotation)
    if any(item.joints is not None for item in demonstrations.items):
        console.note("joint angles are left out: the CSV columns have no place for them")
    samples = [len(item) for item in demonstrations.items]
    result = {
        "demonstrations": len(demonstrations),
        "samples": samples,
        "rotation": config.export.rotation,
        "file": str(path),
    }
    return CommandResult(
        result,
        [f"{len(demonstrations)} demonstrations, {sum(samples)} samples", f"CSV  {console.shown_path(path)}"],
    )
