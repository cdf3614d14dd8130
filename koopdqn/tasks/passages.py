"""Passages: where a path comes over the same place again, where it turns back, and where it is cut between the two."""

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array

APART = 3.0
"""Two passages of one place are two if the path between them is so many times longer than the place is wide."""
# If it does not open so many times farther on its way, it turns back between them.
_OPENS = 2.0


def leg_of(start: Array, legs: Array) -> int:
    """Return which leg, from 1, began at ``start`` (7,), of those that begin at ``legs`` (K, 7); else the first."""
    return 1 + int(np.append(np.flatnonzero((legs[1:] == start).all(axis=1)) + 1, 0)[0])


def passages(path: Array, near: float, by_goal: float, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs (M, 2) of places of a path (P, 3) [m] that are one place, by the second of them.

    They are nearer together than ``near``, or they are the start and the goal and nearer together than ``by_goal`` [m].
    Returned too is of each (M,) whether the path opens between the two. Where it does not it turns back.
    """
    pairs, opens = [np.empty((0, 2), dtype=int)], [np.empty(0, dtype=bool)]
    closed = bool(pose.norm(path[-1] - path[0]) < by_goal) and (len(path) - 1) * spacing > APART * by_goal
    # By how far the path between two places opens that are one and two points nearer together along it.
    last, before = pose.norm(path[1:] - path[:-1]), np.zeros(len(path))
    for gap in range(2, len(path)):
        across, within = pose.norm(path[gap:] - path[:-gap]), before[1:-1]
        if gap * spacing > APART * near:
            first = np.flatnonzero((across < near) | (closed and gap == len(path) - 1))
            pairs.append(np.stack([first, first + gap], axis=1))
            opens.append(within[first] > _OPENS * near)
        last, before = np.maximum(across, within), last
    found = np.concatenate(pairs)
    order = np.argsort(found[:, 1], kind="stable")
    return found[order], np.concatenate(opens)[order]


def turns_of(path: Array, pairs: np.ndarray, overlap: int) -> np.ndarray:
    """Return the places (K,) at which a path (P, 3) turns back, in order, of pairs (M, 2) before and after them.

    The pairs about one place have their middle there, up to the overlap; it is what is farthest from the innermost.
    """
    turns = []
    middle = pairs.sum(axis=1)
    order = np.argsort(middle, kind="stable")
    for group in np.split(pairs[order], np.flatnonzero(np.diff(middle[order]) > 2 * overlap) + 1) if len(pairs) else []:
        first, last = group[np.diff(group).argmin()]
        away = path[first : last + 1] - 0.5 * (path[first] + path[last])
        turns.append(first + int(pose.norm(away).argmax()))
    return np.unique(turns).astype(int)


def cuts_between(first: np.ndarray, last: np.ndarray) -> np.ndarray | None:
    """Return as few places (K,) as can be, one at least from ``first`` (M,) to ``last`` (M,); None if one is empty."""
    if (first > last).any():
        return None
    cuts: list[int] = []
    spans = list(zip(first.tolist(), last.tolist(), strict=True))
    low, high = spans[0] if spans else (0, -1)
    for begin, end in spans[1:]:
        if begin <= high:
            low = max(low, begin)
        else:
            cuts.append((low + high) // 2)
            low, high = begin, end
    return np.array([*cuts, (low + high) // 2] if spans else cuts, dtype=int)
