"""The pipeline that commands share: each stage makes what is missing and keeps it in the run folder."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.artifact import described, read_artifact, reading
from koopdqn.demonstrations.cleaning import without_outliers
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations, blocked_at, find_placement
from koopdqn.demonstrations.derivation import Derivation, Derived
from koopdqn.demonstrations.generate import DemonstrationSettings, Generated, generate
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.demonstrations.recordings.recording import NOTHING, ImportSettings
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.files import write_json
from koopdqn.intent.detour import around_obstacles
from koopdqn.intent.fit import Fitted, agent_steps, fit
from koopdqn.intent.reward import IntentReward, RewardSettings
from koopdqn.intent.storage import StoredIntent, read_intent
from koopdqn.pose import POSITION, Array
from koopdqn.robot.arm import Arm
from koopdqn.robot.mjcf import MjcfArm
from koopdqn.settings import TARGET, load_settings
from koopdqn.tasks.demonstrated import DemonstratedTask
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Reachability, Workcell, build_scene, open_workcell, reachability_in

if TYPE_CHECKING:
    from koopdqn.robot.scene import Scene
    from koopdqn.view.motions import Motion

DEMONSTRATIONS = "demos.hdf5"
INTENT = "intent.npz"
POLICY = "policy.safetensors"
_SHORT = 0.8
"""A model's way that is so much shorter than the demonstrations leaves part of them out; people's that do not come back
over the same place are at 0.92 and more."""


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
    read = read_demonstrations(sources, recipe.name, config.robot, any_task=True, declared=_declared(config))
    if config.inputs.demos:
        # Not in a run's own copy: what it was made from must stay what it is.
        read = _sound(recipe, read)
    read = replace(read, held_out=recipe.kept_of(len(read)))
    derived = recipe.derive(read, continuous=config.agent.continuous)
    if recipe.place == "auto" and read.placement is None:
        read, derived = _placed(config, recipe, read, derived)
    if read.placement is not None:
        console.note(f"task {recipe.name}: demonstrations {read.placement}")
    if kept is not None:
        _check_kept(kept, read, sources)
    for line in derived.notes:
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


def _declared(config: Configuration) -> ImportSettings:
    """Return what is declared of the files that are given; of the copy that a folder keeps nothing is left to say."""
    return config.import_ if config.inputs.demos else NOTHING


def _placed(
    config: Configuration, recipe: Derivation, read: Demonstrations, derived: Derived
) -> tuple[Demonstrations, Derived]:
    """Return demonstrations moved to where the arm can follow them, and the task made from them."""
    task = derived.task
    moved = find_placement(_arm_in(config, task), [*task.trajectories, *_held_out_as_task(derived)]).moved(read)
    return moved, recipe.derive(moved, continuous=config.agent.continuous)


def _held_out_as_task(derived: Derived) -> list[Array]:
    """Return the held-out demonstrations, poses (N, 7) at the agent's step, oriented as the task's own."""
    if not derived.held_out:
        return []
    items = [Demonstration(item.times, derived.task.as_held(item.poses)) for item in derived.held_out]
    return agent_steps(replace(derived.training, items=items), derived.task)


def _check_followed(config: Configuration, derived: Derived) -> None:
    task = derived.task
    reachability = _arm_in(config, task)
    for index, poses in enumerate(task.trajectories):
        blocked = blocked_at(reachability, poses)
        if blocked:
            raise BadInputError(
                f"demos: the arm must be able to follow every demonstration, found demonstration {index} stopped after"
                f" {blocked}; demos.place=auto moves all of them to where it can"
            )
    for index, poses in enumerate(_held_out_as_task(derived), len(task.trajectories)):
        blocked = blocked_at(reachability, poses)
        if blocked:
            console.note(
                f"task {task.name}: the arm cannot follow demonstration {index}, kept for evaluation, stopped after"
                f" {blocked}"
            )


def _arm_in(config: Configuration, task: DemonstratedTask) -> Reachability:
    """Return the arm in the task's scene without obstacles, which stand where demonstrations went."""
    clear = task.without_obstacles()
    return reachability_in(build_scene(clear, config.robot), clear, config.robot)


