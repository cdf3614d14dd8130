"""``koopdqn demo``, ``import`` and ``export``: demonstrations made, read from a person's files, and written as CSV."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType

from koopdqn import console, pose
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.pipeline import DEMONSTRATIONS
from koopdqn.app.result import CommandResult
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.preprocess import trim_idle_each
from koopdqn.demonstrations.reading import files_of, read_demonstrations
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.paths import arc_lengths
from koopdqn.tasks.workcell import Workcell

_AT_ONCE = 10_000
"""Poses whose joint angles are looked for together."""
_MOST_SHOWN = 100
"""Demonstrations in the table."""


def demo(config: Configuration, folder: Path) -> CommandResult:
    """Generate or record demonstrations into ``demos.hdf5`` and draw them in ``demos.png``."""
    if config.demo.source == "keyboard":
        return _recorded(config, folder)
    if config.inputs.run is not None:
        raise BadInputError(
            f"run: must name a folder of demonstrations recorded with source=keyboard, which can go on,"
            f" found source={config.demo.source} in {str(config.inputs.run)!r}"
        )
    workcell = pipeline.open_scene(config)
    demonstrations, redrawn = pipeline.new_demonstrations(config, workcell)
    write_hdf5(folder / DEMONSTRATIONS, demonstrations)
    return _drawn(config, folder, workcell, demonstrations, {"redrawn": redrawn})


def _recorded(config: Configuration, folder: Path) -> CommandResult:
    from koopdqn.app.recording.screen import RecordingScreen, check_keyboard
    from koopdqn.app.recording.session import Recording

    check_keyboard(config.demo.keyboard.graphics)
    workcell = pipeline.open_scene(config)
    path = folder / DEMONSTRATIONS
    with closing(Recording(workcell, config.demo, config.inputs.seed, folder, DEMONSTRATIONS)) as recording:
        RecordingScreen(recording, workcell, config.demo.keyboard.graphics, console.shown_path(path)).run()
    moves, demonstrations = recording.recorder.state.moves, recording.demonstrations()
    goes_on = f"koopdqn demo run={console.shown_path(folder)} goes on"
    if demonstrations is None:
        raise WorkFailedError(f"no demonstration was kept: e marks the end of one; {goes_on} ({moves} moves under way)")
    remarks = [f"{moves} moves are under way; {goes_on}"] if moves else []
    reached = config.task.reached(np.array([item.poses[-1] for item in demonstrations.items]))
    away = np.flatnonzero(~reached).tolist()
    if away:
        remarks.append(
            f"fit and train of task {config.task.name} refuse this file: demonstration{'s' if len(away) > 1 else ''}"
            f" {', '.join(map(str, away))} ended off the goal; task=demonstrated takes other goals"
        )
    return _drawn(config, folder, workcell, demonstrations, {"moves_under_way": moves}, remarks)


def _drawn(
    config: Configuration,
    folder: Path,
    workcell: Workcell,
    demonstrations: Demonstrations,
    more: dict[str, Any],
    remarks: Sequence[str] = (),
) -> CommandResult:
    """Draw the demonstrations and return what is told of them."""
    from koopdqn.plots.demos import plot_demonstrations

    path = folder / DEMONSTRATIONS
    paths = [item.poses[:, pose.POSITION] for item in demonstrations.items]
    image = pipeline.picture(workcell.scene, demonstrations.items[0].joints, paths)
    plot_demonstrations(folder / "demos.png", demonstrations, config.task, image)
    samples = [len(item) for item in demonstrations.items]
    result = {
        "task": config.task.name,
        "seed": config.inputs.seed,
        "source": config.demo.source,
        "demonstrations": len(demonstrations),
        "samples": samples,
        "seconds": [float(item.times[-1]) for item in demonstrations.items],
        **more,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    count = f"{len(demonstrations)} demonstration{'s' if len(demonstrations) > 1 else ''}"
    lines = [
        f"{count} of task {config.task.name}, {sum(samples)} samples",
        *remarks,
        f"demonstrations  {console.shown_path(path)}",
        f"picture         {console.shown_path(folder / 'demos.png')}",
    ]
    return CommandResult(result, lines)


def _read(config: Configuration, purpose: str) -> tuple[Demonstrations, tuple[str, ...]]:
    """Return the demonstrations of whatever task that ``demos=`` names, and what it names."""
    sources = config.inputs.demos
    if sources is None:
        raise BadInputError(
            f"demos: must name the files to {purpose} (one, several in brackets, or a glob), found none"
        )
    return read_demonstrations(sources, config.chosen.name, config.robot.name, any_task=True), sources


def _reachable(config: Configuration, poses: pose.Array) -> bool:
    parts = (poses[begin : begin + _AT_ONCE] for begin in range(0, len(poses), _AT_ONCE))
    return not any(
        np.isnan(config.robot.inverse_batch(part, np.tile(config.robot.home, (len(part), 1)))).any() for part in parts
    )


def import_(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.hdf5``, sample for sample, and say what is in it."""
    demonstrations, sources = _read(config, "import")
    name, path = config.chosen.name, folder / DEMONSTRATIONS
    cut = trim_idle_each(demonstrations.items)
    reachable = [_reachable(config, each.item.poses) for each in cut]
    lengths = [float(arc_lengths(each.item.poses[:, pose.POSITION])[-1]) for each in cut]
    turns = [float(pose.rotation_distance(each.item.poses[0], each.item.poses[-1])) for each in cut]
    samples = [len(item) for item in demonstrations.items]
    seconds = [float(item.times[-1] - item.times[0]) for item in demonstrations.items]
    write_hdf5(path, demonstrations)
    result = {
        "task": name,
        "files": [str(file) for file in files_of(sources)],
        "demonstrations": len(demonstrations),
        "samples": samples,
        "seconds": seconds,
        "idle_before_seconds": [each.before for each in cut],
        "idle_after_seconds": [each.after for each in cut],
        "length_m": lengths,
        "turn_rad": turns,
        "reachable": reachable,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    rows = [
        (
            str(index),
            str(samples[index]),
            f"{seconds[index]:.2f} s",
            f"{each.before:.2f} s",
            f"{each.after:.2f} s",
            f"{1e3 * lengths[index]:.0f} mm",
            f"{np.degrees(turns[index]):.1f}°",
            "yes" if reachable[index] else "NO",
        )
        for index, each in enumerate(cut[:_MOST_SHOWN])
    ]
    headings = ("demo", "samples", "time", "idle before", "after", "path", "turn", "reached")
    lines: list[RenderableType] = [
        console.table(headings, rows, (), title=f"{len(demonstrations)} demonstrations for task {name}"),
        *([f"and {len(cut) - _MOST_SHOWN} more, which --json lists"] if len(cut) > _MOST_SHOWN else []),
        "idle ends are kept in the file; learning cuts them off",
        f"demonstrations  {console.shown_path(path)}",
    ]
    if not all(reachable):
        console.warn(f"{config.robot.name} cannot reach every pose of demonstration {reachable.index(False)}")
    return CommandResult(result, lines)


def export(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.csv``, or the path that ``run=`` learned as a robot program."""
    if config.inputs.run is not None:
        from koopdqn.app.commands.program import export_program

        return export_program(config, config.inputs.run, folder)
    demonstrations, _ = _read(config, "export")
    if demonstrations.placement is not None:
        console.note(f"moved back to where they were recorded: they had been {demonstrations.placement}")
        demonstrations = demonstrations.placement.undone(demonstrations)
    path = folder / "demos.csv"
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
    lines = [f"{len(demonstrations)} demonstrations, {sum(samples)} samples", f"CSV  {console.shown_path(path)}"]
    return CommandResult(result, lines)
