"""Steps that clean a demonstration, each by its name; nothing but what a step is named for changes."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.preprocess import smooth, trim_idle
from koopdqn.paths import between
from koopdqn.pose import Array
from koopdqn.settings import Settings

# A pose that repeats the one before it within this is the same sample [m, rad].
_SAME: Final = (1e-7, 1e-6)
# A run of the same pose that lasts longer is a rest, of which both ends stay [s].
_REST_S: Final = 0.2
# A sample off the median of the five around it by more than this, and by six times what is usual, is an outlier, if it
# is also farther from both neighbours than twice what lies between them and three usual steps; at a corner it is not.
_OUT_M, _OUT_RAD, _USUAL = 0.005, 0.05, 6.0
_MOST_TIMES: Final = 10.0
# A longer step [m] is a jump if it is so many times as fast as both beside it and as nearly all [%] that move at all.
_JUMP_M, _JUMP, _NEARLY_ALL = 0.02, 5.0, 95.0


class InspectSettings(Settings):
    """Which steps clean demonstrations before they are judged; signs of quaternions are always made continuous."""

    repeated: bool = Field(description="leave out samples that repeat the one before")
    outliers: bool = Field(description="leave out single samples far off their neighbours")
    idle_ends: bool = Field(description="cut idle ends off")
    smoothing: bool = Field(description="smooth sensor noise out")
    resampling: bool = Field(description="even the time steps")


@dataclass(frozen=True)
class Cleaned:
    """A demonstration after the steps.

    Attributes:
        item: it.
        repeated: samples left out as repeated. ``outliers``: as outliers.
        before: idle time cut off at the start [s]. ``after``: at the end.
    """

    item: Demonstration
    repeated: int = 0
    outliers: int = 0
    before: float = 0.0
    after: float = 0.0


def clean(item: Demonstration, steps: InspectSettings) -> Cleaned:
    """Return a demonstration after the steps that are switched on.

    Raises:
        BadInputError: nothing moves, where idle ends are cut off.
    """
    repeated = outliers = 0
    before = after = 0.0
    if steps.repeated:
        kept = ~repeats(item)
        item, repeated = _rows(item, kept), int((~kept).sum())
    if steps.outliers:
        sound = without_outliers(item)
        item, outliers = sound, len(item) - len(sound)
    if steps.idle_ends:
        trimmed = trim_idle(item)
        item, before, after = _unhurried(trimmed.item, trimmed.before, trimmed.after)
    if steps.smoothing:
        item = smooth(item)
    if steps.resampling:
        item = evened(item)
    return Cleaned(item, repeated, outliers, before, after)


def _unhurried(item: Demonstration, before: float, after: float) -> tuple[Demonstration, float, float]:
    """Return a trimmed demonstration and its cut times [s], of which each end gets back what it needs.

    The pose at rest may be some millimetres from the sample beside it: the way there is made no faster than the next.
    """
    if len(item) < 3:
        return item, before, after
    times, poses = item.times.copy(), item.poses
    steps = np.stack([pose.position_distance(poses[1:], poses[:-1]), pose.rotation_distance(poses[1:], poses[:-1])])
    lasts = np.diff(times)

    def needed(end: int, beside: int, most: float) -> float:
        moving = steps[:, beside] > 0.0
        pace = np.divide(steps[:, end], steps[:, beside], where=moving, out=np.zeros(2))
        return float(np.clip(pace.max() * lasts[beside] - lasts[end], 0.0, most))

    given_before, given_after = needed(0, 1, before), needed(-1, -2, after)
    times[0] -= given_before
    times[-1] += given_after
    return Demonstration(times, poses, item.joints), before - given_before, after - given_after


def repeats(item: Demonstration) -> np.ndarray:
    """Return which samples (N,) repeat the one before while the clock runs; both ends of a rest stay."""
    poses = item.poses
    same = pose.position_distance(poses[1:], poses[:-1]) <= _SAME[0]
    same = np.concatenate([[False], same & (pose.rotation_distance(poses[1:], poses[:-1]) <= _SAME[1])])
    begins = np.flatnonzero(~same)
    ends = np.append(begins[1:], len(poses)) - 1
    long = item.times[ends] - item.times[begins] > _REST_S
    same[ends[long]] = False
    return np.asarray(same)


def without_outliers(item: Demonstration) -> Demonstration:
    """Return a demonstration without the samples that are :func:`outlying`, until none is; itself where none was."""
    while (bad := outlying(item)).any():
        item = _rows(item, ~bad)
    return item


def jump_of(item: Demonstration) -> float:
    """Return the largest step [m] that is made far faster than those beside it and nearly all others; 0 if none is.

    A fast motion between slow ones gathers speed over several samples; a jump is of one step, or of two in a row.
    More fast steps in a row are taken for a motion.
    """
    moved = pose.position_distance(item.poses[1:], item.poses[:-1])
    speed = moved / np.diff(item.times)
    usual = np.percentile(speed[speed > 0.0], _NEARLY_ALL, method="lower") if (speed > 0.0).any() else 0.0
    before2, before, _, after, after2 = np.lib.stride_tricks.sliding_window_view(np.pad(speed, 2), 5).T
    beside = np.min([np.maximum(before, after), np.maximum(before, after2), np.maximum(before2, after)], axis=0)
    return float(moved[(moved > _JUMP_M) & (speed > _JUMP * np.maximum(usual, beside))].max(initial=0.0))


def outlying(item: Demonstration) -> np.ndarray:
    """Return which samples (N,) are far off the median of the five around them, in position or orientation."""
    if len(item) < 7:
        return np.zeros(len(item), dtype=bool)
    off = np.linalg.norm(_residual(item.poses[:, pose.POSITION]), axis=1)
    turned = 2.0 * np.linalg.norm(_residual(item.poses[:, pose.QUATERNION]), axis=1)
    found = [
        values > max(least, _USUAL * 1.4826 * float(np.median(values)))
        for values, least in ((off, _OUT_M), (turned, _OUT_RAD))
    ]
    alone = [_alone(item.poses[:, part]) for part in (pose.POSITION, pose.QUATERNION)]
    return np.asarray((found[0] & alone[0]) | (found[1] & alone[1]))


def _alone(values: Array) -> np.ndarray:
    """Return which rows (N,) are far from both neighbours, which are near each other; an end has one neighbour."""
    step = np.linalg.norm(np.diff(values, axis=0), axis=1)
    across = np.linalg.norm(values[2:] - values[:-2], axis=1)
    usual = 3.0 * float(np.median(step))
    alone = np.minimum(step[:-1], step[1:]) > np.maximum(2.0 * across, usual)
    ends = [step[row] > max(_JUMP * step[beside], 2.0 * usual) for row, beside in ((0, 1), (-1, -2))]
    return np.concatenate([ends[:1], alone, ends[1:]])


def _residual(values: Array) -> Array:
    from scipy.ndimage import median_filter

    return np.asarray(values - median_filter(values, size=(5, 1), mode="mirror"))


def _rows(item: Demonstration, kept: np.ndarray) -> Demonstration:
    if kept.all() or kept.sum() < 2:
        return item
    return Demonstration(item.times[kept], item.poses[kept], None if item.joints is None else item.joints[kept])


def evened(item: Demonstration) -> Demonstration:
    """Return a demonstration sampled evenly at its own median rate, without joint angles; ends stay.

    One whose clock jumps so far that there would be over ten times as many samples is returned as it is.
    """
    span = float(item.times[-1] - item.times[0])
    steps = span / float(np.median(np.diff(item.times)))
    if steps > _MOST_TIMES * len(item):
        return item
    count = max(2, round(steps) + 1)
    times = np.linspace(item.times[0], item.times[-1], count)
    before = np.clip(np.searchsorted(item.times, times, side="right") - 1, 0, len(item) - 2)
    share = (times - item.times[before]) / (item.times[before + 1] - item.times[before])
    return Demonstration(times, between(item.poses[before], item.poses[before + 1], np.clip(share, 0.0, 1.0)))


STEPS: Final[tuple[str, ...]] = tuple(InspectSettings.model_fields)
"""The names of the steps, in their order."""
