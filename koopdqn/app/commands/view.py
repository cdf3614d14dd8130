"""``koopdqn view``: a trained run, or recordings before anything is trained, as a page to look at."""

from pathlib import Path
from typing import Any, Final

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration, scaled
from koopdqn.app.commands.demonstrated import with_task
from koopdqn.app.commands.demonstrations import sources_of
from koopdqn.app.commands.trained import feedback_of, read_trained
from koopdqn.app.hydra.application import CommandResult
from koopdqn.app.hydra.compose import composed
from koopdqn.demonstrations.derivation import Derivation
from koopdqn.demonstrations.reading import read_files, together
from koopdqn.errors import BadInputError
from koopdqn.pose import POSITION
from koopdqn.resources import conf_dir
from koopdqn.robot.scene import SceneBuilder
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Reachability, build_scene
from koopdqn.view.film import check_film
from koopdqn.view.motions import demonstrated_motions, learned_motions
from koopdqn.view.page import Shown, write_page
from koopdqn.view.window import KEYS, check_display, watch

_FOLLOWED: Final = 12
"""Demonstrations that the arm follows; further ones are drawn as lines."""
_TOLD_FROM_ONE: Final = ("the trust domain is drawn where it lies for a path from the nominal start",)
_MADE_FROM_FILES: Final = "demonstrated"


def run(config: Configuration, folder: Path) -> CommandResult:
    """Write ``view.html`` of the run of ``run=``, or of the demonstrations of ``demos=``, and a film if asked for."""
    source, video = config.inputs.run, config.view.video
    if video is not None:
        if source is None:
            raise BadInputError(f"video: needs a trained run to show, found demos= alone and {str(video)!r}")
        check_film(video, "video")
    if config.view.window:
        check_display()
    shown = _of_demonstrations(config, folder) if source is None else _of_run(config, source)
    page = write_page(folder, shown.content())
    motions = [{"name": motion.name, "kind": motion.kind, "remark": motion.remark} for motion in shown.motions]
    lines = [*shown.lines, f"page  {console.shown_path(page)}"]
    if video is not None:
        learned = shown.motions[0]
        demonstrated = [motion for motion in shown.motions if motion.kind == "demonstration"]
        pipeline.film(video, shown.scene, learned, demonstrated)
        lines.append(f"film  {console.shown_path(video)}")
    if config.view.window:
        console.note(f"MuJoCo's viewer, until you close it: {KEYS}")
        watch(shown)
    result: dict[str, Any] = {
        "page": str(page),
        "video": None if video is None else str(video),
        "run": None if source is None else str(source),
        "motions": motions,
    }
    return CommandResult(result, lines)


def _of_run(config: Configuration, source: Path) -> Shown:
    run = read_trained(config, source)
    feedback = feedback_of(config, run, source)
    starts, cell = min(config.view.starts, config.eval.episodes), run.workcell
    with console.stage("Moving the arm"):
        learned = learned_motions(
            cell, run.policy, feedback, config.eval, starts, run.step_limit, referred=run.referred
        )
        clear = cell.without_obstacles().reachability
        # A film shows the one of all that begins nearest.
        followed = _FOLLOWED if config.view.video is None else len(run.demonstrations)
        shown = demonstrated_motions(run.demonstrations.items, clear, config.task, followed)
    return Shown(
        f"koopdqn: task {config.task.name}",
        (
            f"run {console.shown_path(source)}",
            f"{len(run.demonstrations)} demonstrations, {starts} held-out starts of seed {config.eval.seed}",
            f"rule: {config.task.rule}",
            *_first_of(len(run.demonstrations), followed),
            *(_TOLD_FROM_ONE if feedback.reward.model.start_frame.follows else ()),
            *(" ".join(remark) for remark in run.beside),
            *(f"{motion.name}: {motion.remark}" for motion in learned if motion.fails),
        ),
        cell.scene,
        [*learned, *shown],
        [item.poses[:, POSITION] for item in run.demonstrations.items],
        feedback.reward.trust.drawn(feedback.reward.model.start_frame),
        config.task.goal,
    )


def _of_demonstrations(config: Configuration, folder: Path) -> Shown:
    sources = sources_of(config, "show")
    read = read_files(sources, config.import_, config.robot)
    demonstrations = together(read, config.chosen.name, config.robot.name, any_task=True, cut=bool(config.import_.cut))
    task = _task_of(config, read[0].task)
    if isinstance(config.chosen, Derivation) and config.chosen.place == "auto":
        moved = with_task(config, folder, keep=False)
        placement, task = pipeline.demonstrations_of(moved, folder).placement, moved.task
        demonstrations = demonstrations if placement is None else placement.moved(demonstrations)
    scene = SceneBuilder(config.robot).build() if task is None else build_scene(task, config.robot)
    posture = None
    if task is not None:
        posture = Reachability(config.robot, scene).enter(task.nominal_start).joints
    reachability = Reachability(config.robot, scene, posture)
    with console.stage("Moving the arm"):
        shown = demonstrated_motions(demonstrations.items, reachability, task, _FOLLOWED)
    count = console.counted(len(demonstrations), "demonstration")
    samples = sum(len(item) for item in demonstrations.items)
    stopped = [f"{motion.name}: {motion.remark}" for motion in shown if len(motion.joints) < len(motion.poses)]
    return Shown(
        f"koopdqn: {count}" + ("" if task is None else f" of task {task.name}"),
        (", ".join(sources), f"{samples} samples", *_first_of(len(demonstrations)), *stopped),
        scene,
        shown,
        [item.poses[:, POSITION] for item in demonstrations.items],
        None,
        None if task is None else task.goal,
    )


def _first_of(count: int, followed: int = _FOLLOWED) -> list[str]:
    return [f"the arm follows the first {followed} of {count} demonstrations"] if count > followed else []


def _task_of(config: Configuration, name: str | None) -> Task | None:
    """Return the task that was given, or the one of a name that files say; None where koopdqn does not know it."""
    if isinstance(config.chosen, Task):
        return config.chosen
    # The name is a file's own text: nothing but an option of koopdqn's may come of it.
    known = {option.stem for option in (conf_dir() / "task").glob("*.yaml")} - {_MADE_FROM_FILES}
    if name not in known:
        return None
    unscaled = Configuration.load(composed([f"task={name}", "out=unused"])).task
    return scaled(unscaled, config.robot)
