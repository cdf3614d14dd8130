"""How often the signs of rewards are right with a demonstration left out: what trust is calibrated on.

A reward needs to know which actions are right, not where a person would be to the millimetre. Right is what goes on
along the mean of all demonstrations: people who differ by centimetres agree on it, while no model foretells the next
step of one of them alone.
"""

from collections.abc import Sequence

import numpy as np

from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import Prediction, certain_signs
from koopdqn.intent.validation import Fold
from koopdqn.paths import mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.actions import excess, legal_actions, reached_poses, within_tolerance
from koopdqn.tasks.person import Law, ShownPath
from koopdqn.tasks.step import IN_PLACE
from koopdqn.tasks.task import Task

# How far ahead, in steps, going along the mean of the demonstrations looks.
_AHEAD_STEPS = 5.0


def along_mean(trajectories: Sequence[Array], task: Task) -> Law:
    """Return what goes on along the mean of pose trajectories (N, 7), placed in the intent's frame."""
    turn = IN_PLACE * task.rotation_tolerance_rad if task.orientation == "learned" else 0.0
    mean = ShownPath.along(mean_poses(list(trajectories), max(len(rows) for rows in trajectories)))
    return Law(mean, _some_steps_ahead, task.goal, task.step_m, turn)


def _some_steps_ahead(path: ShownPath, positions: Array, arc: Array, step: float) -> Array:
    return path.places.at(arc + _AHEAD_STEPS * step)


def jackknifed(
    folds: Sequence[Fold],
    trajectories: Sequence[Array],
    task: Task,
    prediction: Prediction,
    doubts: Sequence[float],
) -> list[Array]:
    """Return for each state but the last of each demonstration its right signs and of how many, (N − 1, L, 2).

    The model of the others judges the states of the one left out; right is what goes on along the mean of all.

    Args:
        folds: one for each demonstration.
        trajectories: (N, 7) of all of them, placed.
        task: gives actions and tolerances.
        prediction: which one rewards compare with.
        doubts: L shares of the tolerance; a comparison nearer to it does not count.
    """
    law = along_mean(trajectories, task)
    return [
        counted(fold.model, fold.held_out[:-1], law.next_pose(fold.held_out[:-1]), task, prediction, doubts)
        for fold in folds
    ]


def left_out(folds: Sequence[Fold], task: Task, prediction: Prediction, doubt: float) -> float:
    """Return the share of signs that are right by what the demonstration left out itself does next."""
    found = []
    for fold in folds:
        before = fold.held_out[:-1]
        wished = along_mean([fold.held_out], task).next_pose(before)
        found.append(counted(fold.model, before, wished, task, prediction, [doubt]).sum(axis=(0, 1)))
    right, of = np.sum(found, axis=0)
    return float(right / of)


def counted(
    model: IntentModel, poses: Array, wished: Array, task: Task, prediction: Prediction, doubts: Sequence[float]
) -> Array:
    """Return at poses (N, 7), for each of L doubts, how many rewards have the right sign, of how many, (N, L, 2).

    Args:
        model: gives the rewards.
        poses: placed in its frame.
        wished: (N, 7) where a person would be a step later.
        task: gives actions and tolerances.
        prediction: which one rewards compare with.
        doubts: L shares of the tolerance; a comparison nearer to it does not count.
    """
    reached = reached_poses(poses, task)
    predicted = model.predict(poses)
    if prediction == "rescaled":
        predicted = model.to_step(poses, predicted, task.step_m)
    margin = np.where(legal_actions(task), 1.0 - excess(reached, predicted[:, None], task), -np.inf)
    right = (margin >= 0) == within_tolerance(reached, wished[:, None], task)
    counts = np.stack([certain_signs(margin, doubt) & legal_actions(task) for doubt in doubts], axis=1)
    return np.stack([(right[:, None] & counts).sum(axis=2), counts.sum(axis=2)], axis=2).astype(float)
