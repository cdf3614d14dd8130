"""``koopdqn demo``: generate demonstrations of a task."""

from pathlib import Path

from koopdqn import console
from koopdqn.commands import stages
from koopdqn.commands.configuration import Configuration
from koopdqn.commands.deriving import DEMONSTRATIONS
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.pose import POSITION
from koopdqn.result import CommandResult


def run(config: Configuration, folder: Path) -> CommandResult:
    """Generate demonstrations into ``demos.hdf5`` and draw them in ``demos.png``."""
    from koopdqn.plots.demos import plot_demonstrations

    workcell = stages.open_scene(config)
    demonstrations, redrawn = stages.new_demonstrations(config, workcell)
    path = folder / DEMONSTRATIONS
    write_hdf5(path, demonstrations)
    paths = [item.poses[:, POSITION] for item in demonstrations.items]
    image = stages.picture(workcell.scene, demonstrations.items[0].joints, paths)
    plot_demonstrations(folder / "demos.png", demonstrations, config.task, image)
    result = {
        "task": config.task.name,
        "seed": config.inputs.seed,
        "demonstrations": len(demonstrations),
        "samples": [len(item) for item in demonstrations.items],
        "seconds": [float(item.times[-1]) for item in demonstrations.items],
        "redrawn": redrawn,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    total = sum(len(item) for item in demonstrations.items)
    return CommandResult(
        result,
        [
            f"{len(demonstrations)} demonstrations of task {config.task.name}, {total} samples",
            f"demonstrations  {console.shown_path(path)}",
            f"picture         {console.shown_path(folder / 'demos.png')}",
        ],
    )
