"""Why a policy does what it does: a learned path, its most telling step, and the ten actions in one state."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from koopdqn import pose
from koopdqn.evaluation.metrics import reference_paths
from koopdqn.intent.reward import ASKED, CERTIFIED, REMEMBERED, RULE, SOURCES, ActionEvaluation
from koopdqn.oracles.terminal.screen import SHORT
from koopdqn.pose import POSITION, Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import Policy
from koopdqn.tasks.actions import COUNT, legal_actions, within_tolerance
from koopdqn.tasks.rollout import RULE_BROKEN, STEP_LIMIT, STUCK, SUCCESS, Episode
from koopdqn.tasks.task import Task, demonstrator_next_poses
from koopdqn.tasks.workcell import Workcell
from koopdqn.view.motions import intended_path
from koopdqn.view.schema import ExplainedAction

_LEFT_STEPS: Final = 7.0
"""A path that stays farther than this from its reference has left it, in steps: over twice a good policy's mean."""
_SAME: Final = 1e-7


@dataclass(frozen=True)
class Walk:
    """A policy's path with what is known along it.

    Attributes:
        episode: the path.
        reference: (R, 7) that it is compared with.
        compared: what that is, in words.
        evaluation: of all actions at the T poses of the path.
        values: (T, 10) Q.
        actions: (T,) that the policy takes.
        apart: (T,) distance of each position from the nearest of the reference [m].
    """

    episode: Episode
    reference: Array
    compared: str
    evaluation: ActionEvaluation
    values: Array
    actions: np.ndarray
    apart: Array


def walked(
    episode: Episode, policy: Policy, feedback: Feedback, task: Task, step_limit: int, *, referred: bool
) -> Walk:
    """Return an episode of a policy with what is known along it.

    It is compared with the scripted person's own path from the same start if that is ``referred`` to, else with the
    intent's roll-out, up to a step limit.
    """
    start = episode.poses[0]
    if referred:
        reference, compared = reference_paths(task, start[None], step_limit)[0], "the person's own path"
    else:
        reference = intended_path(feedback.reward.model, task, start, step_limit)
        compared = "the path that the intent alone would take"
    begun = task.begun(episode.poses)
    evaluation = feedback.evaluate_actions(episode.poses, np.arange(len(begun)), begun)
    values = policy.values(episode.poses, begun)
    gaps = [float(pose.position_distance(reference, row).min()) for row in episode.poses]
    return Walk(episode, reference, compared, evaluation, values, values.argmax(axis=1), np.array(gaps))


def left_at(walk: Walk, task: Task) -> int | None:
    """Return the first step after which a path stays away from its reference to its end; None if it does not."""
    far = walk.apart > _LEFT_STEPS * task.step_m
    if not far[-1]:
        return None
    return int(np.flatnonzero(~far).max(initial=0))


def telling_step(walk: Walk, task: Task) -> tuple[int, str]:
    """Return the step of a path that tells most, and why it does.

    Of a failure it is where the path leaves its reference for good, or else the step that ends it; of a success the
    action that its own reward holds most wrong, or else the closest call.
    """
    episode, last = walk.episode, walk.episode.steps
    if episode.outcome != SUCCESS:
        gone = left_at(walk, task)
        if gone is not None:
            limit = 1e3 * _LEFT_STEPS * task.step_m
            return gone, f"from here on the path stays more than {limit:.0f} mm away from {walk.compared}"
        return _ending(episode, task)
    each = np.arange(max(last, 1))
    rewards = walk.evaluation.reward[each, walk.actions[each]]
    worst = int(rewards.argmin())
    if rewards[worst] < 0:
        return worst, f"of all actions of the path its own reward holds this one most wrong ({rewards[worst]:+.2f})"
    second, best = np.sort(walk.values[each], axis=1)[:, -2:].T
    closest = int((best - second).argmin())
    return closest, f"the closest call of the path: the two best actions differ by {(best - second)[closest]:.3g} in Q"


def _ending(episode: Episode, task: Task) -> tuple[int, str]:
    """Return the step that ends a failure, and why."""
    last = episode.steps
    if episode.outcome == RULE_BROKEN:
        return max(last - 1, 0), f"this action breaks the rule of the task: {task.rule}"
    if episode.outcome == STUCK:
        return max(last - 1, 0), "this action leaves the pose as it is, and would for ever"
    if episode.outcome == STEP_LIMIT:
        places = np.round(np.concatenate([episode.poses, task.begun(episode.poses)], axis=1) / _SAME).astype(np.int64)
        _, first, number = np.unique(places, axis=0, return_index=True, return_inverse=True)
        again = np.flatnonzero(first[number.ravel()] < np.arange(len(places)))
        if len(again):
            begun, back = int(first[number.ravel()[again[0]]]), int(again[0])
            return begun, f"{back - begun} steps later the path is here again, and goes in circles"
        left = 1e3 * float(pose.position_distance(episode.poses[-1], task.goal))
        return last, f"the step limit is reached {left:.0f} mm from the goal"
    reason = f"{episode.outcome.replace('_', ' ')} {episode.detail}".strip()
    return last, f"the arm cannot carry out this action: {reason}"


