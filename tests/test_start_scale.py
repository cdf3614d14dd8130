"""Wider start regions in evaluation."""

import numpy as np
import pytest
from helpers_shelf import reward_of, shelf, taught
from hypothesis import given
from hypothesis import strategies as st
from parts import load_parts

from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import Greedy
from koopdqn.evaluation.evaluate import Evaluation, evaluate
from koopdqn.evaluation.schema import EvaluationSettings
from koopdqn.settings import validate
from koopdqn.tasks.task import Task

SETTINGS = EvaluationSettings(
    episodes=12,
    seed=2000,
    start_scale=1.0,
    dynamics=False,
    dynamics_episodes=1,
    time_scale=1.0,
    baselines=False,
    video=False,
)


def evaluated(scale: float) -> Evaluation:
    known, settings = taught(), SETTINGS.model_copy(update={"start_scale": scale})
    policy = Greedy(known.model, shelf().task)
    return evaluate(shelf(), policy, reward_of(known), known.trajectories, settings, step_limit=5)


@given(scale=st.floats(0.1, 10))
def test_a_start_lies_that_many_times_farther_from_the_middle_of_the_region(shelf_task: Task, scale: float) -> None:
    middle = shelf_task.nominal_start
    plain, scaled = (
        task.draw_starts(np.random.default_rng(0), 20) - middle
        for task in (shelf_task, shelf_task.with_starts_scaled(scale))
    )
    np.testing.assert_allclose(scaled[:, :3], scale * plain[:, :3], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(scaled[:, 3:], plain[:, 3:])


def test_scaling_changes_nothing_but_the_start_region(shelf_task: Task) -> None:
    changed = shelf_task.with_starts_scaled(3.0)
    assert changed.model_dump(exclude={"start_half_range_m"}) == shelf_task.model_dump(exclude={"start_half_range_m"})
    assert shelf_task.start_half_range_m == load_parts().task.start_half_range_m


def test_wider_starts_are_free_of_collisions_and_lie_outside_the_region() -> None:
    cell, found = shelf(), evaluated(12.0)
    half = np.array(cell.task.start_half_range_m)
    offsets = np.abs([episode.poses[0, :3] - cell.task.nominal_start[:3] for episode in found.episodes])
    assert (offsets <= 12 * half).all()
    assert (offsets > half).any(axis=1).mean() > 0.5
    assert all(cell.scene.contact(episode.joints[0]) == "" for episode in found.episodes)
    assert found.report["redrawn_starts"] > 0
    assert found.report["start_scale"] == 12.0


def test_the_references_begin_where_the_episodes_do() -> None:
    found = evaluated(3.0)
    for episode, reference in zip(found.episodes, found.references, strict=True):
        np.testing.assert_array_equal(episode.poses[0], reference[0])


@pytest.mark.parametrize("scale", [0.0, -1.0, 101.0])
def test_a_scale_that_makes_no_region_is_refused(scale: float) -> None:
    with pytest.raises(BadInputError, match=rf"eval\.start_scale.*{scale}"):
        validate({**SETTINGS.model_dump(), "start_scale": scale}, EvaluationSettings, "eval")