def as_trained(config: Configuration, run: Path) -> Configuration:
    """Return a config with the task, arm and reward that a run was trained with, as its policy's file holds them.

    They may differ from the config because koopdqn's defaults have changed since. What the command line changes
    stays changed, and whether it fits the policy is for others to say.

    Raises:
        BadInputError: the file is missing, damaged, or holds what this release does not know.
    """
    policy = run / POLICY
    about = read_artifact(policy, "policy").about
    taken, found = ("continuous" if each else "table1" for each in ("actions" in about, config.agent.continuous))
    if taken != found:
        raise BadInputError(f"actions: must be those of the run's policy, {taken}, found {found}")
    with reading(f"policy {policy}"):
        task = load_settings(about["task"], Task, "task")
        robot: Any = load_settings({**about["robot"], **_place_of(config.robot, about["robot"])}, Arm, "robot")
        reward = load_settings(about["reward"], RewardSettings, "reward")
    if not task.obstacles:
        # They may be added to any task.
        task = task.model_copy(update={"obstacles": config.task.obstacles})
    trained = {"task": task, "robot": robot, "reward": reward}
    changed = [name for name, each in trained.items() if described(each) != described(getattr(config, name))]
    if not changed:
        return config
    recorded = composed(prepare("eval", [f"run={run}"]).overrides)
    if config.task.obstacles and not about["task"].get("obstacles"):
        recorded.task.obstacles = described(config.task)["obstacles"]
    default = with_task(Configuration.load(recorded), run, keep=False)
    own = [name for name in changed if described(getattr(default, name)) == described(getattr(config, name))]
    for name in own:
        console.note(f"{name}: as in the run, from which today's defaults differ")
    if "task" in own and config.derived is None:
        config = replace(config, chosen=task)
    elif "task" in own and config.derived is not None and isinstance(task, DemonstratedTask):
        task = task.showing(agent_steps(config.derived.training, task))
        config = replace(config, derived=replace(config.derived, task=task))
    return replace(
        config,
        robot=robot if "robot" in own else config.robot,
        reward=reward if "reward" in own else config.reward,
    )


def differs_from_trained(robot: Arm, trained: Mapping[str, Any]) -> bool:
    """Return whether an arm is another than the one that a policy's file says it was trained with."""
    mine: Any = robot
    its: Any = load_settings({**trained, **_place_of(robot, trained)}, Arm, "robot")
    return described(mine) != described(its)


def _place_of(robot: Arm, trained: Mapping[str, Any]) -> dict[str, Any]:
    """Return where the MJCF file of a trained arm lies, which its policy does not hold."""
    mine = isinstance(robot, MjcfArm) and trained.get(TARGET) == described(robot)[TARGET]
    return {"path": robot.mjcf} if mine else {}


def open_scene(config: Configuration) -> Workcell:
    """Return the workcell of a config."""
    return open_workcell(config.task, config.robot)


def demonstrations_for(config: Configuration, workcell: Workcell, folder: Path) -> Demonstrations:
    """Return the demonstrations of ``demos=``, or those of the run folder, or new ones; the folder keeps them.

    Raises:
        BadInputError: the file is damaged, of another task, or not what the run folder holds already.
    """
    if config.derived is not None:
        return config.derived.training
    kept = folder / DEMONSTRATIONS
    sources = config.inputs.demos or ((str(kept),) if kept.exists() else ())
    if sources:
        demonstrations = demonstrations_read(config, sources)
    else:
        demonstrations, _ = new_demonstrations(config, workcell)
    _check_kept(kept, demonstrations, sources)
    if not kept.exists():
        write_hdf5(kept, demonstrations)
    return demonstrations


