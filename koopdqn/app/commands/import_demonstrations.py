"""``koopdqn import``: read real demonstrations, check them and keep them as one HDF5 file."""

from pathlib import Path

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from koopdqn import console, pose
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.stages import DEMONSTRATIONS
from koopdqn.app.result import CommandResult
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.preprocess import Trimmed, trimmed
from koopdqn.demonstrations.reading import files_of, read_demonstrations
from koopdqn.errors import BadInputError
from koopdqn.paths import arc_lengths

_AT_ONCE = 10_000
"""Poses whose joint angles are looked for together."""
_MOST_SHOWN = 100
"""Demonstrations in the table."""


def run(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.hdf5``, sample for sample, and say what is in it."""
    sources = config.inputs.demos
    if sources is None:
        raise BadInputError("demos: must name the files to import (one, several in brackets, or a glob), found none")
    name = config.chosen.name
    demonstrations = read_demonstrations(sources, name, config.robot.name, any_task=True)
    path = folder / DEMONSTRATIONS
    cut = [_trimmed(index, item) for index, item in enumerate(demonstrations.items)]
    reachable = [_reachable(config, each.item.poses) for each in cut]
    lengths = [float(arc_lengths(each.item.poses[:, pose.POSITION])[-1]) for each in cut]
    turns = [float(pose.rotation_distance(each.item.poses[0], each.item.poses[-1])) for each in cut]
    write_hdf5(path, demonstrations)
    result = {
        "task": name,
        "files": [str(file) for file in files_of(sources)],
        "demonstrations": len(demonstrations),
        "samples": [len(item) for item in demonstrations.items],
        "seconds": [float(item.times[-1] - item.times[0]) for item in demonstrations.items],
        "idle_before_seconds": [each.before for each in cut],
        "idle_after_seconds": [each.after for each in cut],
        "length_m": lengths,
        "turn_rad": turns,
        "reachable": reachable,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    table = Table(title=f"{len(demonstrations)} demonstrations for task {name}")
    for heading in ("demo", "samples", "time", "idle before", "after", "path", "turn", "reached"):
        table.add_column(heading, justify="right")
    for index, (item, each) in enumerate(zip(demonstrations.items[:_MOST_SHOWN], cut, strict=False)):
        table.add_row(
            str(index),
            str(len(item)),
            f"{item.times[-1] - item.times[0]:.2f} s",
            f"{each.before:.2f} s",
            f"{each.after:.2f} s",
            f"{1e3 * lengths[index]:.0f} mm",
            f"{np.degrees(turns[index]):.1f}°",
            "yes" if reachable[index] else "NO",
        )
    lines: list[RenderableType] = [
        table,
        *([f"and {len(cut) - _MOST_SHOWN} more, which --json lists"] if len(cut) > _MOST_SHOWN else []),
        "idle ends are kept in the file; learning cuts them off",
        f"demonstrations  {console.shown_path(path)}",
    ]
    if not all(reachable):
        console.warn(f"{config.robot.name} cannot reach every pose of demonstration {reachable.index(False)}")
    return CommandResult(result, lines)


def _trimmed(index: int, item: Demonstration) -> Trimmed:
    try:
        return trimmed(item)
    except BadInputError as error:
        raise BadInputError(f"demonstration {index}: {error}") from error


def _reachable(config: Configuration, poses: pose.Array) -> bool:
    parts = (poses[begin : begin + _AT_ONCE] for begin in range(0, len(poses), _AT_ONCE))
    return not any(
        np.isnan(config.robot.inverse_batch(part, np.tile(config.robot.home, (len(part), 1)))).any() for part in parts
    )
