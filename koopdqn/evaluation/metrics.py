"""What is measured of finished episodes: success, and how far their paths are from their references."""

from collections import Counter
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import continuous
from koopdqn.evaluation.schema import (
    LateralDeviation,
    MethodReport,
    PathDeviation,
    Range,
    SuccessfulReport,
    Summary,
    TurnReport,
)
from koopdqn.intent.trust import TrustDomain
from koopdqn.paths import arc_lengths, discrete_frechet, to_count
from koopdqn.pose import Array
from koopdqn.tasks.rollout import FAILURES, SUCCESS, Episode
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Reachability

SAMPLES = 200
"""Points at equal shares of arc length at which a path and its reference are compared."""

# A path of actions is a staircase of ten directions, which lengthens it by up to √3, here more and there less. Arc
# length is measured of the curve that the stairs follow: a parabola fitted to the poses around each, about 10 cm.
_WINDOW = 51
_ORDER = 2

# Pairs of paths handled together: their tables of differences (E, K, K, 3) then stay under 40 MB.
_TOGETHER = 40


@dataclass(frozen=True)
class Deviations:
    """Deviations of E paths from their references, at K = :data:`SAMPLES` points each.

    Attributes:
        matched: (E, K) [m] from the reference's point at the same share of arc length, of the curve without stairs.
        stairs: (E, K) [m] the same with the arc length of the stairs themselves.
        lateral: (E, K) [m] from the nearest point of the reference.
        rotation: (E, K) [rad] from the reference's orientation at the same share of arc length.
        frechet: (E,) [m] discrete Fréchet distance of the two rows of points.
    """

    matched: Array
    stairs: Array
    lateral: Array
    rotation: Array
    frechet: Array


def deviations(paths: list[Array], references: list[Array]) -> Deviations:
    """Return the deviations of pose paths (T, 7) from as many references (R, 7), of whatever lengths."""
    # Both are treated alike, so that a path does not deviate from itself.
    mine, theirs = _all_resampled(paths), _all_resampled(references)
    lateral, frechet = np.empty((len(mine), SAMPLES)), np.empty(len(mine))
    for begin in range(0, len(mine), _TOGETHER):
        part = slice(begin, begin + _TOGETHER)
        points = theirs[part, :, pose.POSITION]
        gap = np.linalg.norm(mine[part, :, None, pose.POSITION] - points[:, None], axis=3)  # (E, K, K)
        lateral[part], frechet[part] = _to_polyline(gap, points), discrete_frechet(gap)
    return Deviations(
        pose.position_distance(mine, theirs),
        pose.position_distance(_all_resampled(paths, smooth=False), _all_resampled(references, smooth=False)),
        lateral,
        pose.rotation_distance(mine, theirs),
        frechet,
    )


def _all_resampled(paths: list[Array], *, smooth: bool = True) -> Array:
    return np.array([resampled(path, smooth=smooth) for path in paths]).reshape(-1, SAMPLES, 7)


def hausdorff_mm(path: Array, reference: Array) -> float:
    """Return the Hausdorff distance [mm] of two paths (T, 7) and (R, 7): the farthest either is from the other.

    Each is looked at in :data:`SAMPLES` points, evenly spaced along it.
    """
    there, back = (deviations([one], [other]).lateral for one, other in ((path, reference), (reference, path)))
    return float(max(there.max(), back.max())) * 1e3


def resampled(path: Array, *, smooth: bool = True) -> Array:
    """Return a path (T, 7) at :data:`SAMPLES` equal shares of its arc length, or of its turn if it does not move.

    With ``smooth`` the arc length is that of :func:`without_stairs`; the poses are the path's own either way.
    """
    path = np.array(path)
    path[:, pose.QUATERNION] = continuous(path[:, pose.QUATERNION])
    return to_count(path, SAMPLES, arc_lengths(without_stairs(path[:, pose.POSITION])) if smooth else None)


def without_stairs(positions: Array) -> Array:
    """Return the curve (T, 3) that the stairs of positions (T, 3) follow, by Savitzky & Golay (1964)."""
    from scipy.signal import savgol_filter

    window = min(_WINDOW, len(positions) - 1 + len(positions) % 2)
    if window <= _ORDER:
        return positions
    return np.asarray(savgol_filter(positions, window, _ORDER, axis=0))


