"""Idle ends of a recording: the arm stands still before the motion and after it."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

STILL_M = 0.001
"""Within this distance of where it stood the arm still stands [m]; sensor noise widens it."""
STILL_RAD = 0.01
"""The same for a turn [rad]."""
# Standard deviations of the noise that a still arm's samples are allowed, and how much that may widen the limits:
# what looks like noise in a sparse recording is its motion.
_SIGMAS = 4.0
_WIDEST = 3.0
_FEWEST = 5


@dataclass(frozen=True)
class Trimmed:
    """A demonstration without its idle ends.

    Attributes:
        item: what is left; its first and last pose are those at which the arm stood.
        before: idle time cut off at the start [s].
        after: idle time cut off at the end [s].
    """

    item: Demonstration
    before: float
    after: float


def trimmed(item: Demonstration) -> Trimmed:
    """Return a demonstration without its idle ends.

    The arm stands still as long as every pose is within :data:`STILL_M` and :data:`STILL_RAD` of the first one, or
    within four standard deviations of the recording's own noise where that is more, up to three times as much. Of
    the idle samples one is kept, the last of those at the start and the first of those at the end, with the pose at
    rest: the mean of those within four standard deviations of the very first or last. Joint angles, where known,
    are those of the kept samples.

    Raises:
        BadInputError: nothing moves.
    """
    limits, noise = np.array([STILL_M, STILL_RAD]), _SIGMAS * np.array(noise_of(item))
    distance, turn = np.clip(noise, limits, _WIDEST * limits).tolist()
    first = _still(item.poses, distance, turn) - 1
    last = len(item) - _still(item.poses[::-1], distance, turn)
    if first >= last:
        raise BadInputError(
            f"the arm must move by more than {distance * 1e3:.3g} mm or {np.degrees(turn):.2g}°,"
            " found it standing still"
        )
    poses = item.poses[first : last + 1].copy()
    poses[0], poses[-1] = _rest(item.poses[: first + 1], *noise), _rest(item.poses[last:][::-1], *noise)
    joints = None if item.joints is None else item.joints[first : last + 1]
    before, after = item.times[first] - item.times[0], item.times[-1] - item.times[last]
    return Trimmed(Demonstration(item.times[first : last + 1], poses, joints), float(before), float(after))


def noise_of(item: Demonstration) -> tuple[float, float]:
    """Return the standard deviations of the noise of positions [m] and orientations [rad], each that of its length.

    It is the median size of second differences, which motion hardly shows in: those of white noise of standard
    deviation σ have √6·σ in each component.
    """
    if len(item) < _FEWEST:
        return 0.0, 0.0
    position = np.diff(item.poses[:, pose.POSITION], n=2, axis=0)
    # Of a small turn the quaternion's vector part is half.
    turn = 2.0 * np.diff(item.poses[:, pose.QUATERNION], n=2, axis=0)
    sizes = [float(np.median(np.linalg.norm(values, axis=1))) for values in (position, turn)]
    return sizes[0] / np.sqrt(6.0), sizes[1] / np.sqrt(6.0)


def _still(poses: Array, distance: float, turn: float) -> int:
    """Return how many poses (N, 7) from the first on are within distance [m] and turn [rad] of it."""
    moved = (pose.position_distance(poses, poses[0]) > distance) | (pose.rotation_distance(poses, poses[0]) > turn)
    return int(moved.argmax()) if moved.any() else len(poses)


def _rest(poses: Array, distance: float, turn: float) -> Array:
    """Return the mean (7,) of the poses (N, 7) that are within distance [m] and turn [rad] of the first."""
    near = (pose.position_distance(poses, poses[0]) <= distance) & (pose.rotation_distance(poses, poses[0]) <= turn)
    near[0] = True
    mean = poses[near].mean(axis=0)
    return pose.make(mean[pose.POSITION], mean[pose.QUATERNION])
