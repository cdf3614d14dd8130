"""``koopdqn demo``: generate demonstrations of a task."""

from pathlib import Path

from koopdqn.commands import stages
from koopdqn.commands.configuration import Configuration
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.pose import POSITION
from koopdqn.result import CommandResult


def run(config: Configuration, folder: Path) -> CommandResult:
    """Generate demonstrations into ``demos.hdf5`` and draw them in ``demos.png``."""
    from koopdqn.plots.demos import plot_demonstrations

    workcell = stages.open_scene(config)
    demonstrations, redrawn = stages.new_demonstrations(config, workcell)
    path = folder / stages.DEMONSTRATIONS
    write_hdf5(path, demonstrations)
    last = demonstrations.items[-1]
    paths = [item.poses[:, POSITION] for item in demonstrations.items]
    joints = workcell.reachability.enter(config.task.goal).joints if last.joints is None else last.joints[-1]
    image = None if joints is None else stages.picture(workcell.scene, joints, paths, config)
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
            f"demonstrations  {path}",
            f"picture         {folder / 'demos.png'}",
        ],
    )
