"""Playing a recorded path: its poses over time, at a steady speed and with its corners rounded off."""

from itertools import pairwise

import numpy as np

from koopdqn import pose
from koopdqn.app.recording import DemoSettings
from koopdqn.demonstrations.dataset import Demonstration, continuous
from koopdqn.errors import WorkFailedError
from koopdqn.paths import at_arc_lengths, between
from koopdqn.pose import Array
from koopdqn.tasks.workcell import Reachability

_HALVINGS = 3
"""How often the rounding is halved where the arm cannot follow it, before it is left out."""


def seconds_along(path: Array, settings: DemoSettings) -> Array:
    """Return the times (N,) [s] at which the poses (N, 7) of a path are passed.

    The flange moves with ``speed_m_s``; a turn of ``turn_rad`` takes as long as a move of ``step_m``. Pauses of
    the person count for nothing.
    """
    moved = pose.position_distance(path[1:], path[:-1])
    turned = pose.rotation_distance(path[1:], path[:-1])
    keyboard = settings.keyboard
    way = np.maximum(moved, turned * keyboard.step_m / keyboard.turn_rad)
    return np.concatenate([[0.0], np.cumsum(way)]) / settings.speed_m_s


def sample_count(path: Array, settings: DemoSettings) -> int:
    """Return how many samples a path (N, 7) has when it is played, rounded off."""
    return len(_played(overlap_turns(path, settings), settings, settings.keyboard.rounding_m)[0])


def play(path: Array, joints: Array, settings: DemoSettings, reachability: Reachability) -> tuple[Demonstration, str]:
    """Return a recorded path as a demonstration, and why its corners are rounded less than set; empty if they are not.

    Keys make stairs along the axes and turn in place, as no hand does. A turn is played during the move that follows
    it, and a Hann window of ``rounding_m`` that slides along the way rounds off the corners of the positions, which
    also begin and end gently by it. Turns keep their rate: what ended ever more slowly, no action of Table 1 would
    match. The ends stay. Where the arm could not follow, the path is rounded off less, or played key by key.

    Args:
        path: poses (N, 7) that the keys reached, at least two that differ.
        joints: joint angles (6,) [rad] at its start.
        settings: speed, rate of samples, rounding.
        reachability: the arm in the task's scene.

    Raises:
        WorkFailedError: the arm cannot follow the path at that speed; the message says why.
    """
    rounding = settings.keyboard.rounding_m
    both = overlap_turns(path, settings)
    less = [rounding * 0.5**halving for halving in range(1, _HALVINGS + 1)] if rounding > 0 else []
    first = ""
    for poses, each in (*((both, width) for width in (rounding, *less, 0.0)), (path, 0.0)):
        times, wanted = _played(poses, settings, each)
        angles, motion = reachability.follow_as_far(wanted, joints)
        if motion.joints is not None:
            followed = np.array(angles)
            return Demonstration(times, reachability.flange_poses(followed), followed), first
        first = first or f"{motion.reason}: {motion.detail}"
    raise WorkFailedError(first)


def overlap_turns(path: Array, settings: DemoSettings) -> Array:
    """Return a path (M, 7) whose turns are made during the moves that follow them; those after the last stay.

    A turn begins with the move and goes on at the rate of one ``turn_rad`` a ``step_m``, or as fast as it must to
    end with the move. Each pose of the given path (N, 7) is a move or a turn from the one before.
    """
    per_turn = settings.keyboard.step_m / settings.keyboard.turn_rad
    result = [path[0]]
    turns: list[Array] = []
    for before, after in pairwise(path):
        length = float(pose.position_distance(before, after))
        if length == 0.0:
            turns.append(after)
            continue
        if turns:
            each = pose.rotation_distance(np.array(turns), np.array([result[-1], *turns[:-1]]))
            share = np.cumsum(each) / max(length / per_turn, float(each.sum()))
            result += [_placed(between(before, after, part), turned) for part, turned in zip(share, turns, strict=True)]
            turns = []
        if pose.position_distance(result[-1], after) > 0:
            result.append(after)
    return np.array([*result, *turns])


def _placed(at: Array, turned: Array) -> Array:
    """Return the pose (7,) of one's position and the other's orientation."""
    return pose.make(at[pose.POSITION], turned[pose.QUATERNION])


def _played(path: Array, settings: DemoSettings, rounding: float) -> tuple[Array, Array]:
    """Return times (M,) [s] and poses (M, 7) of a path (N, 7), its corners rounded off over ``rounding`` [m]."""
    around = int(np.ceil(rounding / 2 / settings.speed_m_s / settings.sample_seconds))
    seconds = seconds_along(path, settings)
    # The end is a sample of its own, unless one is there already.
    times = np.append(np.arange(0.0, seconds[-1] - 1e-9, settings.sample_seconds), seconds[-1])
    return _waiting(times, around, settings.sample_seconds), round_corners(_at(path, seconds, times), around)


def round_corners(poses: Array, around: int) -> Array:
    """Return poses (N + 2 around, 7), positions averaged by a Hann window of ``around`` samples to each side of (N, 7).

    Before and after it the path is taken to stand still, so that it begins and ends at its own ends.
    """
    if around == 0:
        return poses
    still = np.concatenate([np.repeat(poses[:1], around, axis=0), poses, np.repeat(poses[-1:], around, axis=0)])
    wider = np.pad(still[:, pose.POSITION], ((around, around), (0, 0)), mode="edge")
    window = np.hanning(2 * around + 3)[1:-1]
    result = still.copy()
    for axis in range(3):
        result[:, axis] = np.convolve(wider[:, axis], window / window.sum(), mode="valid")
    result[[0, -1]] = poses[[0, -1]]
    return result


def _waiting(times: Array, around: int, interval: float) -> Array:
    """Return times (N,) [s], from 0, extended at both ends by the samples that the rounding adds."""
    before = interval * np.arange(around)
    after = times[-1] + interval * np.arange(around + 1, 2 * around + 1)
    return np.concatenate([before, interval * around + times, after])


def _at(path: Array, seconds: Array, times: Array) -> Array:
    signed = path.copy()
    signed[:, pose.QUATERNION] = continuous(path[:, pose.QUATERNION])
    values = at_arc_lengths(signed, seconds, times)
    return pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION])
