"""One recording of several motions, cut where the arm rests or where it comes back to its start."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array

# The arm rests while it stays this near for this long [m, rad, s].
_STILL_M: Final = 0.003
_STILL_RAD: Final = 0.02
_REST_S: Final = 0.5
# What lies between two rests is a motion if it is at least this share of the longest.
_SHORTEST: Final = 0.2
_LEAST_M: Final = 0.02
# Motions of one task end within this share of their way of each other.
_SAME_END: Final = 0.25
# A loop leaves the start by more than half of the farthest and comes back within a tenth of it.
_LEAVES, _RETURNS = 0.5, 0.1


@dataclass(frozen=True)
class Cut:
    """One motion of a recording.

    Attributes:
        item: it.
        begin: its first row in the recording.
        end: its last row.
        kept: whether it ends where the first motion ends; else it is a way back, which shows no task.
        why: what it was cut at.
    """

    item: Demonstration
    begin: int
    end: int
    kept: bool
    why: str

    @property
    def way(self) -> float:
        """Length of its path [m]."""
        return float(arc_lengths(self.item.poses[:, pose.POSITION])[-1])


def motions_of(item: Demonstration) -> list[Cut]:
    """Return the motions in a recording: what lies between rests, else the loops from the start to the start.

    One motion is returned as it is, with its idle ends.
    """
    spans, why = _between_rests(item), "rests"
    if len(spans) < 2:
        spans, why = _loops(item), "returns to the start"
    if len(spans) < 2:
        return [Cut(item, 0, len(item) - 1, True, "")]
    ends = item.poses[[end for _, end in spans], pose.POSITION]
    begins = item.poses[[begin for begin, _ in spans], pose.POSITION]
    way = float(np.median(np.linalg.norm(ends - begins, axis=1)))
    kept = np.linalg.norm(ends - ends[0], axis=1) <= max(_SAME_END * way, _LEAST_M)
    return [cut_between(item, *span, bool(keep), why) for span, keep in zip(spans, kept, strict=True)]


def cut_between(item: Demonstration, begin: int, end: int, kept: bool, why: str) -> Cut:
    """Return the motion from one row to another; its clock begins at 0, unless it is all of the recording."""
    if (begin, end) == (0, len(item) - 1):
        return Cut(item, begin, end, kept, why)
    joints = None if item.joints is None else item.joints[begin : end + 1]
    times = item.times[begin : end + 1]
    return Cut(Demonstration(times - times[0], item.poses[begin : end + 1], joints), begin, end, kept, why)


def _between_rests(item: Demonstration) -> list[tuple[int, int]]:
    """Return first and last row of every motion between two rests, or between a rest and an end."""
    rests = _rests(item)
    edges = [0, *(each for rest in rests for each in rest), len(item) - 1]
    # From the end of a rest to the begin of the next.
    spans = [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a + 1]
    ways = [float(np.linalg.norm(np.ptp(item.poses[a : b + 1, pose.POSITION], axis=0))) for a, b in spans]
    least = max(_SHORTEST * max(ways, default=0.0), _LEAST_M)
    return [span for span, way in zip(spans, ways, strict=True) if way >= least]


def _rests(item: Demonstration) -> list[tuple[int, int]]:
    """Return first and last row of every rest: the pose stays near its first row's for long enough."""
    found: list[tuple[int, int]] = []
    # The row half a second on, of every row: where even that is far, no rest begins.
    ahead = np.minimum(np.searchsorted(item.times, item.times + _REST_S), len(item) - 1)
    candidates = np.flatnonzero(
        (pose.position_distance(item.poses, item.poses[ahead]) <= _STILL_M)
        & (item.times[ahead] - item.times >= 0.9 * _REST_S)
    )
    # Turns take longest to measure, and most rows are out already.
    candidates = candidates[_near(item.poses[candidates], item.poses[ahead[candidates]])]
    row, count = 0, len(item)
    while (place := int(np.searchsorted(candidates, row))) < len(candidates):
        row = int(candidates[place])
        stop = int(ahead[row])
        if not _near(item.poses[row : stop + 1], item.poses[row]).all():
            row += 1
            continue
        block = 64
        while stop + 1 < count:
            near = _near(item.poses[stop + 1 : stop + 1 + block], item.poses[row])
            stop += len(near) if near.all() else int(near.argmin())
            if not near.all():
                break
            block *= 2
        found.append((row, stop))
        row = stop + 1
    return found


def _near(poses: Array, others: Array) -> np.ndarray:
    near = pose.position_distance(poses, others) <= _STILL_M
    return np.asarray(near & (pose.rotation_distance(poses, others) <= _STILL_RAD))


def _loops(item: Demonstration) -> list[tuple[int, int]]:
    """Return first and last row of every loop that leaves the start and comes back to it."""
    away = pose.position_distance(item.poses, item.poses[0])
    farthest = float(away.max())
    if farthest < _LEAST_M:
        return []
    cuts, left, nearest = [0], False, 0
    far = away > _LEAVES * farthest
    # Between far and near nothing happens; the rest falls into runs of rows that are far, or near.
    rows = np.flatnonzero(far | (away <= _RETURNS * farthest))
    for run in np.split(rows, np.flatnonzero(np.diff(far[rows])) + 1):
        if far[run[0]]:
            if left and nearest > cuts[-1]:
                cuts.append(nearest)
            left, nearest = True, -1
        elif left:
            nearest = int(run[away[run].argmin()])
    if left and nearest > cuts[-1]:
        cuts.append(nearest)
    return list(pairwise(cuts)) if len(cuts) > 2 else []