def trust_of(feedback: Feedback, evaluation: ActionEvaluation, row: int) -> tuple[bool, str]:
    """Return whether the pose in a row is in the trust domain, and why or why not."""
    trust, step = feedback.reward.trust, int(evaluation.steps[row])
    why = trust.outside(evaluation.local[row], step)
    if why:
        return False, why
    if trust.nearest_step(evaluation.local[row]) is not None:
        return True, "within the domain at this step"
    return True, f"{float(trust.distance(evaluation.local[row][None])[0]):.0%} of the way from its middle to its edge"


def explained_actions(
    evaluation: ActionEvaluation,
    row: int,
    values: Array,
    feedback: Feedback,
    workcell: Workcell,
    trajectories: Sequence[Array],
    joints: Array | None,
    *,
    referred: bool,
) -> list[ExplainedAction]:
    """Return what is known of the ten actions in one state, which stands in a row of an evaluation.

    Values (10,) are Q there, joints (6,) [rad] the arm's, None if they are not known. Trajectories are demonstrated
    poses (N, 7) at the agent's step, in the intent's start frame; ``referred`` says whether a scripted person can be
    asked.
    """
    task, reached = workcell.task, evaluation.reached[row]
    refused = [""] * COUNT
    if joints is not None:
        motions = workcell.reachability.move_batch(reached, np.tile(joints, (COUNT, 1)))
        refused = [f"{motion.reason.replace('_', ' ')} {motion.detail}".strip() for motion in motions]
    agrees: list[bool | None] = [None] * COUNT
    if referred:
        wished = demonstrator_next_poses(task, evaluation.poses[row][None], evaluation.starts[row][None])
        agrees = [bool(each) for each in within_tolerance(reached, wished, task)]
    margins = evaluation.margin[row]
    return [
        ExplainedAction(
            number=action,
            name=SHORT[action],
            chosen=action == int(values.argmax()),
            q=float(values[action]),
            reward=float(evaluation.reward[row, action]),
            off=float(1.0 - margins[action]) if np.isfinite(margins[action]) else None,
            source=SOURCES[evaluation.source[row, action]],
            why=_why(evaluation, row, action, feedback, trajectories),
            person=agrees[action],
            refused=refused[action],
            reached=reached[action].tolist(),
        )
        for action in range(COUNT)
    ]


def _why(evaluation: ActionEvaluation, row: int, action: int, feedback: Feedback, trajectories: Sequence[Array]) -> str:
    """Return in a few words why an action's reward comes from where it does."""
    source, trust = evaluation.source[row, action], feedback.reward.trust
    here, there = evaluation.local[row], evaluation.local_reached[row, action]
    step = int(evaluation.steps[row])
    if source == RULE:
        allowed = legal_actions(feedback.reward.task)[action]
        return "it changes nothing here" if allowed else "the orientation is held"
    if source == REMEMBERED:
        # A better action has the number of the answer that named it.
        answers, number = feedback.answers, evaluation.answer[row, action]
        told = zip(answers.numbers, answers.actions, strict=True)
        return _answered(feedback, next(i for i, each in enumerate(told) if each == (number, action)), here)
    if source == CERTIFIED:
        yes = [index for index, right in enumerate(feedback.answers.right) if right]
        gaps = [float(pose.position_distance(np.array(feedback.answers.poses[index]), there)) for index in yes]
        return _answered(feedback, yes[int(np.argmin(gaps))], there) if yes else "an answer nearby certifies the model"
    if source == ASKED:
        before = trust.outside(here, step) if trust.settings.needs == "both" else ""
        after = trust.outside(there, step + 1)
        if before or after:
            return f"here the {before}" if before else f"there the {after}"
        return "too near the tolerance to be sure"
    gaps = [float(pose.position_distance(rows, there).min()) for rows in trajectories]
    nearest = int(np.argmin(gaps))
    away = f"demonstration {nearest} is {1e3 * gaps[nearest]:.1f} mm away"
    if trust.nearest_step(there) is not None:
        return away
    return f"{away}, {float(trust.depth(there[None])[0]):.0%} of the way out"


def _answered(feedback: Feedback, place: int, point: Array) -> str:
    answers = feedback.answers
    gap = 1e3 * float(pose.position_distance(np.array(answers.poses[place]), point))
    said = "yes" if answers.right[place] else "no"
    return f"answer {answers.numbers[place]} said {said} to {SHORT[answers.actions[place]]}, {gap:.1f} mm away"


def drawn_of(walk: Walk | None, trajectories: Sequence[Array]) -> dict[str, Any]:
    """Return the paths that the picture shows, if any, and the demonstrations: positions (N, 3) [m] of each."""
    return {
        "learned": None if walk is None else walk.episode.poses[:, POSITION],
        "reference": None if walk is None else walk.reference[:, POSITION],
        "demonstrated": [rows[:, POSITION] for rows in trajectories],
    }
