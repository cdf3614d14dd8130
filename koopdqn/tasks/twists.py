"""Continuous actions: a twist is a translation and a turn, each in a unit ball, in the frame of Table 1: the base's."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.actions import reached_poses
from koopdqn.tasks.step import TURNS_PER_STEP
from koopdqn.tasks.task import Task

_MOTION: Final = slice(0, 3)
_TURN: Final = slice(3, 6)


def twist_size(task: Task) -> int:
    """Return how many numbers a twist has: 3 with orientation held, 6 otherwise."""
    return 3 if task.orientation == "held" else 6


def largest_turn(task: Task) -> float:
    """Return the turn of a twist of length 1 [rad]."""
    return TURNS_PER_STEP * task.rotation_tolerance_rad


def tolerances(task: Task) -> Array:
    """Return how long the tolerances of the comparison are as twists (3,) or (6,), number by number."""
    motion, turn = task.position_tolerance_m / task.step_m, task.rotation_tolerance_rad / largest_turn(task)
    return np.repeat([motion, turn], 3)[: twist_size(task)]


def in_balls(twists: Array) -> Array:
    """Return twists (..., 3) or (..., 6) with motion and turn each shortened to length 1 where it is longer."""
    parts = [twists[..., part] for part in (_MOTION, _TURN) if twists.shape[-1] >= part.stop]
    return np.concatenate([part / np.maximum(pose.norm(part, keepdims=True), 1.0) for part in parts], axis=-1)


def moved_by(poses: Array, twists: Array, task: Task) -> Array:
    """Return the poses (..., 7) that twists (..., 3) or (..., 6) reach from poses (..., 7), shortened to the balls."""
    twists = in_balls(twists)
    position = poses[..., pose.POSITION] + task.step_m * twists[..., _MOTION]
    quaternion = np.broadcast_to(poses[..., pose.QUATERNION], (*position.shape[:-1], 4))
    if twists.shape[-1] > _TURN.start:
        turn = pose.from_rotation_vector(largest_turn(task) * twists[..., _TURN])
        quaternion = pose.normalized(pose.multiply(turn, quaternion))
    return np.concatenate([position, quaternion], axis=-1)


def twists_between(poses: Array, reached: Array, task: Task) -> Array:
    """Return the twists (..., 3) or (..., 6) from poses (..., 7) toward reached ones (..., 7), at most of length 1."""
    twists = (reached[..., pose.POSITION] - poses[..., pose.POSITION]) / task.step_m
    if task.orientation == "learned":
        turn = pose.multiply(reached[..., pose.QUATERNION], pose.conjugate(poses[..., pose.QUATERNION]))
        twists = np.concatenate([twists, pose.to_rotation_vector(turn) / largest_turn(task)], axis=-1)
    return in_balls(twists)


def toward(poses: Array, wished: Array, task: Task) -> Array:
    """Return the poses (..., 7) that the twists from poses (..., 7) toward wished ones (..., 7) reach."""
    return moved_by(poses, twists_between(poses, wished, task), task)


def reached_by(poses: Array, actions: np.ndarray, task: Task) -> Array:
    """Return the poses (N, 7) that actions reach from poses (N, 7): indices (N,) in Table 1, or twists (N, 3 or 6)."""
    if actions.ndim > 1:
        return moved_by(poses, actions, task)
    return np.asarray(reached_poses(poses, task)[np.arange(len(poses)), actions])


def checked_twists(actions: ArrayLike, count: int, task: Task) -> Array:
    """Return twists (count, 3) or (count, 6) that come from outside.

    Raises:
        ValueError: they are of another shape, or not finite.
    """
    given, shape = np.asarray(actions), (count, twist_size(task))
    if given.shape != shape:
        raise ValueError(f"actions must have shape {shape}, found {given.shape}")
    twists = given.astype(np.float64)
    if not np.isfinite(twists).all():
        raise ValueError("action must be finite, found NaN or infinity")
    return twists
