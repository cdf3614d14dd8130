"""``koopdqn explain``: why a policy does what it does in one state."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich.console import RenderableType

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.trained import TrainedRun, read_trained
from koopdqn.app.result import CommandResult
from koopdqn.errors import BadInputError
from koopdqn.files import write_json
from koopdqn.intent.bend import BentIntent
from koopdqn.intent.fit import agent_steps
from koopdqn.pose import Array
from koopdqn.rl.around import PolicyAround
from koopdqn.tasks.rollout import SUCCESS, Episode, roll_out
from koopdqn.view.explain import drawn_of, explained_actions, left_at, telling_step, trust_of, walked
from koopdqn.view.motions import shown_starts
from koopdqn.view.schema import ExplainFile

if TYPE_CHECKING:
    from rich.table import Table

EXPLANATION = "explain.json"
_TOGETHER: Final = 10
"""Paths made at once in the search for one that fails."""


def run(config: Configuration, folder: Path) -> CommandResult:
    """Explain a state of the run of ``run=``; write ``explain.json`` and ``explain.png``."""
    source, chosen = config.inputs.run, config.explain
    if source is None:
        raise BadInputError("run: must name the folder of a trained run, found none: first `koopdqn train`")
    if config.inputs.actions != "table1":
        raise BadInputError(f"actions: explain tells of the ten actions of Table 1, found {config.inputs.actions}")
    trained = read_trained(config, source)
    policy, bent = trained.policy, isinstance(trained.feedback.reward.model, BentIntent)
    if isinstance(policy, PolicyAround):
        way = "a correction" if policy.policy.bend is not None else "obstacles that it never saw"
        raise BadInputError(f"run: explain tells why a network takes an action, found a policy led around {way}")
    # A scripted person sees no obstacles: their own path leads through them.
    referred = trained.referred and not bent
    with console.stage("Moving the arm"):
        number, episode = _episode(config, trained)
    task, feedback = trained.workcell.task, trained.feedback
    walk = walked(episode, policy, feedback, task, trained.step_limit, referred=referred)
    row, why = telling_step(walk, task)
    if chosen.step is not None and chosen.pose is not None:
        raise BadInputError(f"explain.step: must stand without explain.pose, found step {chosen.step} and a pose")
    if chosen.step is not None:
        row, why = chosen.step, "it was asked for"
        if row > episode.steps:
            raise BadInputError(f"explain.step: must be at most {episode.steps}, the steps of this path, found {row}")
    evaluation, values, joints = walk.evaluation, walk.values[row], episode.joints[row]
    off_path: float | None = 1e3 * float(walk.apart[row])
    here = 0 if chosen.pose is not None else row
    if chosen.pose is not None:
        row, why, off_path = 0, "the pose was given", None
        given, start = np.array(chosen.pose)[None], episode.poses[:1]
        evaluation = feedback.evaluate_actions(given, np.array([row]), start)
        taken = trained.workcell.reachability.enter(given[0])
        if taken.joints is None:
            raise BadInputError(
                f"explain.pose: must be one that the arm can take, found it {taken.reason.replace('_', ' ')}:"
                f" {taken.detail}"
            )
        values, joints = policy.values(given, start)[0], taken.joints
    trajectories = agent_steps(trained.demonstrations, task)
    local = feedback.reward.model.placed(trajectories)
    trusted, trust = trust_of(feedback, evaluation, here)
    content = ExplainFile(
        run=str(source),
        task=task.name,
        start=number,
        outcome=episode.outcome,
        detail=episode.detail,
        steps=episode.steps,
        step=row,
        why_step=why,
        left_at=left_at(walk, task),
        off_path_mm=off_path,
        pose=evaluation.poses[here].tolist(),
        predicted=evaluation.predicted[here].tolist(),
        trusted=trusted,
        trust=trust,
        actions=explained_actions(
            evaluation, here, values, feedback, trained.workcell, local, joints, referred=referred
        ),
    ).model_dump(mode="json")
    write_json(folder / EXPLANATION, content)
    from koopdqn.plots.explain import plot_explanation

    title = f"Task {task.name}, start {number}, step {row} of {episode.steps}\n{why}"
    plot_explanation(folder / "explain.png", title, task, content, **drawn_of(walk, trajectories))
    return CommandResult(content, _lines(content, folder, source))


def _episode(config: Configuration, trained: TrainedRun) -> tuple[int, Episode]:
    """Return the path from the start asked for, or from the first from which the policy fails, with its number."""
    drawn = shown_starts(trained.workcell, config.eval)
    starts, joints = drawn.starts, drawn.joints
    number = config.explain.start
    if number is not None and number >= len(starts):
        raise BadInputError(f"explain.start: must be below eval.episodes ({len(starts)}), found {number}")

    def paths(begun: Array, angles: Array) -> list[Episode]:
        cell = trained.workcell
        return roll_out(trained.policy, cell.task, cell.reachability, begun, angles, trained.step_limit)

    if number is not None:
        return number, paths(starts[number : number + 1], joints[number : number + 1])[0]
    first: Episode | None = None
    for begin in range(0, len(starts), _TOGETHER):
        part = slice(begin, begin + _TOGETHER)
        for index, episode in enumerate(paths(starts[part], joints[part]), begin):
            if episode.outcome != SUCCESS:
                return index, episode
            first = first or episode
    assert first is not None, "there is one start at least"
    return 0, first


def _lines(content: dict[str, Any], folder: Path, source: Path) -> list[RenderableType]:
    outcome = content["outcome"].replace("_", " ") + (f" ({content['detail']})" if content["detail"] else "")
    place = ", ".join(f"{value:.4f}" for value in content["pose"][:3])
    off = content["off_path_mm"]
    return [
        f"run      {console.shown_path(source)}",
        f"path     start {content['start']}: {outcome} after {content['steps']} steps",
        f"step     {content['step']}: {content['why_step']}",
        f"pose     {place} m" + ("" if off is None else f", {off:.1f} mm off the path that it is compared with"),
        f"trusted  {'yes' if content['trusted'] else 'no'}: {content['trust']}",
        _table(content["actions"]),
        f"report   {console.shown_path(folder / EXPLANATION)}",
        f"picture  {console.shown_path(folder / 'explain.png')}",
    ]


def _table(actions: list[dict[str, Any]]) -> "Table":
    from rich import box

    rows = []
    for action in actions:
        why = action["why"] + (f"; the arm cannot: {action['refused']}" if action["refused"] else "")
        rows.append(
            [
                f"{'>' if action['chosen'] else ' '} {action['number']} {action['name']}",
                f"{action['q']:.3f}",
                f"{action['reward']:+.2f}",
                "–" if action["off"] is None else f"{action['off']:.2f}",
                {True: "yes", False: "no", None: "–"}[action["person"]],
                f"{action['source']}: {why}",
            ]
        )
    heads = ("action", "Q", "reward", "off", "person", "where the reward comes from")
    caption = "> the policy's choice; off: from the prediction, in tolerances; person: whether they agree"
    made = console.table(
        heads, rows, (heads[0], *heads[4:]), box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), caption=caption
    )
    for column in made.columns[:-1]:
        column.no_wrap = True
    return made
