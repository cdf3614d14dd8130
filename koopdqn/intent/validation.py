"""Cross-validation: the intent fitted to all demonstrations but one, held against that one, and the ridge chosen so."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

# Of the multi-step error: so many steps ahead, from every so-many-th state. Errors of a step that cancel or add up
# show after a few centimetres.
_AHEAD = 25
_EVERY = 8


@dataclass(frozen=True)
class Fold:
    """A demonstration held against the model of the others.

    Attributes:
        held_out: its poses (N, 7).
        model: fitted to the others.
        error: (N − 1, 6) one-step errors of the raw prediction: x, y, z [m] and the rotation vector [rad].
        rescaled: (N − 1, 6) the same of the prediction rescaled to the agent's step.
    """

    held_out: Array
    model: IntentModel
    error: Array
    rescaled: Array


@dataclass(frozen=True)
class Validation:
    """What leaving one demonstration out tells.

    Attributes:
        folds: one for each demonstration; none for a single one.
        ridge: the chosen one.
        multi_step: root mean square multi-step error [m] of each ridge; empty for a single demonstration.
    """

    folds: tuple[Fold, ...]
    ridge: float
    multi_step: dict[float, float]


def cross_validate(
    trajectories: list[Array], task: Task, intent: IntentSettings, advance: Callable[[int], None] = lambda done: None
) -> Validation:
    """Return the folds of pose trajectories (N, 7), with the ridge of the least multi-step error.

    Args:
        trajectories: demonstrated poses at the agent's step.
        task: gives step and goal.
        intent: how models are fitted, and the ridges to choose among.
        advance: told the number of folds done.
    """
    if len(trajectories) == 1:
        return Validation((), intent.ridges[0], {})
    models: list[dict[float, IntentModel]] = []
    squared: dict[float, list[Array]] = {ridge: [] for ridge in intent.ridges}
    for index, held_out in enumerate(trajectories):
        models.append(intent.alternatives(trajectories[:index] + trajectories[index + 1 :], task))
        for ridge, model in models[-1].items():
            squared[ridge].append(_multi_step_error(model, held_out, task))
        advance(index + 1)
    multi_step = {ridge: float(np.sqrt(np.concatenate(found).mean())) for ridge, found in squared.items()}
    ridge = min(multi_step, key=multi_step.__getitem__)
    folds = tuple(_fold(held_out, found[ridge], task) for held_out, found in zip(trajectories, models, strict=True))
    return Validation(folds, ridge, multi_step)


def _fold(held_out: Array, model: IntentModel, task: Task) -> Fold:
    before, after = held_out[:-1], held_out[1:]
    rescaled = differences(model.preferred(before, task.step_m), after)
    return Fold(held_out, model, differences(model.predict(before), after), rescaled)


def _multi_step_error(model: IntentModel, held_out: Array, task: Task) -> Array:
    """Return squared distances [m²] between a demonstration and the model followed from its states for some steps."""
    ahead = min(_AHEAD, len(held_out) - 1)
    begin = np.arange(0, len(held_out) - ahead, _EVERY)
    reached = model.roll_out(held_out[begin], ahead, task.step_m)[-1]
    return np.asarray(pose.position_distance(reached, held_out[begin + ahead]) ** 2)


def differences(predicted: Array, true: Array) -> Array:
    """Return x, y, z [m] and the rotation vector [rad] (N, 6) from true poses (N, 7) to predicted ones."""
    turn = pose.multiply(pose.conjugate(true[:, pose.QUATERNION]), predicted[:, pose.QUATERNION])
    position = predicted[:, pose.POSITION] - true[:, pose.POSITION]
    return np.concatenate([position, pose.to_rotation_vector(turn)], axis=1)


def sizes_of(errors: Array) -> Array:
    """Return the sizes (N, 2) [m, rad] of errors (N, 6) of position and orientation, Eqs. 15, 16."""
    return np.stack([np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)], axis=1)
