"""Cross-validation: each demonstration against the intent of the others, the ridge chosen so; and convergence."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.trust import TrustDomain
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
    rescaled = differences(model.predict_step(before, task.step_m), after)
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


_STARTS = 20
# Displacements [m] are tried from here on, each half of the one before.
_FARTHEST_M = 0.064
_HALVINGS = 7
_WIDER = 3.0
_REST_STEPS = 25
# How many times the longest demonstration's steps the model may take; one that is still under way then does not arrive.
_PATIENCE = 3


@dataclass(frozen=True)
class Convergence:
    """Shares of starts from which a model's goal is reached.

    Attributes:
        demonstrated: from the demonstrated region: the demonstrations' starts, starts of the task's region and
            states beside the demonstrations as far out as they are trusted.
        wide: from starts up to three times as far out as the start region.
    """

    demonstrated: float
    wide: float


def convergence(model: IntentModel, trust: TrustDomain, trajectories: list[Array], task: Task) -> Convergence:
    """Return from where the model reaches the goal's position, rescaled to the agent's step.

    Args:
        model: the model.
        trust: how far beside the demonstrations it is relied upon.
        trajectories: demonstrated poses (N, 7).
        task: gives step, start region, goal and its tolerance.
    """
    rng = np.random.default_rng(0)
    region = [
        np.array([trajectory[0] for trajectory in trajectories]),
        task.draw_starts(rng, _STARTS),
        _beside(trust, trajectories, rng),
    ]
    wide = task.draw_starts(rng, _STARTS)
    wide[:, pose.POSITION] += (_WIDER - 1.0) * (wide - task.nominal_start)[:, pose.POSITION]
    starts = np.concatenate([*region, wide])
    limit = _PATIENCE * max(len(trajectory) for trajectory in trajectories)
    arrived = _arrives(model, starts, task, limit)
    return Convergence(float(arrived[:-_STARTS].mean()), float(arrived[-_STARTS:].mean()))


def _beside(trust: TrustDomain, trajectories: list[Array], rng: np.random.Generator) -> Array:
    """Return demonstrated states (M, 7) displaced within the domain, at least half as far as it reaches."""
    everything = np.concatenate(trajectories)
    states = everything[rng.integers(len(everything), size=_STARTS)]
    direction = rng.normal(size=(_STARTS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    size = np.full(_STARTS, _FARTHEST_M)
    for _ in range(_HALVINGS):
        moved = pose.make(states[:, pose.POSITION] + size[:, None] * direction, states[:, pose.QUATERNION])
        size = np.where(trust.distance(moved) > 1.0, size / 2, size)
    return pose.make(states[:, pose.POSITION] + size[:, None] * direction, states[:, pose.QUATERNION])


def _arrives(model: IntentModel, starts: Array, task: Task, limit: int) -> np.ndarray:
    """Return whether each start (N, 7) leads to the goal in ``limit`` steps and stays there, as booleans (N,)."""
    arrived = np.zeros(len(starts), dtype=bool)
    under_way, poses = np.arange(len(starts)), starts
    ends = starts.copy()
    for _ in range(limit):
        poses = model.predict_step(poses, task.step_m)
        there = _at_goal(poses, task)
        arrived[under_way[there]] = True
        ends[under_way[there]] = poses[there]
        under_way, poses = under_way[~there], poses[~there]
        if not len(under_way):
            break
    # One that only comes by is gone a moment later.
    arrived[arrived] = _at_goal(model.roll_out(ends[arrived], _REST_STEPS, task.step_m)[-1], task)
    return arrived


def _at_goal(poses: Array, task: Task) -> np.ndarray:
    return np.asarray(pose.position_distance(poses, task.goal) <= task.goal_tolerance_m)