def demonstrations_read(config: Configuration, sources: Sequence[str]) -> Demonstrations:
    """Return the demonstrations of files, which the arm can reach.

    Raises:
        BadInputError: a file is damaged or of another task, or the arm cannot reach all of it.
    """
    demonstrations = read_demonstrations(sources, config.task.name, config.robot, declared=_declared(config))
    _check_reach(config, demonstrations)
    return demonstrations


def _check_kept(kept: Path, demonstrations: Demonstrations, sources: Sequence[str]) -> None:
    if kept.exists() and read_hdf5(kept).digest() != demonstrations.digest():
        raise BadInputError(f"demos: must be those that the run holds in {kept}, found others in {', '.join(sources)}")


def demonstrations_of(config: Configuration, run: Path) -> Demonstrations:
    """Return the demonstrations that the run in a folder learned from.

    Raises:
        BadInputError: the file is missing or damaged.
    """
    return read_hdf5(run / DEMONSTRATIONS) if config.derived is None else config.derived.training


def held_out_of(config: Configuration) -> list[Array] | None:
    """Return the held-out demonstrations, poses (N, 7) at the agent's step; None unless the task is made from some."""
    if config.derived is None:
        return None
    aside = config.derived.held_out
    return agent_steps(replace(config.derived.training, items=aside), config.task) if aside else []


def _check_reach(config: Configuration, demonstrations: Demonstrations) -> None:
    for index, poses in enumerate(agent_steps(demonstrations, config.task)):
        lost = np.isnan(config.robot.inverse_batch(poses, np.tile(config.robot.home, (len(poses), 1)))).any(axis=1)
        if lost.any():
            raise BadInputError(
                f"demos: demonstration {index} must stay within the arm's reach, found"
                f" {np.round(poses[lost.argmax(), POSITION], 3).tolist()} m"
            )


def new_demonstrations(config: Configuration, workcell: Workcell) -> tuple[Demonstrations, dict[str, int]]:
    """Return generated demonstrations and how many draws per reason were drawn again.

    Raises:
        BadInputError: a person is to demonstrate, which ``koopdqn demo`` alone lets them do.
    """
    check_scripted(config)
    made = generated("Demonstrating", workcell, config.demo, config.inputs.seed)
    return made.demonstrations, made.redrawn


def generated(title: str, workcell: Workcell, settings: DemonstrationSettings, seed: int) -> Generated:
    """Return new demonstrations of the scripted person; a bar with the title shows how far it has come."""
    with console.stage(title, settings.count) as stage:
        clear = workcell.without_obstacles()
        return generate(clear.task, clear.reachability, settings, seed, lambda done: stage.advance())


def check_scripted(config: Configuration) -> None:
    """Check that demonstrations may be generated.

    Raises:
        BadInputError: a person is to demonstrate, which ``koopdqn demo`` alone lets them do.
    """
    if config.demo.source != "scripted":
        raise BadInputError(
            "demo.source: must be scripted where demonstrations are made by themselves, found"
            f" {config.demo.source}; record with koopdqn demo, then demos=FILE"
        )


def fitted_intent(
    config: Configuration, demonstrations: Demonstrations, folder: Path, fresh: Demonstrations | None = None
) -> tuple[StoredIntent, Fitted]:
    """Fit the intent model, write ``intent.npz``, ``fit.json`` and ``fit.png`` and return both forms of it."""
    from koopdqn.plots.fit import plot_fit

    with console.stage("Fitting the intent", len(demonstrations)) as stage:
        fitted = fit(
            demonstrations, config.task, config.intent, config.trust, config.reward, lambda done: stage.advance(), fresh
        )
    for line in _doubts(fitted.report):
        console.warn(line)
    stored = StoredIntent(fitted.model, fitted.trust, config.intent, demonstrations.digest())
    write_json(folder / "fit.json", fitted.report)
    plot_fit(folder / "fit.png", fitted, demonstrations, config.task)
    # Last, since a run that goes on takes this file as the sign that all was made.
    stored.write(folder / INTENT, config.task)
    return stored, fitted


