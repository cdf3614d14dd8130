"""Actions: the ten of Table 1, and continuous ones; the poses they reach, their distances from others (Eqs. 15, 16)."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.step import IN_PLACE, TURNS_PER_STEP
from koopdqn.tasks.task import Task

ACTIONS: Final = (
    "moves uniformly in position and rotation toward the goal",
    "moves only in position toward the goal",
    "moves only in rotation toward the goal",
    "moves in position and more in rotation toward the goal",
    "moves along +x",
    "moves along -x",
    "moves along +y",
    "moves along -y",
    "moves along +z",
    "moves along -z",
)
"""The actions in Table 1's order and words; indices count from 0, the paper's numbers from 1."""

COUNT: Final = len(ACTIONS)
SUGGESTED: Final = COUNT
"""Index of the intent model's own suggestion, where actions are continuous."""
FIRST_TWIST: Final = SUGGESTED + 1
"""Indices from here on are of twists without a name."""
NAMES: Final = (*ACTIONS, "follows the intent model", "goes its own way")
"""The actions in words, by index: Table 1's, the suggestion, and any other twist."""
ROTATING: Final = (0, 2, 3)
"""Indices of the actions that change orientation."""

# Rotation of one action in rotation tolerances: with the actions that do not turn they match every demonstrated rate
# from 0 to 5 tolerances a step.
_TURN: Final = {0: IN_PLACE, 2: IN_PLACE, 3: 2.0 * IN_PLACE}
_TO_GOAL: Final = (0, 1, 3)
_FIRST_AXIS: Final = 4


def reached_poses(poses: Array, task: Task) -> Array:
    """Return the poses (N, 10, 7) that the actions reach from poses (N, 7), whether or not the arm can reach them.

    Motion toward the goal is straight in position and along the geodesic in rotation, both clamped at the goal.
    """
    reached = np.repeat(poses[:, None], COUNT, axis=1)
    position, quaternion = poses[:, pose.POSITION], poses[:, pose.QUATERNION]
    toward = pose.moved_toward(position, task.goal[pose.POSITION], np.full(len(poses), task.step_m))
    for action in _TO_GOAL:
        reached[:, action, pose.POSITION] = toward
    turned_away = np.any(pose.rotation_distance(poses, task.goal) > 0)
    if turned_away:
        angles = np.array(list(_TURN.values()))[:, None] * task.rotation_tolerance_rad
        turned = pose.turned_toward(quaternion, task.goal[pose.QUATERNION], angles)
        reached[:, list(_TURN), pose.QUATERNION] = turned.swapaxes(0, 1)
    for axis in range(3):
        reached[:, _FIRST_AXIS + 2 * axis, axis] += task.step_m
        reached[:, _FIRST_AXIS + 2 * axis + 1, axis] -= task.step_m
    return reached


def legal_actions(task: Task) -> np.ndarray:
    """Return which actions (10,) the task allows: with orientation held, the rotating ones are wrong (§5.1)."""
    legal = np.ones(COUNT, dtype=bool)
    if task.orientation == "held":
        legal[list(ROTATING)] = False
    return legal


def excess(reached: Array, wished: Array, task: Task) -> Array:
    """Return the larger of position and rotation distance (...), each in units of its tolerance."""
    position = pose.position_distance(reached, wished) / task.position_tolerance_m
    rotation = pose.rotation_distance(reached, wished) / task.rotation_tolerance_rad
    return np.maximum(position, rotation)


def within_tolerance(reached: Array, wished: Array, task: Task) -> np.ndarray:
    """Return whether both distances are within their tolerances, as booleans (...)."""
    return np.asarray(excess(reached, wished, task) <= 1.0)


def nearest_actions(poses: Array, wished: Array, task: Task) -> np.ndarray:
    """Return the legal actions (N,) whose reached poses are nearest to wished poses (N, 7), by :func:`excess`."""
    far = excess(reached_poses(poses, task), wished[:, None], task)
    return np.asarray(np.where(legal_actions(task), far, np.inf).argmin(axis=1))


def checked_indices(actions: ArrayLike, count: int) -> np.ndarray:
    """Return indices in Table 1 (count,) that come from outside.

    Raises:
        ValueError: they are of another shape, no whole numbers, or one is none of the ten.
    """
    try:
        given = np.asarray(actions)
        if given.dtype == object:
            # Whole numbers are what they are in an array of objects too.
            given = np.asarray(given.tolist())
    except ValueError as error:
        raise ValueError(f"actions must have shape ({count},), found lists of several lengths") from error
    if given.shape != (count,):
        raise ValueError(f"actions must have shape ({count},), found {given.shape}")
    with np.errstate(invalid="ignore"):
        whole = given.astype(np.int64) if given.dtype.kind in "iuf" else None
    if whole is None or (whole != given).any():
        raise ValueError(f"action must be a whole number, found {given.tolist()}")
    strange = (whole < 0) | (whole >= COUNT)
    if strange.any():
        raise ValueError(f"action must be from 0 to {COUNT - 1}, found {whole[strange][0]}")
    return whole


# Continuous actions: a twist is a translation and a turn, each in a unit ball, in the frame of Table 1: the base's.
_TRANSLATION: Final = slice(0, 3)
_ROTATION: Final = slice(3, 6)


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
    parts = [twists[..., part] for part in (_TRANSLATION, _ROTATION) if twists.shape[-1] >= part.stop]
    return np.concatenate([part / np.maximum(pose.norm(part, keepdims=True), 1.0) for part in parts], axis=-1)


def moved_by(poses: Array, twists: Array, task: Task) -> Array:
    """Return the poses (..., 7) that twists (..., 3) or (..., 6) reach from poses (..., 7), shortened to the balls."""
    twists = in_balls(twists)
    position = poses[..., pose.POSITION] + task.step_m * twists[..., _TRANSLATION]
    quaternion = np.broadcast_to(poses[..., pose.QUATERNION], (*position.shape[:-1], 4))
    if twists.shape[-1] > _ROTATION.start:
        turn = pose.from_rotation_vector(largest_turn(task) * twists[..., _ROTATION])
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
