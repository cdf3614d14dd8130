"""The pipeline that commands share: each stage makes what is missing and keeps it in the run folder."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.artifact import described
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.generate import DemonstrationSettings, Generated, generate
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.demonstrations.recordings.recording import NOTHING, ImportSettings
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.files import write_json
from koopdqn.intent.detour import around_obstacles
from koopdqn.intent.fit import Fitted, agent_steps, fit
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.storage import StoredIntent, read_intent
from koopdqn.pose import POSITION, Array
from koopdqn.run_folder import DEMONSTRATIONS, FIT, FIT_PICTURE, INTENT
from koopdqn.tasks.workcell import Workcell, open_workcell

if TYPE_CHECKING:
    from koopdqn.robot.scene import Scene
    from koopdqn.view.motions import Motion

_SHORT = 0.7
"""A model's way that is so much shorter than the demonstrations leaves part of them out; people's that do not come back
over the same place are at 0.82 and more."""


def declared(config: Configuration) -> ImportSettings:
    """Return what is declared of the files that are given; of the copy that a folder keeps nothing is left to say."""
    return config.import_ if config.inputs.demos else NOTHING


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
        demonstrations = new_demonstrations(config, workcell).demonstrations
    check_kept(kept, demonstrations, sources)
    if not kept.exists():
        write_hdf5(kept, demonstrations)
    return demonstrations


def demonstrations_read(config: Configuration, sources: Sequence[str]) -> Demonstrations:
    """Return the demonstrations of files, which the arm can reach.

    Raises:
        BadInputError: a file is damaged or of another task, or the arm cannot reach all of it.
    """
    demonstrations = read_demonstrations(sources, config.task.name, config.robot, declared=declared(config))
    for index, poses in enumerate(agent_steps(demonstrations, config.task)):
        lost = np.isnan(config.robot.inverse_batch(poses, np.tile(config.robot.home, (len(poses), 1)))).any(axis=1)
        if lost.any():
            raise BadInputError(
                f"demos: demonstration {index} must stay within the arm's reach, found"
                f" {np.round(poses[lost.argmax(), POSITION], 3).tolist()} m"
            )
    return demonstrations


def check_kept(kept: Path, demonstrations: Demonstrations, sources: Sequence[str]) -> None:
    """Raise BadInputError if a run folder holds other demonstrations already than those of the sources."""
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


def new_demonstrations(config: Configuration, workcell: Workcell) -> Generated:
    """Return the scripted person's demonstrations; BadInputError if another is to demonstrate."""
    check_scripted(config)
    return generated("Demonstrating", workcell, config.demo, config.inputs.seed)


def generated(title: str, workcell: Workcell, settings: DemonstrationSettings, seed: int) -> Generated:
    """Return new demonstrations of the scripted person; a bar with the title shows how far it has come."""
    with console.stage(title, settings.count) as stage:
        clear = workcell.without_obstacles()
        return generate(clear.task, clear.reachability, settings, seed, lambda done: stage.advance())


def check_scripted(config: Configuration) -> None:
    """Raise BadInputError if a person is to demonstrate, which ``koopdqn demo`` alone lets them do."""
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
    write_json(folder / FIT, fitted.report)
    plot_fit(folder / FIT_PICTURE, fitted, demonstrations, config.task)
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


def as_fitted(config: Configuration, intent: StoredIntent, folder: Path) -> Configuration:
    """Return a config with the settings that an intent and its trust domain were fitted with.

    Raises:
        BadInputError: they are other settings than the config's, and the intent is none of ``intent=FILE``.
    """
    own = {"intent": intent.settings, "trust": intent.trust.settings}
    other = [name for name, settings in own.items() if described(settings) != described(getattr(config, name))]
    if other and config.inputs.intent_file is None:
        raise BadInputError(
            f"{' and '.join(other)}: must be as the intent was fitted that the run holds already, found other settings;"
            f" intent={console.shown_path(folder / INTENT)} takes the run's own"
        )
    if other:
        console.note(f"{' and '.join(other)}: as the intent was fitted, from which the config differs")
    return replace(config, intent=intent.settings, trust=intent.trust.settings)


def reward_of(
    config: Configuration, workcell: Workcell, intent: StoredIntent | Fitted, trajectories: list[Array]
) -> IntentReward:
    """Return the reward function (Eqs. 15, 16) of an intent, bent around obstacles of the task.

    ``trajectories`` are demonstrated poses (N, 7) at the agent's step.

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
