"""The metrics: Wilson's interval, deviations, references, and what is made of episodes."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from helpers_shelf import held_out, shelf, taught
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.evaluation.metrics import (
    SAMPLES,
    deviations,
    measure,
    reference_paths,
    resampled,
    turn_report,
    wilson_interval,
)
from koopdqn.evaluation.schema import MethodReport
from koopdqn.paths import discrete_frechet
from koopdqn.pose import Array
from koopdqn.tasks.rollout import FAILURES, SUCCESS, Episode
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import Task

TURNED_TWO_DEGREES = pose.from_rotation_vector(np.radians([2.0, 0.0, 0.0]))


def line(start: tuple[float, float, float], end: tuple[float, float, float], count: int) -> Array:
    return pose.make(np.linspace(start, end, count), [1.0, 0.0, 0.0, 0.0])


def episode(poses: Array, outcome: str = SUCCESS) -> Episode:
    return Episode(poses, np.zeros((len(poses), 6)), outcome)


def measured(episodes: list[Episode], references: list[Array], task: Task | None = None) -> MethodReport:
    task = task or shelf().task
    return measure(episodes, references, task, taught().trust, taught().model.start_frame, shelf().reachability)


@given(trials=st.integers(1, 400), data=st.data())
def test_wilsons_interval_solves_its_defining_equation(trials: int, data: st.DataObject) -> None:
    successes = data.draw(st.integers(0, trials))
    share, z = successes / trials, 1.959963984540054
    low, high = wilson_interval(successes, trials)
    assert 0 <= low <= share <= high <= 1
    for bound in (low, high):
        assert (share - bound) ** 2 == pytest.approx(z * z * bound * (1 - bound) / trials, abs=1e-12)


@given(successes=st.integers(0, 100))
def test_wilsons_interval_mirrors(successes: int) -> None:
    low, high = wilson_interval(successes, 100)
    assert wilson_interval(100 - successes, 100) == pytest.approx((1 - high, 1 - low))


def test_wilsons_interval_without_trials_is_everything() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 3), (4, 3)])
def test_wilsons_interval_refuses_impossible_counts(successes: int, trials: int) -> None:
    with pytest.raises(ValueError, match=f"found {successes}"):
        wilson_interval(successes, trials)


def frechet_by_definition(gap: Array) -> float:
    """Return the discrete Fréchet distance by the recursion, entry by entry."""

    @cache
    def walked(i: int, j: int) -> float:
        if i == j == 0:
            return float(gap[0, 0])
        before = [walked(a, b) for a, b in ((i - 1, j), (i - 1, j - 1), (i, j - 1)) if a >= 0 and b >= 0]
        return max(min(before), float(gap[i, j]))

    return walked(gap.shape[0] - 1, gap.shape[1] - 1)


@given(st.integers(1, 7), st.integers(1, 7), st.integers(0, 10_000))
def test_the_frechet_distance_is_that_of_the_recursion(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first, second = rng.normal(size=(3, n, 1, 2)), rng.normal(size=(3, 1, m, 2))
    gap = np.linalg.norm(first - second, axis=3)
    assert np.allclose(discrete_frechet(gap), [frechet_by_definition(table) for table in gap], atol=0)
    assert np.allclose(discrete_frechet(gap.swapaxes(1, 2)), discrete_frechet(gap), atol=0)


def test_the_frechet_distance_sees_a_way_back_that_the_nearest_points_do_not() -> None:
    there = np.array([0.0, 1.0, 2.0, 3.0])
    back = np.array([0.0, 3.0, 0.0, 3.0])
    assert discrete_frechet(np.abs(there[:, None] - back)[None]).tolist() == [2.0]


def test_the_frechet_distance_refuses_curves_without_points() -> None:
    with pytest.raises(ValueError, match="found"):
        discrete_frechet(np.zeros((2, 0, 3)))


@given(st.integers(2, 40), st.integers(2, 40), st.floats(0.0, 0.05))
def test_parallel_lines_deviate_by_their_distance_however_they_are_sampled(n: int, m: int, gap: float) -> None:
    path, reference = line((0, gap, 0), (0.4, gap, 0), n), line((0, 0, 0), (0.4, 0, 0), m)
    apart = deviations([path], [reference])
    for values in (apart.matched, apart.lateral, apart.frechet):
        assert np.allclose(values, gap, atol=1e-9)
    assert apart.rotation.max() < 1e-9


def test_a_path_sampled_unevenly_in_time_deviates_by_nothing() -> None:
    curve = np.stack([np.cos(angles := np.linspace(0, 3, 4001)), np.sin(angles), angles / 5], axis=1)
    slow_then_fast = np.unique((4000 * np.linspace(0, 1, 900) ** 3).astype(int))
    reference, path = (pose.make(curve[rows], [1.0, 0, 0, 0]) for rows in (slice(None), slow_then_fast))
    assert deviations([path], [reference]).matched.max() < 1e-3


def test_lateral_deviation_is_to_the_line_between_the_points_of_the_reference() -> None:
    reference = line((0, 0, 0), (1, 0, 0), 2)
    spacing = 1.0 / (SAMPLES - 1)
    path = line((0.5 * spacing, 0.001, 0), (1 - 0.5 * spacing, 0.001, 0), 50)
    assert np.allclose(deviations([path], [reference]).lateral, 0.001, atol=1e-9)


def test_lateral_deviation_is_never_over_the_other_two() -> None:
    rng = np.random.default_rng(0)
    paths = [pose.make(np.cumsum(rng.normal(size=(30, 3)), axis=0), [1.0, 0, 0, 0]) for _ in range(90)]
    apart = deviations(paths[:45], paths[45:])
    assert np.all(apart.lateral <= apart.matched + 1e-9)
    assert np.all(apart.lateral.max(axis=1) <= apart.frechet + 1e-9)
    assert np.all(apart.frechet <= apart.matched.max(axis=1) + 1e-9)


def test_rotation_is_compared_at_the_same_share_of_the_way() -> None:
    angles = np.linspace(0, 1, 30)[:, None] * [0.0, 0.0, 1.2]
    turning = pose.make(np.linspace((0, 0, 0), (0.3, 0, 0), 30), pose.from_rotation_vector(angles))
    more = turning.copy()
    more[:, 3:] = pose.multiply(TURNED_TWO_DEGREES, more[:, 3:])
    assert np.allclose(deviations([more], [turning]).rotation, np.radians(2.0), atol=1e-4)


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    angles = np.linspace(0, 1, 30)[:, None] * [0.0, 0.0, 2.5]
    path = pose.make(np.linspace((0, 0, 0), (0.3, 0, 0), 30), pose.from_rotation_vector(angles))
    flipped = path.copy()
    flipped[::3, 3:] *= -1.0
    before = flipped.copy()
    assert pose.rotation_distance(resampled(flipped), resampled(path)).max() < 1e-7
    assert np.array_equal(flipped, before)


def test_turning_in_place_is_resampled_by_turn() -> None:
    angles = np.array([0.0, 0.1, 1.0])[:, None] * [0.0, 0.0, 1.0]
    path = pose.make(np.zeros((3, 3)), pose.from_rotation_vector(angles))
    steps = pose.rotation_distance(resampled(path)[1:], resampled(path)[:-1])
    assert np.allclose(steps, 1.0 / (SAMPLES - 1), atol=1e-3)


def test_references_are_the_demonstrators_own_paths() -> None:
    task, starts = shelf().task, held_out(4)[0]
    for start, path in zip(starts, reference_paths(task, starts, 700), strict=True):
        alone = task.demonstrator.roll_out(start, 700)
        assert len(path) == len(alone)
        # Which of two equally near points of its path the expert takes may depend on rounding.
        assert pose.position_distance(path, alone).max() < 1e-4


def test_references_stop_at_the_limit() -> None:
    task, starts = shelf().task, held_out(3)[0]
    assert [len(path) for path in reference_paths(task, starts, 9)] == [10, 10, 10]


def test_means_are_over_episodes_and_maxima_over_all() -> None:
    references = [line((0, 0, 0), (0.4, 0, 0), 50)] * 4
    gaps = [0.001, 0.002, 0.003, 0.010]
    episodes = [episode(line((0, gap, 0), (0.4, gap, 0), 81)) for gap in gaps]
    report = measured(episodes, references)
    for deviation in (report.path_deviation_mm, report.lateral_deviation_mm):
        assert deviation.mean == pytest.approx(4.0)
        assert deviation.max == pytest.approx(10.0)
        assert deviation.p95_of_max == pytest.approx(np.percentile([1, 2, 3, 10], 95))
    assert report.path_deviation_mm.frechet == pytest.approx(4.0)
    assert report.path_length_ratio == pytest.approx(1.0)
    assert (report.steps.mean, report.steps.max) == (80, 80)


def test_deviations_are_over_all_episodes_and_over_the_successful_ones() -> None:
    reference, gaps, outcomes = line((0, 0, 0), (0.4, 0, 0), 50), [0.001, 0.003, 0.010], [SUCCESS, SUCCESS, "stuck"]
    episodes = [
        episode(line((0, gap, 0), (0.4, gap, 0), 81), outcome) for gap, outcome in zip(gaps, outcomes, strict=True)
    ]
    report = measured([episode(reference[:1]), *episodes], [reference] * 4)
    alone = measured(episodes[:2], [reference] * 2)
    assert report.lateral_deviation_mm.max == pytest.approx(10.0)
    assert report.successful is not None
    assert report.successful.lateral_deviation_mm.max == pytest.approx(3.0)
    assert report.successful == alone.successful
    for key, value in report.successful:
        assert value == getattr(alone, key)
    assert measured(episodes[2:], [reference]).successful is None


def test_a_path_that_does_not_turn_has_no_turn_to_tell() -> None:
    goal = shelf().task.goal
    kept = pose.make(np.linspace(goal[:3] + 0.3, goal[:3], 50), goal[3:])
    kept[1:, 3:] = pose.multiply(pose.from_rotation_vector([1e-6, 0.0, 0.0]), kept[1:, 3:])
    assert turn_report([kept], shelf().task).model_dump() == {
        "half_before_third": None,
        "while_moving": dict.fromkeys(("mean", "min", "max")),
    }


def test_a_demonstrators_own_path_is_perfect() -> None:
    task, starts = shelf().task, held_out(4)[0]
    references = reference_paths(task, starts, 700)
    report = measured([episode(path) for path in references], references)
    assert report.success_rate == 1.0
    assert report.path_deviation_mm.max == pytest.approx(0.0, abs=1e-9)
    assert report.path_length_ratio == pytest.approx(1.0)
    assert report.final_position_error_mm.max == pytest.approx(0.0, abs=1e-2)
    assert report.tube_fraction is not None
    assert report.tube_fraction > 0.5


def test_failures_are_counted_by_cause_and_every_cause_is_there() -> None:
    reference = line((0, 0, 0), (0.4, 0, 0), 50)
    outcomes = [SUCCESS, "collision", "collision", "stuck"]
    report = measured([episode(reference, outcome) for outcome in outcomes], [reference] * 4)
    assert report.success_rate == 0.25
    assert tuple(report.success_interval_95) == wilson_interval(1, 4)
    assert report.failures == {**dict.fromkeys(FAILURES, 0), "collision": 2, "stuck": 1}


def test_an_episode_without_a_step_counts_as_failure_but_has_no_deviation() -> None:
    reference = line((0, 0, 0), (0.4, 0, 0), 50)
    beside = line((0, 0.002, 0), (0.4, 0.002, 0), 50)
    report = measured([episode(reference[:1], "collision"), episode(beside)], [reference, reference])
    assert report.measured_episodes == 1
    assert report.path_deviation_mm.mean == pytest.approx(2.0)
    assert report.steps.mean == 24.5
    assert report.success_rate == 0.5


def test_without_any_step_nothing_is_measured_and_nothing_is_nan() -> None:
    reference = line((0, 0, 0), (0.4, 0, 0), 50)
    report = measured([episode(reference[:1], "collision")], [reference])
    assert report.path_deviation_mm.model_dump() == dict.fromkeys(("mean", "max", "p95_of_max", "frechet"))
    assert report.tube_fraction is None
    assert report.path_length_ratio is None
    distance = np.linalg.norm(shelf().task.goal[:3]) * 1e3
    assert report.final_position_error_mm.mean == pytest.approx(distance)


class _Measuring(ShelfTask):
    def measures(self, path: Array, step_seconds: float) -> dict[str, float]:
        return {"lowest_m": float(path[:, 2].min()), "seconds": step_seconds * (len(path) - 1)}


def test_what_a_users_task_measures_is_reported() -> None:
    task = _Measuring.model_construct(**dict(shelf().task))
    lines = [line((0, 0, height), (0.1, 0, height), 11) for height in (-0.1, 0.3)]
    report = measured([episode(each) for each in lines], lines, task)
    step = shelf().reachability.arm.step_seconds
    assert {name: tuple(found) for name, found in report.model_dump()["task_measures"].items()} == {
        "lowest_m": ("mean", "min", "max"),
        "seconds": ("mean", "min", "max"),
    }
    lowest, seconds = report.task_measures["lowest_m"], report.task_measures["seconds"]
    assert (lowest.min, lowest.max) == (-0.1, 0.3)
    assert lowest.mean == pytest.approx(0.1)
    assert seconds.max == pytest.approx(10 * step)
    assert measured([episode(lines[0])], lines[:1]).task_measures == {}


class _Spilling(ShelfTask):
    def measures(self, path: Array, step_seconds: float) -> dict[str, float]:
        low = bool(path[:, 2].min() < 0.0)
        return {"spilled": low, "least_m": 0.1 if low else np.inf, "never": np.nan}


def test_a_users_task_may_measure_truths_and_what_a_path_has_none_of() -> None:
    task = _Spilling.model_construct(**dict(shelf().task))
    lines = [line((0, 0, height), (0.1, 0, height), 11) for height in (-0.1, 0.3)]
    found = measured([episode(each) for each in lines], lines, task).model_dump()["task_measures"]
    assert found["spilled"] == {"mean": 0.5, "min": 0.0, "max": 1.0}
    assert found["least_m"] == {"mean": 0.1, "min": 0.1, "max": 0.1}
    assert found["never"] == dict.fromkeys(("mean", "min", "max"))


def test_the_tube_fraction_is_the_share_of_reached_states_inside() -> None:
    trajectory = taught().trajectories[0]
    away = trajectory[-2:] + np.array([0.0, 0.0, 0.5, 0, 0, 0, 0])
    inside = taught().trust.contains(trajectory[1:], np.arange(1, len(trajectory)))
    report = measured([episode(trajectory), episode(np.concatenate([trajectory[:1], away]))], [trajectory] * 2)
    assert report.tube_fraction == pytest.approx(inside.sum() / (len(inside) + 2))


def test_a_longer_path_has_a_larger_length_ratio() -> None:
    reference = line((0, 0, 0), (0.4, 0, 0), 50)
    corners = [(0, 0, 0), (0, 0.3, 0), (0.4, 0.3, 0)]
    detour = np.concatenate([line(a, b, 20) for a, b in pairwise(corners)])
    assert measured([episode(detour)], [reference]).path_length_ratio == pytest.approx(0.7 / 0.4)
