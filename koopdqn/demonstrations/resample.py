"""Resampling a demonstration to the agent's step, or to a number of samples."""

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.path import arc_lengths, at_arc_lengths


def to_step(poses: Array, step: float, turn: float) -> Array:
    """Return poses (M, 7) resampled so that neighbours are one agent's step apart.

    A new sample is taken when position has moved ``step`` [m] or rotation ``turn`` [rad] since the
    last, whichever is first, so that turning in place survives while idling and pauses vanish.
    The last pose of (N, 7) is always kept.
    """
    kept = [poses[0]]
    last = poses[0]
    previous = poses[0]
    for current in poses[1:]:
        # Several samples may fit between two recorded poses.
        while True:
            moved = float(pose.position_distance(current, last)) / step
            turned = float(pose.rotation_distance(current, last)) / turn
            if max(moved, turned) < 1.0:
                break
            last = _crossing(previous, current, last, step, turn)
            previous = last
            kept.append(last)
        previous = current
    # A stump much shorter than a step would teach the model to slow down at the end.
    if max(pose.position_distance(poses[-1], last) / step, pose.rotation_distance(poses[-1], last) / turn) > 1e-6:
        kept.append(poses[-1])
    return np.array(kept)


def _crossing(before: Array, after: Array, last: Array, step: float, turn: float) -> Array:
    """Return the pose (7,) between two at which position first is a step, or rotation a turn, away from ``last``."""
    share = 1.0
    if pose.position_distance(after, last) >= step:
        share = _sphere_crossing(
            before[pose.POSITION] - last[pose.POSITION], after[pose.POSITION] - before[pose.POSITION], step
        )
    if pose.rotation_distance(after, last) >= turn:
        low, high = 0.0, 1.0
        for _ in range(40):
            middle = 0.5 * (low + high)
            if pose.rotation_distance(between(before, after, middle), last) < turn:
                low = middle
            else:
                high = middle
        share = min(share, high)
    return between(before, after, share)


def _sphere_crossing(offset: Array, motion: Array, radius: float) -> float:
    # The larger root of |offset + t motion|² = radius², as ``offset`` lies within the sphere.
    a, b, c = float(motion @ motion), float(offset @ motion), float(offset @ offset) - radius**2
    return float(np.clip((-b + np.sqrt(max(b * b - a * c, 0.0))) / a, 0.0, 1.0))


def between(a: Array, b: Array, share: float) -> Array:
    """Return the pose (7,) a ``share`` of the way from ``a`` to ``b``: straight in position, geodesic in rotation."""
    position = a[pose.POSITION] + share * (b[pose.POSITION] - a[pose.POSITION])
    angle = share * float(pose.rotation_distance(a, b))
    return pose.make(position, pose.turned_toward(a[pose.QUATERNION], b[pose.QUATERNION], angle))


def mean_poses(trajectories: list[Array], count: int) -> Array:
    """Return ``count`` poses (count, 7) along the mean of pose trajectories (N, 7), aligned by their share of path."""
    aligned = np.array([to_count(rows, count) for rows in trajectories])
    turns = aligned[..., pose.QUATERNION]
    # q and −q are the same rotation.
    turns = turns * np.where((turns * turns[0]).sum(axis=2, keepdims=True) < 0, -1.0, 1.0)
    return pose.make(aligned[..., pose.POSITION].mean(axis=0), pose.normalized(turns.mean(axis=0)))


def to_count(poses: Array, count: int, arc: Array | None = None) -> Array:
    """Return ``count`` poses (count, 7) evenly spaced along the path (N, 7).

    Where the path does not move at all, samples are spread evenly over the turn instead.

    Args:
        poses: the path.
        count: how many.
        arc: (N,) [m] the arc length of every pose, if it is not to be that of the positions themselves.
    """
    if arc is None:
        arc = arc_lengths(poses[:, pose.POSITION])
    if arc[-1] < 1e-9:
        turns = pose.rotation_distance(poses[1:], poses[:-1])
        arc = np.concatenate([[0.0], np.cumsum(turns)])
    # Equal arc lengths (turning in place) need an order for the interpolation.
    arc = arc + np.arange(len(arc)) * 1e-12
    values = at_arc_lengths(poses, arc, np.linspace(0.0, arc[-1], count))
    return pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION])
