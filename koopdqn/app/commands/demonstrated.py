"""A task made of demonstrations: read, cleaned, moved to where the arm can follow them, and turned into a task."""

from dataclasses import replace
from pathlib import Path

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.pipeline import check_kept, declared
from koopdqn.demonstrations.cleaning import without_outliers
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations, blocked_at, find_placement
from koopdqn.demonstrations.derivation import Derivation, Derived
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import agent_steps
from koopdqn.pose import Array
from koopdqn.run_folder import DEMONSTRATIONS
from koopdqn.tasks.demonstrated import DemonstratedTask
from koopdqn.tasks.workcell import Reachability, build_scene, reachability_in


def with_task(config: Configuration, folder: Path | None, *, keep: bool) -> Configuration:
    """Return the config with its task made from demonstrations if the option is a recipe; tell what was found.

    Args:
        config: the config.
        folder: whose ``demos.hdf5`` holds the demonstrations as they were read, and moved if that was asked for, the
            ones kept for evaluation marked; None for no folder.
        keep: whether to write that file if there is none.

    Raises:
        BadInputError: there are no demonstrations, they are not those the folder holds, they show no task, or the arm
            cannot follow one of them.
    """
    recipe = config.chosen
    if not isinstance(recipe, Derivation):
        return config
    kept = None if folder is None else folder / DEMONSTRATIONS
    sources = config.inputs.demos or ((str(kept),) if kept is not None and kept.exists() else ())
    if not sources:
        raise BadInputError(
            f"demos: must name the files that task {recipe.name} is made from (one, several in brackets, or a glob)"
            ", found none"
        )
    read = read_demonstrations(sources, recipe.name, config.robot, any_task=True, declared=declared(config))
    if config.inputs.demos:
        # Not in a run's own copy: what it was made from must stay what it is.
        read = _sound(recipe, read)
    read = replace(read, held_out=recipe.kept_of(len(read)))
    learning = {"continuous": config.agent.continuous, "unfolds": config.intent.unfolds}
    derived = recipe.derive(read, **learning)
    if recipe.place == "auto" and read.placement is None:
        trajectories = [*derived.task.trajectories, *_held_out_as_task(derived)]
        read = find_placement(_arm_in(config, derived.task), trajectories).moved(read)
        derived = recipe.derive(read, **learning)
    if kept is not None:
        check_kept(kept, read, sources)
    if config.inputs.demos:
        # Of a run's own copy this was told before.
        moved = [] if read.placement is None else [f"demonstrations {read.placement}"]
        for line in (*moved, *derived.notes):
            console.note(f"task {recipe.name}: {line}")
    _check_followed(config, derived)
    if keep and kept is not None and not kept.exists():
        write_hdf5(kept, read)
    return replace(config, derived=derived)


def _sound(recipe: Derivation, read: Demonstrations) -> Demonstrations:
    """Return demonstrations without samples that are certainly bad, and say how many there were."""
    sound = [without_outliers(item) for item in read.items]
    lost = [len(one) - len(rest) for one, rest in zip(read.items, sound, strict=True)]
    if any(lost):
        listed = ", ".join(str(index) for index, count in enumerate(lost) if count)
        console.note(
            f"task {recipe.name}: samples far off their neighbours left out: {sum(lost)}, in demonstrations {listed}"
        )
    return replace(read, items=sound)


def _held_out_as_task(derived: Derived) -> list[Array]:
    """Return the held-out demonstrations, poses (N, 7) at the agent's step, oriented as the task's own."""
    if not derived.held_out:
        return []
    items = [Demonstration(item.times, derived.task.as_held(item.poses)) for item in derived.held_out]
    return agent_steps(replace(derived.training, items=items), derived.task)


def _check_followed(config: Configuration, derived: Derived) -> None:
    task = derived.task
    reachability = _arm_in(config, task)
    for index, poses in enumerate([*task.trajectories, *_held_out_as_task(derived)]):
        blocked = blocked_at(reachability, poses)
        if blocked and index < len(task.trajectories):
            raise BadInputError(
                f"demos: the arm must be able to follow every demonstration, found demonstration {index} stopped after"
                f" {blocked}; demos.place=auto moves all of them to where it can"
            )
        if blocked:
            console.note(
                f"task {task.name}: the arm cannot follow demonstration {index}, kept for evaluation, in the posture in"
                f" which it follows those learned from, stopped after {blocked}"
            )


def _arm_in(config: Configuration, task: DemonstratedTask) -> Reachability:
    """Return the arm in the task's scene without obstacles, which stand where demonstrations went."""
    clear = task.without_obstacles()
    return reachability_in(build_scene(clear, config.robot), clear, config.robot)
