"""Generates demonstrations: the scripted demonstrator with smooth variation, carried out by the MuJoCo arm."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.errors import WorkFailedError
from koopdqn.paths import arc_lengths, at_arc_lengths, hausdorff
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Reachability

_HARMONICS = 3
# Steps of the demonstrator to one of the agent.
_SUBSTEPS = 4
# Least Hausdorff distance of two demonstrations from one start, as a share of the variation: 5.2 mm for 4.5 mm.
_LEAST_DIFFERENCE = 1.155


class DemonstrationSettings(Settings):
    """Number and speed of generated demonstrations."""

    count: int = Field(ge=1, le=1000)
    speed_m_s: float = Field(
        ge=0.001,
        le=1.0,
        description="speed of the flange between its slow start and end, about which the pace varies [m/s]",
    )
    pace_variation: float = Field(ge=0, lt=1, description="largest change of the speed, as a share of it")
    sample_seconds: float = Field(ge=0.001, le=0.2, description="time between two recorded samples [s]")


@dataclass(frozen=True)
class Generated:
    """Generated demonstrations.

    Attributes:
        demonstrations: the trajectories.
        redrawn: number of draws that the arm could not carry out, by reason.
    """

    demonstrations: Demonstrations
    redrawn: dict[str, int]


def generate(
    task: Task,
    reachability: Reachability,
    settings: DemonstrationSettings,
    seed: int,
    advance: Callable[[int], None] = lambda done: None,
) -> Generated:
    """Return demonstrations of a task, each with a random start, smooth variation and pace.

    Every sample is reachable without collision. The seed fixes everything. ``advance`` is called with the number of
    demonstrations done.

    Raises:
        WorkFailedError: the arm cannot follow the demonstrator even without variation, or refuses too many draws.
    """
    rng = np.random.default_rng([seed, 1])
    items: list[Demonstration] = []
    expert = task.expert(finer=_SUBSTEPS)
    limit = 20 * _SUBSTEPS * int(task.nominal_path.length / task.step_m)
    nominal = expert.roll_out(task.nominal_start, limit)
    kept: list[Array] = []
    redrawn: dict[str, int] = {}
    while len(items) < settings.count:
        draws, reason = _draws(task, reachability, rng, nominal, kept, settings.count - len(items))
        paths = expert.roll_outs(np.array([draw.start for draw in draws]).reshape(-1, 7), limit)
        for draw, path in zip(draws, paths, strict=True):
            times, poses = _paced(_varied(path, draw.variation), settings, draw.swells)
            joints, refused = reachability.follow(poses)
            if joints is None:
                # What was drawn after it is drawn anew, as it may have been kept apart from this one.
                reason, rng.bit_generator.state = refused, draw.after
                break
            kept.append(draw.shown)
            items.append(Demonstration(times, reachability.flange_poses(joints), joints))
            advance(len(items))
        if reason:
            if not redrawn:
                _check_path(task, reachability, settings, nominal)
            redrawn[reason] = redrawn.get(reason, 0) + 1
            if sum(redrawn.values()) > 20 * (len(items) + 5):
                raise WorkFailedError(
                    f"demonstrations of task {task.name}: the arm must be able to follow most draws,"
                    f" found {sum(redrawn.values())} refused: {redrawn}"
                )
    return Generated(Demonstrations(task.name, reachability.arm.name, items), redrawn)


@dataclass(frozen=True)
class _Draw:
    """What makes a demonstration.

    Attributes:
        start: (7,) where it begins.
        variation: (M, 3) [m] of its path.
        shown: (N, 3) [m] the positions that it makes of the path from the nominal start.
        swells: (2, 2) of its pace.
        after: the state of the random numbers after it.
    """

    start: Array
    variation: Array
    shown: Array
    swells: Array
    after: Any


def _draws(
    task: Task, reachability: Reachability, rng: np.random.Generator, nominal: Array, kept: list[Array], count: int
) -> tuple[list[_Draw], str]:
    """Return what makes ``count`` demonstrations, or those before a start that the arm cannot take, and why not."""
    draws: list[_Draw] = []
    while len(draws) < count:
        start = task.draw_demonstrated_starts(rng, 1)[0]
        reason = reachability.enter(start).reason
        if reason:
            return draws, reason
        variation, shown = _distinct_variation(task, rng, nominal, [*kept, *(draw.shown for draw in draws)])
        draws.append(_Draw(start, variation, shown, _swells(rng), rng.bit_generator.state))
    return draws, ""


def _check_path(task: Task, reachability: Reachability, settings: DemonstrationSettings, nominal: Array) -> None:
    """Raise WorkFailedError unless the arm can follow the demonstrator's path (N, 7) without variation."""
    _, poses = _paced(nominal, settings, _swells(np.random.default_rng(0)))
    joints, motion = reachability.follow_as_far(poses)
    if motion.joints is None:
        raise WorkFailedError(
            f"task {task.name}: the arm must be able to follow the demonstrator, found at"
            f" {np.round(poses[len(joints), pose.POSITION], 3).tolist()} m: {motion.reason}: {motion.detail}"
        )


