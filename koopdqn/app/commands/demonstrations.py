"""``koopdqn demo`` and ``export``: demonstrations made, and written as CSV."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn import console, pose
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.importing import sources_of
from koopdqn.app.commands.pipeline import DEMONSTRATIONS
from koopdqn.app.hydra.application import CommandResult
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.tasks.workcell import Workcell


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
    count = console.counted(len(demonstrations), "demonstration")
    lines = [
        f"{count} of task {config.task.name}, {sum(samples)} samples",
        *remarks,
        f"demonstrations  {console.shown_path(path)}",
        f"picture         {console.shown_path(folder / 'demos.png')}",
    ]
    return CommandResult(result, lines)


def export(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.csv``, or the path that ``run=`` learned as a robot program."""
    if config.inputs.run is not None:
        from koopdqn.app.commands.program import export_program

        return export_program(config, config.inputs.run, folder)
    sources = sources_of(config, "export")
    demonstrations = read_demonstrations(
        sources, config.chosen.name, config.robot, any_task=True, declared=config.import_
    )
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
