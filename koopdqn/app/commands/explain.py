"""``koopdqn explain``: why a policy does what it does in one state."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from rich.console import RenderableType

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.trained import TrainedRun, feedback_of, read_trained
from koopdqn.app.hydra.application import CommandResult
from koopdqn.errors import BadInputError
from koopdqn.files import write_json
from koopdqn.intent.bend import BentIntent
from koopdqn.intent.reward import ActionEvaluation
from koopdqn.pose import Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import Policy, PolicyAround
from koopdqn.tasks.moved_goals import DrawnStarts
from koopdqn.tasks.passages import leg_of
from koopdqn.tasks.rollout import RULE_BROKEN, STUCK, SUCCESS, Episode, roll_out
from koopdqn.view.explain import Walk, drawn_of, explained_actions, left_at, telling_step, trust_of, walked
from koopdqn.view.motions import shown_starts
from koopdqn.view.schema import ExplainFile

if TYPE_CHECKING:
    from rich.table import Table

EXPLANATION = "explain.json"
_TOGETHER: Final = 10
"""Paths made at once in the search for one that fails."""


def run(config: Configuration, folder: Path) -> CommandResult:
    """Explain a state of the run of ``run=``; write ``explain.json`` and ``explain.png``."""
    source = config.run
    if config.inputs.actions != "table1":
        raise BadInputError(f"actions: explain tells of the ten actions of Table 1, found {config.inputs.actions}")
    trained = read_trained(config, source)
    policy, feedback, chosen = trained.policy, feedback_of(config, trained, source), config.explain
    if isinstance(policy, PolicyAround):
        way = "a correction" if policy.policy.bend is not None else "obstacles that it never saw"
        raise BadInputError(f"run: explain tells why a network takes an action, found a policy led around {way}")
    if chosen.step is not None and chosen.pose is not None:
        raise BadInputError(f"explain.step: must stand without explain.pose, found step {chosen.step} and a pose")
    given = None if chosen.pose is None else np.array(chosen.pose)[None]
    if given is None:
        shown = _on_path(config, trained, policy, feedback)
    else:
        shown = _given(config, trained, policy, feedback, given)
    task, row = trained.workcell.task, shown.row
    local = trained.reward.model.placed(trained.trajectories)
    trusted, trust = trust_of(feedback, shown.evaluation, row)
    begun = shown.evaluation.starts[row]
    legs = task.legs(begun)
    content = ExplainFile(
        run=str(source),
        task=task.name,
        **shown.place,
        leg=leg_of(begun, legs),
        legs=len(legs),
        pose=shown.evaluation.poses[row].tolist(),
        predicted=shown.evaluation.predicted[row].tolist(),
        trusted=trusted,
        trust=trust,
        actions=explained_actions(
            shown.evaluation,
            row,
            shown.values,
            feedback,
            trained.workcell,
            local,
            shown.joints,
            referred=_asks_person(trained),
        ),
    ).model_dump(mode="json")
    write_json(folder / EXPLANATION, content)
    from koopdqn.plots.explain import plot_explanation

    title = f"Task {task.name}, {_headline(content)}"
    plot_explanation(folder / "explain.png", title, task, content, **drawn_of(shown.walk, trained.trajectories))
    return CommandResult(content, _lines(content, folder, source))


@dataclass(frozen=True)
class _State:
    """The explained state.

    Attributes:
        evaluation: of the ten actions, with the state in one of its rows.
        row: which.
        values: (10,) Q there.
        joints: of the arm there (6,) [rad].
        place: the keys of ``explain.json`` that say where on a path it is.
        walk: that path; None of a given pose.
    """

    evaluation: ActionEvaluation
    row: int
    values: Array
    joints: Array
    place: dict[str, Any]
    walk: Walk | None = None


def _asks_person(trained: TrainedRun) -> bool:
    # A scripted person sees no obstacles: their own path leads through them.
    return trained.referred and not isinstance(trained.reward.model, BentIntent)


def _on_path(config: Configuration, trained: TrainedRun, policy: Policy, feedback: Feedback) -> _State:
    """Return the state of a path that was asked for, or the most telling one."""
    task = trained.workcell.task
    with console.stage("Moving the arm"):
        number, episode = _episode(config, trained)
    walk = walked(episode, policy, feedback, task, trained.step_limit, referred=_asks_person(trained))
    row, why = telling_step(walk, task)
    if config.explain.step is not None:
        row, why = config.explain.step, "it was asked for"
        # Where these leave the arm no action follows.
        last = episode.steps - (episode.outcome in (SUCCESS, RULE_BROKEN, STUCK))
        if row > last:
            raise BadInputError(f"explain.step: must be at most {last}, the last step of this path, found {row}")
    place = {
        "start": number,
        "outcome": episode.outcome,
        "detail": episode.detail,
        "steps": episode.steps,
        "step": row,
        "why_step": why,
        "left_at": left_at(walk, task),
        "off_path_mm": 1e3 * float(walk.apart[row]),
    }
    return _State(walk.evaluation, row, walk.values[row], episode.joints[row], place, walk)


def _given(config: Configuration, trained: TrainedRun, policy: Policy, feedback: Feedback, given: Array) -> _State:
    """Return the state of a given pose (1, 7), which is on no path.

    What follows starts is placed by the held-out start that was asked for, else by the nominal one; of a path that
    passes itself it is told as on the leg whose demonstrations are nearest.
    """
    taken = trained.workcell.reachability.enter(given[0])
    if taken.joints is None:
        raise BadInputError(
            f"explain.pose: must be one that the arm can take, found it {taken.reason.replace('_', ' ')}:"
            f" {taken.detail}"
        )
    number, start = config.explain.start, trained.workcell.task.nominal_start[None]
    if number is not None:
        start = _drawn(config, trained).starts[number : number + 1]
    legs = trained.workcell.task.legs(start[0])
    local = feedback.reward.model.start_frame.to_frame(np.repeat(given, len(legs), axis=0), legs)
    # Without what answers have certified, which may reach from one leg to the next.
    leg = int(trained.reward.trust.distance(local).argmin())
    start = legs[leg][None]
    # A domain that differs from step to step knows it as of the step whose place is nearest.
    step = trained.reward.trust.nearest_step(local[leg]) or 0
    evaluation = feedback.evaluate_actions(given, np.array([step]), start)
    place = dict.fromkeys(("outcome", "detail", "steps", "step", "left_at", "off_path_mm"))
    told = {**place, "start": number, "why_step": "the pose was given"}
    return _State(evaluation, 0, policy.values(given, start)[0], taken.joints, told)


def _drawn(config: Configuration, trained: TrainedRun) -> DrawnStarts:
    """Return the held-out starts, the one asked for among them."""
    drawn, number = shown_starts(trained.workcell, config.eval), config.explain.start
    if number is not None and number >= len(drawn.starts):
        raise BadInputError(f"explain.start: must be below eval.episodes ({len(drawn.starts)}), found {number}")
    return drawn


def _episode(config: Configuration, trained: TrainedRun) -> tuple[int, Episode]:
    """Return the path from the start asked for, or from the first from which the policy fails, with its number."""
    drawn, number = _drawn(config, trained), config.explain.start
    starts, joints = drawn.starts, drawn.joints

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
    lines: list[RenderableType] = [f"run      {console.shown_path(source)}", f"pose     {_pose(content['pose'])}"]
    if content["step"] is not None:
        outcome = content["outcome"].replace("_", " ") + (f" ({content['detail']})" if content["detail"] else "")
        lines[1:1] = [
            f"path     start {content['start']}: {outcome} after {content['steps']} steps",
            f"step     {content['step']}: {content['why_step']}",
        ]
        lines.append(f"away     {content['off_path_mm']:.1f} mm from the path that it is compared with")
    elif content["start"] is not None:
        lines.append(f"begun    as if at held-out start {content['start']}")
    if content["legs"] > 1:
        lines.append(f"leg      {content['leg']} of {content['legs']}")
    return [
        *lines,
        f"trusted  {'yes' if content['trusted'] else 'no'}: {content['trust']}",
        _table(content["actions"]),
        f"report   {console.shown_path(folder / EXPLANATION)}",
        f"picture  {console.shown_path(folder / 'explain.png')}",
    ]


def _headline(content: dict[str, Any]) -> str:
    if content["step"] is None:
        return f"a given pose\n{_pose(content['pose'])}"
    return f"start {content['start']}, step {content['step']} of {content['steps']}\n{content['why_step']}"


def _pose(values: Sequence[float]) -> str:
    place, turned = (", ".join(f"{value:z.4f}" for value in part) for part in (values[:3], values[3:]))
    return f"{place} m, quaternion {turned}"


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
    look = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "caption": caption}
    return console.table(heads, rows, (heads[0], *heads[4:]), whole="cells", **look)