def _to_polyline(gap: Array, points: Array) -> Array:
    """Return distances (E, K) to polylines (E, M, 3), from the distances (E, K, M) to their points.

    Looked at are the two segments beside the nearest point.
    """
    squared = np.square(np.linalg.norm(np.diff(points, axis=1), axis=2))  # (E, M - 1)
    nearest = gap.argmin(axis=2)
    best = np.square(gap.min(axis=2))
    for first in (nearest - 1, nearest):
        first = np.clip(first, 0, squared.shape[1] - 1)
        a, b = (np.square(np.take_along_axis(gap, i[..., None], axis=2)[..., 0]) for i in (first, first + 1))
        length = np.take_along_axis(squared, first, axis=1)
        # The foot's share of the segment from the three sides of the triangle (law of cosines).
        share = np.clip((a - b + length) / np.where(length > 0, 2 * length, 1.0), 0.0, 1.0)
        best = np.minimum(best, a - share * (a - b + length) + share**2 * length)
    return np.asarray(np.sqrt(np.maximum(best, 0.0)))


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the bounds of Wilson's 95 % score interval (1927) of the success probability; (0, 1) without trials.

    Raises:
        ValueError: successes are not within 0…trials.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be within 0…{trials} (the trials), found {successes}")
    if not trials:
        return 0.0, 1.0
    z, share = NormalDist().inv_cdf(0.975), successes / trials
    weight = 1.0 / (1.0 + z * z / trials)
    center = weight * (share + z * z / (2 * trials))
    half: float = weight * z * (share * (1 - share) / trials + (z / (2 * trials)) ** 2) ** 0.5
    # Rounding leaves 1e-17 where the bound is exactly 0 or 1.
    return max(0.0, center - half) if successes else 0.0, min(1.0, center + half) if successes < trials else 1.0


_MM = 1e3


def measure(
    episodes: list[Episode],
    references: list[Array] | None,
    task: Task,
    trust: TrustDomain,
    frame: StartFrame,
    reachability: Reachability,
) -> MethodReport:
    """Return what is measured of a method's episodes; :class:`MethodReport` defines every quantity.

    Deviations and lengths are taken over all episodes that made at least one step, failed ones too: a
    path that ends early is compared, share by share of its own arc length, with the whole reference. Deviations are
    given over the successful ones alone besides.

    Args:
        episodes: at least one.
        references: the demonstrator's own path (T, 7) from each episode's start; None for none, and no deviation.
        task: gives the goal.
        trust: the tube.
        frame: in which the tube knows poses.
        reachability: how long the steps take.
    """
    if references is not None and len(references) != len(episodes):
        raise ValueError(f"there must be one reference for each of {len(episodes)} episodes, found {len(references)}")
    outcomes = Counter(episode.outcome for episode in episodes)
    paths = [episode.poses for episode in episodes if episode.steps]
    compared = [(e, reference) for e, reference in zip(episodes, references or (), strict=False) if e.steps]
    moved = [(e.poses, reference) for e, reference in compared]
    succeeded = np.array([e.outcome == SUCCESS for e, _ in compared], dtype=bool)
    apart = deviations([path for path, _ in moved], [reference for _, reference in moved])
    ends = np.array([episode.poses[-1] for episode in episodes])
    low, high = wilson_interval(outcomes[SUCCESS], len(episodes))
    return MethodReport(
        success_rate=outcomes[SUCCESS] / len(episodes),
        success_interval_95=[low, high],
        measured_episodes=len(paths),
        **_over(apart, slice(None)),
        successful=SuccessfulReport(**_over(apart, succeeded)) if succeeded.any() else None,
        tube_fraction=_tube_fraction(paths, frame, trust),
        final_position_error_mm=summary(pose.position_distance(ends, task.goal) * _MM),
        final_rotation_error_deg=summary(np.degrees(pose.rotation_distance(ends, task.goal))),
        path_length_ratio=_length_ratio(moved),
        steps=summary(np.array([episode.steps for episode in episodes], dtype=float)),
        time_stretch=_time_stretch(episodes, reachability),
        failures={cause: outcomes[cause] for cause in FAILURES},
        turn=turn_report(paths, task) if task.orientation == "learned" else None,
        task_measures=_task_measures(paths, task, reachability.arm.step_seconds),
    )


def _over(apart: Deviations, rows: np.ndarray | slice) -> dict[str, Any]:
    """Return the deviations of those paths (E,) that count, by their keys in a report."""
    matched, stairs, lateral = (_spread(values[rows] * _MM) for values in (apart.matched, apart.stairs, apart.lateral))
    return {
        "path_deviation_mm": PathDeviation(**matched, frechet=_mean(apart.frechet[rows] * _MM)),
        "stairs_deviation_mm": LateralDeviation(**stairs),
        "lateral_deviation_mm": LateralDeviation(**lateral),
        "rotation_deviation_deg": summary(np.degrees(apart.rotation[rows])),
    }


