"""Resampling a demonstration to the agent's step, or to a number of samples."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.path import arc_lengths, at_arc_lengths


def to_step(trajectories: Sequence[Array], step: float, turn: float) -> list[Array]:
    """Return trajectories of poses (M, 7) resampled so that neighbours are one agent's step apart.

    A new sample is taken when position has moved ``step`` [m] or rotation ``turn`` [rad] since the
    last, whichever is first, so that turning in place survives while idling and pauses vanish.
    The last pose of each of the trajectories (N, 7) is always kept. All are walked along side by side.
    """
    kept = [[rows[0]] for rows in trajectories]
    last = np.array([rows[0] for rows in trajectories])
    previous = last.copy()
    ends, place = np.array([len(rows) for rows in trajectories]), np.ones(len(trajectories), dtype=np.int64)
    while (under_way := np.flatnonzero(place < ends)).size:
        current = np.array([trajectories[i][place[i]] for i in under_way.tolist()])
        moved = pose.position_distance(current, last[under_way])
        turned = pose.rotation_distance(current, last[under_way])
        beyond = np.maximum(moved / step, turned / turn) >= 1.0
        # Several samples may fit between two recorded poses: where one is taken, the recorded pose stays the next.
        taken, passed = under_way[beyond], under_way[~beyond]
        previous[passed] = current[~beyond]
        place[passed] += 1
        if taken.size:
            distances = moved[beyond], turned[beyond]
            last[taken] = previous[taken] = _crossing(
                previous[taken], current[beyond], last[taken], *distances, step, turn
            )
            for i in taken.tolist():
                kept[i].append(last[i].copy())
    for rows, samples in zip(trajectories, kept, strict=True):
        # A stump much shorter than a step would teach the model to slow down at the end.
        moved, turned = pose.position_distance(rows[-1], samples[-1]), pose.rotation_distance(rows[-1], samples[-1])
        if max(moved / step, turned / turn) > 1e-6:
            samples.append(rows[-1])
    return [np.array(samples) for samples in kept]


def _crossing(before: Array, after: Array, last: Array, moved: Array, turned: Array, step: float, turn: float) -> Array:
    """Return the poses (N, 7) between two at which position first is a step, or rotation a turn, away from ``last``.

    The poses ``after`` have ``moved`` (N,) [m] and ``turned`` (N,) [rad] from ``last``, one of them at least that far.
    """
    share = np.ones(len(before))
    for row in np.flatnonzero(moved >= step):
        offset, motion = (a[row, pose.POSITION] - b[row, pose.POSITION] for a, b in ((before, last), (after, before)))
        share[row] = _sphere_crossing(offset, motion, step)
    turning = np.flatnonzero(turned >= turn)
    if turning.size:
        low, high = np.zeros(len(turning)), np.ones(len(turning))
        for _ in range(40):
            middle = 0.5 * (low + high)
            there = between(before[turning], after[turning], middle)
            short = pose.rotation_distance(there, last[turning]) < turn
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        share[turning] = np.minimum(share[turning], high)
    return between(before, after, share)


def _sphere_crossing(offset: Array, motion: Array, radius: float) -> float:
    # The larger root of |offset + t motion|² = radius², as ``offset`` lies within the sphere.
    a, b, c = float(motion @ motion), float(offset @ motion), float(offset @ offset) - radius**2
    return float(np.clip((-b + np.sqrt(max(b * b - a * c, 0.0))) / a, 0.0, 1.0))


def between(a: Array, b: Array, share: ArrayLike) -> Array:
    """Return the poses (..., 7) a ``share`` (...) of the way from ``a`` (..., 7) to ``b`` (..., 7).

    Straight in position, geodesic in rotation.
    """
    part = np.asarray(share, dtype=float)
    position = a[..., pose.POSITION] + part[..., None] * (b[..., pose.POSITION] - a[..., pose.POSITION])
    angle = part * pose.rotation_distance(a, b)
    return pose.make(position, pose.turned_toward(a[..., pose.QUATERNION], b[..., pose.QUATERNION], angle))


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
