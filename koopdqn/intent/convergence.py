"""Whether an intent model, followed step by step, comes to the goal from where it may be asked."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import TrustDomain
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

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
        poses = model.preferred(poses, task.step_m)
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
