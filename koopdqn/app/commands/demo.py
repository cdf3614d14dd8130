"""``koopdqn demo``: demonstrations of a task, by its script or by a person at the keyboard."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn import console
from koopdqn.app.commands import stages
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.stages import DEMONSTRATIONS
from koopdqn.app.result import CommandResult
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.pose import POSITION
from koopdqn.tasks.workcell import Workcell


def run(config: Configuration, folder: Path) -> CommandResult:
    """Generate or record demonstrations into ``demos.hdf5`` and draw them in ``demos.png``."""
    if config.demo.source == "keyboard":
        return _recorded(config, folder)
    if config.inputs.run is not None:
        raise BadInputError(
            f"run: must name a folder of demonstrations recorded with source=keyboard, which can go on,"
            f" found source={config.demo.source} in {str(config.inputs.run)!r}"
        )
    workcell = stages.open_scene(config)
    demonstrations, redrawn = stages.new_demonstrations(config, workcell)
    write_hdf5(folder / DEMONSTRATIONS, demonstrations)
    return _result(config, folder, workcell, demonstrations, {"redrawn": redrawn})


def _recorded(config: Configuration, folder: Path) -> CommandResult:
    from koopdqn.app.recording.recorder import Recording
    from koopdqn.app.recording.terminal import RecordingScreen, check_keyboard

    check_keyboard(config.demo.keyboard.graphics)
    workcell = stages.open_scene(config)
    path = folder / DEMONSTRATIONS
    with closing(Recording(workcell, config.demo, config.inputs.seed, folder, DEMONSTRATIONS)) as recording:
        RecordingScreen(recording, workcell, config.demo.keyboard.graphics, console.shown_path(path)).run()
    moves, demonstrations = recording.recorder.state.moves, recording.demonstrations()
    goes_on = f"koopdqn demo run={console.shown_path(folder)} goes on"
    if demonstrations is None:
        raise WorkFailedError(f"no demonstration was kept: e marks the end of one; {goes_on} ({moves} moves under way)")
    remarks = [f"{moves} moves are under way; {goes_on}"] if moves else []
    refused = _off_goal(config, demonstrations)
    if refused:
        remarks.append(
            f"fit and train of task {config.task.name} refuse this file: {refused}; task=demonstrated takes other goals"
        )
    return _result(config, folder, workcell, demonstrations, {"moves_under_way": moves}, remarks)


def _off_goal(config: Configuration, demonstrations: Demonstrations) -> str:
    """Return which demonstrations end away from the goal, for people; empty if none does."""
    ends = config.task.reached(np.array([item.poses[-1] for item in demonstrations.items]))
    away = [str(index) for index, reached in enumerate(ends) if not reached]
    return f"demonstration{'s' if len(away) > 1 else ''} {', '.join(away)} ended off the goal" if away else ""


def _result(
    config: Configuration,
    folder: Path,
    workcell: Workcell,
    demonstrations: Demonstrations,
    more: dict[str, Any],
    remarks: list[str] | None = None,
) -> CommandResult:
    """Draw the demonstrations and return what is told of them."""
    from koopdqn.plots.demos import plot_demonstrations

    path = folder / DEMONSTRATIONS
    paths = [item.poses[:, POSITION] for item in demonstrations.items]
    image = stages.picture(workcell.scene, demonstrations.items[0].joints, paths)
    plot_demonstrations(folder / "demos.png", demonstrations, config.task, image)
    result = {
        "task": config.task.name,
        "seed": config.inputs.seed,
        "source": config.demo.source,
        "demonstrations": len(demonstrations),
        "samples": [len(item) for item in demonstrations.items],
        "seconds": [float(item.times[-1]) for item in demonstrations.items],
        **more,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    total = sum(len(item) for item in demonstrations.items)
    count = f"{len(demonstrations)} demonstration{'s' if len(demonstrations) > 1 else ''}"
    return CommandResult(
        result,
        [
            f"{count} of task {config.task.name}, {total} samples",
            *(remarks or []),
            f"demonstrations  {console.shown_path(path)}",
            f"picture         {console.shown_path(folder / 'demos.png')}",
        ],
    )
