"""Making the task from demonstrations, where the config leaves it to them."""

from dataclasses import replace
from pathlib import Path

from koopdqn import console
from koopdqn.commands.configuration import Configuration
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.derivation import Derivation, Derived
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.demonstrations.placement import blocked_at, found_placement
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.environment.reachability import Reachability
from koopdqn.errors import BadInputError
from koopdqn.intent.fitting import agent_steps
from koopdqn.robot.scene import build_scene
from koopdqn.tasks.demonstrated import DemonstratedTask

DEMONSTRATIONS = "demos.hdf5"


def with_task(config: Configuration, folder: Path, *, keep: bool) -> Configuration:
    """Return a config whose task is made, if it must be, from ``demos=`` or what a folder holds; say what was found.

    Args:
        config: the config.
        folder: whose ``demos.hdf5`` holds the demonstrations as they were read, and moved if that was asked for, the
            ones kept for evaluation marked.
        keep: whether to write that file if there is none.

    Raises:
        BadInputError: there are no demonstrations, they are not those the folder holds, they show no task, or the arm
            cannot follow one of them.
    """
    recipe = config.chosen
    if not isinstance(recipe, Derivation):
        return config
    kept = folder / DEMONSTRATIONS
    sources = config.inputs.demos or ((str(kept),) if kept.exists() else ())
    if not sources:
        raise BadInputError(
            f"demos: must name the files that task {recipe.name} is made from (HDF5 or CSV; one, several in brackets,"
            " or a glob), found none"
        )
    read = read_demonstrations(sources, recipe.name, config.robot.name, any_task=True)
    read = replace(read, held_out=recipe.kept_of(len(read)))
    derived = recipe.derive(read)
    if recipe.place == "auto" and read.placement is None:
        read, derived = _placed(config, recipe, read, derived)
    if read.placement is not None:
        console.note(f"task {recipe.name}: demonstrations {read.placement}")
    if kept.exists() and read_hdf5(kept).digest() != read.digest():
        raise BadInputError(f"demos: must be those that the run holds in {kept}, found others in {', '.join(sources)}")
    for line in derived.notes:
        console.note(f"task {recipe.name}: {line}")
    _check_followed(config, derived.task)
    if keep and not kept.exists():
        write_hdf5(kept, read)
    return replace(config, derived=derived)


def _placed(
    config: Configuration, recipe: Derivation, read: Demonstrations, derived: Derived
) -> tuple[Demonstrations, Derived]:
    """Return demonstrations moved to where the arm can follow them, and the task made from them."""
    task = derived.task
    aside = agent_steps(replace(derived.training, items=derived.held_out), task) if derived.held_out else []
    moved = found_placement(_arm_in(config, task), [*task.trajectories, *aside]).moved(read)
    return moved, recipe.derive(moved)


def _check_followed(config: Configuration, task: DemonstratedTask) -> None:
    reachability = _arm_in(config, task)
    for index, poses in enumerate(task.trajectories):
        blocked = blocked_at(reachability, poses)
        if blocked:
            raise BadInputError(
                f"demos: the arm must be able to follow every demonstration, found demonstration {index} stopped after"
                f" {blocked}; demos.place=auto moves all of them to where it can"
            )


def _arm_in(config: Configuration, task: DemonstratedTask) -> Reachability:
    """Return the arm in the task's scene, in the posture in which episodes begin if it can take the nominal start."""
    scene, seconds = build_scene(task, config.robot), config.robot.step_seconds
    posture = Reachability(config.robot, scene, seconds).enter(task.nominal_start).joints
    return Reachability(config.robot, scene, seconds, posture)