def smooth_variation(task: Task, rng: np.random.Generator) -> Array:
    """Return a smooth offset (M, 3) [m] for every point of the task's path.

    A random sine series that is zero at both ends, with the task's ``variation_m`` as its largest value.
    """
    along = np.linspace(0.0, 1.0, len(task.nominal_path.points))
    offset = np.zeros((len(along), 3))
    for harmonic in range(1, _HARMONICS + 1):
        offset += rng.normal(size=3) / harmonic * np.sin(np.pi * harmonic * along)[:, None]
    return np.asarray(offset * (task.variation_m / np.linalg.norm(offset, axis=1).max()), dtype=float)


def _distinct_variation(task: Task, rng: np.random.Generator, path: Array, kept: list[Array]) -> tuple[Array, Array]:
    """Return a variation (M, 3) [m] and the path from the nominal start with it, as positions (N, 3) [m].

    The path differs from the ``kept`` ones, unless a thousand draws did not.
    """
    least = _LEAST_DIFFERENCE * task.variation_m
    for draw in range(1001):
        variation = smooth_variation(task, rng)
        # Smooth paths are compared a step of the agent apart.
        shown = _varied(path, variation)[::_SUBSTEPS, pose.POSITION]
        if draw == 1000 or all(hausdorff(shown, other) >= least for other in kept):
            break
    return variation, shown


def _varied(path: Array, variation: Array) -> Array:
    # The variation is added to the demonstrator's own path from this start.
    arc = arc_lengths(path[:, pose.POSITION])
    offset = at_arc_lengths(variation, np.linspace(0.0, arc[-1], len(variation)), arc)
    return pose.make(path[:, pose.POSITION] + offset, path[:, pose.QUATERNION])


def _swells(rng: np.random.Generator) -> Array:
    """Return size and phase [rad] of each of the waves (2, 2) in which the pace swells."""
    return np.array([[rng.uniform(-1, 1), rng.uniform(0, np.pi)] for _ in range(2)])


def _paced(poses: Array, settings: DemonstrationSettings, swells: Array) -> tuple[Array, Array]:
    # Speed eases in and out and varies smoothly in between; time is the integral of its inverse.
    arc = arc_lengths(poses[:, pose.POSITION])
    share = arc / arc[-1]
    swell = sum(size * np.sin(np.pi * (k + 1) * share + phase) for k, (size, phase) in enumerate(swells.tolist()))
    ease = np.clip(np.minimum(share, 1 - share) / 0.1, 0, 1)
    speed = settings.speed_m_s * (0.25 + 0.75 * ease) * (1 + 0.5 * settings.pace_variation * swell)
    seconds = np.concatenate([[0.0], np.cumsum(np.diff(arc) / (0.5 * (speed[1:] + speed[:-1])))])
    # The end is a sample of its own, unless one is there already.
    times = np.append(np.arange(0.0, seconds[-1] - 1e-9, settings.sample_seconds), seconds[-1])
    values = at_arc_lengths(poses, seconds, times)
    return times, pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION])
