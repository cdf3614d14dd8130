"""What is measured of finished episodes, beside the demonstrator's own paths from the same starts."""

from collections import Counter
from statistics import NormalDist

import numpy as np

from koopdqn import pose
from koopdqn.evaluation.deviation import deviations
from koopdqn.evaluation.schema import LateralDeviation, Measure, MethodReport, PathDeviation, Range, Summary, TurnReport
from koopdqn.intent.trust import TrustDomain
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.tasks.reachability import Reachability
from koopdqn.tasks.rollout import FAILURES, SUCCESS, Episode
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the lower and upper bound of the success probability, each within 0…1.

    Wilson's score interval (1927) keeps its meaning at 0 and at all successes, where the normal
    approximation has no width. Without trials nothing is known: (0, 1).

    Args:
        successes: how many of the trials succeeded.
        trials: how many there were.
        confidence: probability with which the interval covers the truth.

    Raises:
        ValueError: successes are not within 0…trials, or the confidence is not within 0…1, both excluded.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be within 0…{trials} (the trials), found {successes}")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be over 0 and under 1, found {confidence}")
    if not trials:
        return 0.0, 1.0
    z = NormalDist().inv_cdf(0.5 + 0.5 * confidence)
    share = successes / trials
    weight = 1.0 / (1.0 + z * z / trials)
    center = weight * (share + z * z / (2 * trials))
    half: float = weight * z * (share * (1 - share) / trials + (z / (2 * trials)) ** 2) ** 0.5
    # Rounding leaves 1e-17 where the bound is exactly 0 or 1.
    low = 0.0 if successes == 0 else max(0.0, center - half)
    high = 1.0 if successes == trials else min(1.0, center + half)
    return low, high


_MILLIMETRES = 1e3


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
    path that ends early is compared, share by share of its own arc length, with the whole reference.

    Args:
        episodes: at least one.
        references: the demonstrator's own path (T, 7) from each episode's start; None where there is none, and
            then no deviation.
        task: gives the goal.
        trust: the tube.
        frame: in which the tube knows poses.
        reachability: how long the steps take.
    """
    if references is not None and len(references) != len(episodes):
        raise ValueError(f"there must be one reference for each of {len(episodes)} episodes, found {len(references)}")
    outcomes = Counter(episode.outcome for episode in episodes)
    paths = [episode.poses for episode in episodes if episode.steps]
    moved = [(e.poses, reference) for e, reference in zip(episodes, references or (), strict=False) if e.steps]
    apart = deviations([path for path, _ in moved], [reference for _, reference in moved])
    matched, stairs, lateral = (
        _spread(values * _MILLIMETRES) for values in (apart.matched, apart.stairs, apart.lateral)
    )
    ends = np.array([episode.poses[-1] for episode in episodes])
    low, high = wilson_interval(outcomes[SUCCESS], len(episodes))
    return MethodReport(
        success_rate=outcomes[SUCCESS] / len(episodes),
        success_interval_95=[low, high],
        measured_episodes=len(paths),
        path_deviation_mm=PathDeviation(**matched, frechet=_mean(apart.frechet * _MILLIMETRES)),
        stairs_deviation_mm=LateralDeviation(**stairs),
        lateral_deviation_mm=LateralDeviation(**lateral),
        rotation_deviation_deg=summary(np.degrees(apart.rotation)),
        tube_fraction=_tube_fraction(paths, frame, trust),
        final_position_error_mm=summary(pose.position_distance(ends, task.goal) * _MILLIMETRES),
        final_rotation_error_deg=summary(np.degrees(pose.rotation_distance(ends, task.goal))),
        path_length_ratio=_length_ratio(moved),
        steps=summary(np.array([episode.steps for episode in episodes], dtype=float)),
        time_stretch=_time_stretch(episodes, reachability),
        failures={cause: outcomes[cause] for cause in FAILURES},
        turn=turn_report(paths, task) if task.orientation == "learned" else None,
        task_measures=_task_measures(paths, task, reachability.step_seconds),
    )


def _time_stretch(episodes: list[Episode], reachability: Reachability) -> Summary:
    each = [reachability.durations(e.joints) / reachability.step_seconds for e in episodes if e.steps]
    return Summary(
        mean=_mean(np.array([times.mean() for times in each])), max=max((float(t.max()) for t in each), default=None)
    )


def turn_report(paths: list[Array], task: Task) -> TurnReport:
    """Return how turn and motion go together along paths (T, 7) of a task whose orientation is learned."""
    leads, shares = [], []
    for path in paths:
        left, unturned = pose.position_distance(path, task.goal), pose.rotation_distance(path, task.goal)
        halved = unturned <= unturned[0] / 2
        leads.append(bool(halved.any()) and bool(left[halved.argmax()] > left[0] * 2 / 3))
        turned = pose.rotation_distance(path[1:], path[:-1])
        if turned.sum() > 0:
            moving = pose.position_distance(path[1:], path[:-1]) > 0
            shares.append(float(turned[moving].sum() / turned.sum()))
    return TurnReport(half_before_third=float(np.mean(leads)) if leads else None, while_moving=_range(shares))


def _task_measures(paths: list[Array], task: Task, step_seconds: float) -> dict[str, Measure]:
    each = [task.measures(path, step_seconds) for path in paths]
    columns = {name: [values[name] for values in each] for name in (each[0] if each else ())}
    return {
        name: Measure(mean=float(np.mean(values)), min=min(values), max=max(values)) for name, values in columns.items()
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
    reached = np.concatenate([frame.placed(path[1:], path[:1]) for path in paths])
    steps = np.concatenate([np.arange(1, len(path)) for path in paths])
    return float(trust.inside(reached, steps).mean())


def _length_ratio(moved: list[tuple[Array, Array]]) -> float | None:
    lengths = np.array([[arc_lengths(path[:, pose.POSITION])[-1] for path in pair] for pair in moved])
    # A start at the goal itself has a reference of no length, and no ratio.
    lengths = lengths.reshape(-1, 2)[lengths.reshape(-1, 2)[:, 1] > 0]
    return float((lengths[:, 0] / lengths[:, 1]).mean()) if len(lengths) else None