def _time_stretch(episodes: list[Episode], reachability: Reachability) -> Summary:
    each = [reachability.durations(e.joints) / reachability.arm.step_seconds for e in episodes if e.steps]
    return Summary(
        mean=_mean(np.array([times.mean() for times in each])), max=max((float(t.max()) for t in each), default=None)
    )


def turn_report(paths: list[Array], task: Task) -> TurnReport:
    """Return how turn and motion go together along paths (T, 7) of a task whose orientation is learned."""
    leads, shares = [], []
    for path in paths:
        left, unturned = pose.position_distance(path, task.goal), pose.rotation_distance(path, task.goal)
        # Less than this is no turn that anybody learned: rounding, or noise of what was recorded.
        least = task.goal_rotation_tolerance_rad
        if unturned[0] > least:
            halved = unturned <= unturned[0] / 2
            leads.append(bool(halved.any()) and bool(left[halved.argmax()] > left[0] * 2 / 3))
        turned = pose.rotation_distance(path[1:], path[:-1])
        if turned.sum() > least:
            moving = pose.position_distance(path[1:], path[:-1]) > 0
            shares.append(float(turned[moving].sum() / turned.sum()))
    return TurnReport(half_before_third=float(np.mean(leads)) if leads else None, while_moving=_range(shares))


def _task_measures(paths: list[Array], task: Task, step_seconds: float) -> dict[str, Range]:
    each = [task.measures(path, step_seconds) for path in paths]
    # What a path has none of, such as a least distance where nothing came near, is not finite.
    return {
        name: _range([float(values[name]) for values in each if np.isfinite(values[name])])
        for name in (each[0] if each else ())
    }


def _range(values: list[float]) -> Range:
    if not values:
        return Range(mean=None, min=None, max=None)
    return Range(mean=float(np.mean(values)), min=min(values), max=max(values))


def summary(values: Array) -> Summary:
    """Return mean and largest of values, None of none.

    Of values (E, K), with as many in each episode, the mean is also the mean of the episodes' means.
    """
    return Summary(mean=_mean(values), max=float(values.max()) if values.size else None)


def _mean(values: Array) -> float | None:
    return float(values.mean()) if values.size else None


def _spread(values: Array) -> dict[str, float | None]:
    """Return mean, maximum and 95th percentile of the episodes' maxima of values (E, K)."""
    if not values.size:
        return {"mean": None, "max": None, "p95_of_max": None}
    largest = values.max(axis=1)
    return {"mean": _mean(values), "max": float(largest.max()), "p95_of_max": float(np.percentile(largest, 95))}


def _tube_fraction(paths: list[Array], frame: StartFrame, trust: TrustDomain) -> float | None:
    if not paths:
        return None
    reached = np.concatenate([frame.along(path)[1:] for path in paths])
    steps = np.concatenate([np.arange(1, len(path)) for path in paths])
    return float(trust.contains(reached, steps).mean())


def _length_ratio(moved: list[tuple[Array, Array]]) -> float | None:
    lengths = np.array([[arc_lengths(path[:, pose.POSITION])[-1] for path in pair] for pair in moved])
    # A start at the goal itself has a reference of no length, and no ratio.
    lengths = lengths.reshape(-1, 2)[lengths.reshape(-1, 2)[:, 1] > 0]
    return float((lengths[:, 0] / lengths[:, 1]).mean()) if len(lengths) else None


# A demonstrator that moves less than this [m, rad] in a step has come to rest; it is far under any tolerance.
_REST = 1e-6


def reference_paths(task: Task, starts: Array, limit: int) -> list[Array]:
    """Return the demonstrator's own paths (T, 7) from starts (N, 7) until it rests, at most ``limit`` steps.

    Each is the path of ``task.demonstrator.roll_out``; all are made side by side, which is some twenty
    times faster for a hundred starts.
    """
    paths = [[start] for start in starts]
    active = np.arange(len(starts))
    poses = np.array(starts)
    for _ in range(limit):
        reached = task.demonstrator.next_pose(poses)
        moving = (pose.position_distance(reached, poses) >= _REST) | (pose.rotation_distance(reached, poses) >= _REST)
        active, poses = active[moving], reached[moving]
        if not len(active):
            break
        for row, index in enumerate(active):
            paths[index].append(poses[row])
    return [np.array(path) for path in paths]