def _doubts(report: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a fit's report says against learning from it."""
    if not report["converges"]:
        yield (
            "the model does not converge: followed from the demonstrated region it comes to the goal from"
            f" {report['converging_share']:.1%} of the starts only"
        )
    if report["length_ratio"] < _SHORT:
        yield (
            f"the model's own way to the goal is {report['length_ratio']:.0%} as long as the demonstrations: where they"
            " come back over the same place, all but the last passage is left out; cut them into motions that do not"
        )


def intent_for(config: Configuration, demonstrations: Demonstrations, folder: Path) -> StoredIntent:
    """Return the intent of ``intent=FILE``, or that of the run folder, or a newly fitted one; the folder keeps it.

    Raises:
        BadInputError: the file is damaged, was fitted to another task or other demonstrations, or is not what
            the run folder holds already.
    """
    kept = folder / INTENT
    source = config.inputs.intent_file
    if source is None and kept.exists():
        source = kept
    if source is None:
        return fitted_intent(config, demonstrations, folder)[0]
    stored = read_intent(source, config.task)
    if stored.demonstrations != demonstrations.digest():
        raise BadInputError(f"intent {source}: must be fitted to the demonstrations used, found it fitted to others")
    if not kept.exists():
        stored.write(kept, config.task)
    elif source != kept and read_intent(kept, config.task).digest() != stored.digest():
        raise BadInputError(f"intent: must be the one that the run holds in {kept}, found another in {source}")
    return stored


def check_intent_file(config: Configuration) -> None:
    """Raise BadInputError if ``intent=FILE`` is damaged or of another task, before anything is made."""
    if config.inputs.intent_file is not None:
        read_intent(Path(config.inputs.intent_file), config.task)


def as_fitted(config: Configuration, intent: StoredIntent) -> Configuration:
    """Return a config with the settings that an intent and its trust domain were fitted with, whatever it had."""
    own = {"intent": intent.settings, "trust": intent.trust.settings}
    other = [name for name, settings in own.items() if described(settings) != described(getattr(config, name))]
    if other:
        console.note(f"{' and '.join(other)}: as the intent was fitted, from which the config differs")
    return replace(config, intent=intent.settings, trust=intent.trust.settings)


def reward_of(
    config: Configuration, workcell: Workcell, intent: StoredIntent | Fitted, trajectories: list[Array]
) -> IntentReward:
    """Return the reward function (Eqs. 15, 16) of an intent, bent around obstacles of the task.

    Args:
        config: gives the task, the settings and the kind of actions.
        workcell: task, arm and scene.
        intent: the fitted intent.
        trajectories: demonstrated poses (N, 7).

    Raises:
        BadInputError: obstacles leave no way.
    """
    made = intent.model, intent.trust, config.reward
    return around_obstacles(
        workcell, IntentReward(config.task, *made, continuous=config.agent.continuous), trajectories
    )


def picture(scene: "Scene", joints: Array | None, paths: list[Array], colours: list[str] | None = None) -> Any:
    """Return a picture of a motion, joints (N, 6), with paths (T, 3) drawn in, or None where nothing can draw it."""
    from koopdqn.plots.style import draw_motion

    if joints is None:
        return None
    try:
        return draw_motion(scene, joints, paths, colours)
    except WorkFailedError as error:
        console.warn(f"no picture of the arm: {error}")
        return None


def film(path: Path, scene: "Scene", learned: "Motion", demonstrated: Sequence["Motion"]) -> None:
    """Write a film of a learned motion beside the demonstration that begins nearest; a bar shows how far it is.

    Raises:
        BadInputError: the file cannot be written.
        WorkFailedError: OpenGL does not work here, the arm can follow no demonstration, or there is no encoder.
    """
    from koopdqn.view.film import FRAMES_PER_SECOND, SECONDS, write_film
    from koopdqn.view.motions import nearest_motion

    beside = nearest_motion(demonstrated, learned.poses[0])
    with console.stage("Filming", SECONDS * FRAMES_PER_SECOND[path.suffix]) as stage:
        write_film(path, scene, learned, beside, stage.advance)
