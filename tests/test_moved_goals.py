"""Moved goals: what was demonstrated moves with them, and the arm goes to where they are in the world."""

from functools import cache
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from helpers_shown import arc, derivation, recorded, shown
from parts import Clerk, load_parts, with_fields

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.demonstrations.derivation import Derived
from koopdqn.envs import batch as environments
from koopdqn.envs.batch import Batch, EnvironmentParts
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import Greedy
from koopdqn.evaluation.evaluate import drawn_starts, evaluate
from koopdqn.evaluation.schema import EvaluationSettings
from koopdqn.intent.fit import agent_steps, fit
from koopdqn.intent.reward import IntentReward
from koopdqn.safety import Guard
from koopdqn.safety.guard import TUBE
from koopdqn.tasks.moved_goals import FlangeAlone, draw_starts
from koopdqn.tasks.rollout import SUCCESS, Episode
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import Workcell, open_workcell

PARTS = load_parts("intent.count=200")
GUARD = load_config().guard
HALF = (0.08, 0.1, 0.06)
SETTINGS = EvaluationSettings(
    episodes=6,
    seed=2000,
    start_scale=1.0,
    dynamics=False,
    dynamics_episodes=1,
    time_scale=2.0,
    baselines=False,
    video=False,
)


@cache
def _derived(half: tuple[float, float, float] | None = HALF) -> Derived:
    recipe = derivation().model_copy(update={"goal_half_range_m": half})
    return recipe.derive(shown(*(recorded(arc(offset)) for offset in (0.0, 0.01, 0.02))))


@cache
def _cell() -> Workcell:
    return open_workcell(_derived().task, PARTS.arm)


@cache
def _reward() -> IntentReward:
    fitted = fit(_derived().training, _derived().task, PARTS.intent, PARTS.trust, PARTS.reward)
    return IntentReward(_derived().task, fitted.model, fitted.trust, PARTS.reward)


def test_an_environment_knows_the_flange_alone_and_is_measured_with_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = EnvironmentParts(_cell(), _reward(), Clerk(), 800)
    batch = Batch(parts, 16, np.random.default_rng(0))
    assert isinstance(batch._env.workcell.reachability, FlangeAlone)
    given: list[Any] = []

    def rolled(*parts: Any, moved: Any) -> list[Episode]:
        given.extend([parts, moved])
        return [SimpleNamespace(outcome=SUCCESS)] * 20  # type: ignore[list-item]

    monkeypatch.setattr(environments, "roll_out", rolled)
    assert parts.success_rate(lambda seen: np.zeros(len(seen)), 20) == 1.0
    (_, _, reachability, starts, joints, _), moved = given
    assert not isinstance(reachability, FlangeAlone)
    assert np.abs(moved).max() > 0.03
    world = starts.copy()
    world[:, :3] += moved
    np.testing.assert_allclose(_cell().arm.forward(joints)[:, :3], world[:, :3], atol=1e-6)


def _evaluated(**changed: Any) -> Any:
    controller = Greedy(_reward().model, _derived().task)
    trajectories = agent_steps(_derived().training, _derived().task)
    settings = SETTINGS.model_copy(update=changed)
    held_out = [item.poses for item in _derived().held_out]
    return evaluate(_cell(), controller, _reward(), trajectories, settings, 800, held_out=held_out, guard=GUARD)


def test_goals_are_drawn_from_their_region_and_starts_from_theirs() -> None:
    drawn = drawn_starts(_cell(), SETTINGS)
    assert (np.abs(drawn.moved) <= HALF).all()
    assert len(np.unique(drawn.moved, axis=0)) == len(drawn.moved)
    still = open_workcell(_derived(None).task, PARTS.arm)
    own = drawn_starts(still, SETTINGS)
    assert not own.moved.any()
    # In the world the starts are those of a goal that stays.
    assert np.allclose(drawn.starts[:, :3] + drawn.moved, own.starts[:, :3])


def test_a_goal_that_the_arm_cannot_take_is_refused() -> None:
    far = np.array([0.0, 0.0, 2.0])
    with pytest.raises(BadInputError, match=r"goal: must be one that the arm can take, found .*reach"):
        draw_starts(_cell(), _cell().task, np.random.default_rng(0), 3, far)


def test_starts_that_lie_at_their_goal_are_drawn_again_and_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    cell, task = _cell(), _cell().task
    still = task.with_still_goal()
    here = draw_starts(cell, task, np.random.default_rng(0), 1)
    start = here.starts[0, :3] + here.moved[0]
    drawn = draw_starts(cell, task, np.random.default_rng(0), 5, start - task.goal[:3])
    assert drawn.redrawn > 0
    assert (np.linalg.norm(drawn.starts[:, :3] - still.goal[:3], axis=1) > 0.01).all()
    # A start region of one place, and that is the goal's.
    monkeypatch.setattr(type(task), "draw_starts", lambda self, rng, count: np.tile(task.goal, (count, 1)))
    with pytest.raises(
        BadInputError, match="goals must lie where the arm can take them, clear of the start, found none"
    ):
        draw_starts(
            cell, task.model_copy(update={"goal_half_range_m": (1e-3, 1e-3, 1e-3)}), np.random.default_rng(0), 1
        )


def test_pictures_show_the_arm_where_the_flange_is() -> None:
    batch = Batch(EnvironmentParts(_cell(), _reward(), Clerk(), 800), 4, np.random.default_rng(0))
    reached = ~np.isclose(batch.joints, batch._env.episodes.joints).all(axis=1)
    assert reached.any()
    np.testing.assert_allclose(_cell().arm.forward(batch.joints)[reached], batch.poses[reached], atol=1e-6)


def test_training_starts_are_as_far_from_the_goal_as_any_goal_may_be_from_its_place() -> None:
    task = _derived().task
    starts = task.draw_starts(np.random.default_rng(0), 400)[:, :3]
    known = task.with_still_goal().draw_starts(np.random.default_rng(0), 400)[:, :3]
    grown = np.ptp(starts, axis=0) - np.ptp(known, axis=0)
    assert (grown > 1.6 * np.array(HALF)).all()
    assert (grown < 2.4 * np.array(HALF)).all()


def test_a_goal_that_stays_draws_the_starts_it_always_drew() -> None:
    one = _derived(None).task.draw_starts(np.random.default_rng(3), 20)
    assert np.array_equal(one, _derived().task.with_still_goal().draw_starts(np.random.default_rng(3), 20))


def test_the_arm_reaches_a_goal_that_is_given_in_the_world() -> None:
    goal = _derived().task.goal[:3] + np.array([0.05, -0.08, 0.04])
    found = _evaluated(goal=tuple(goal.tolist()))
    assert [episode.outcome for episode in found.episodes] == [SUCCESS] * 6
    for episode in found.episodes:
        flange = _cell().reachability.flange_poses(episode.joints[[0, -1]])
        assert np.linalg.norm(flange[1, :3] - goal) <= _derived().task.goal_tolerance_m + 1e-6
        assert np.allclose(episode.positions[[0, -1]], flange[:, :3], atol=1e-6)
    # The held-out demonstration is moved with the goal.
    assert found.report["holdout"]["policy"]["success_rate"] == 1.0


def test_the_guard_and_its_tube_go_with_the_goal() -> None:
    goal = tuple((_derived().task.goal[:3] + np.array([0.05, -0.08, 0.04])).tolist())
    found = _evaluated(goal=goal, dynamics=True)
    assert found.report["dynamics"]["guard"]["stopped"] == 0
    episode = found.episodes[0]
    keeper = Guard(_cell(), GUARD, _reward().trust, _reward().model.start_frame)
    assert keeper.review(episode.in_world, episode.joints, episode.moved) is None
    refused = keeper.review(episode.in_world, episode.joints)
    assert refused is not None
    assert refused.cause == TUBE


def test_goals_drawn_anew_are_reached() -> None:
    assert _evaluated().report["success_rate"] == 1.0


def test_a_goal_out_of_its_region_or_of_a_task_without_one_is_refused() -> None:
    task = _derived().task
    with pytest.raises(BadInputError, match=r"goal: must be at most \[0.08, 0.1, 0.06\] m"):
        task.goal_displacement(tuple((task.goal[:3] + np.array([0.09, 0.0, 0.0])).tolist()))
    # A goal is told rounded, and may be given as it was told.
    edge = np.round(task.goal[:3] + HALF, 4)
    np.testing.assert_allclose(task.goal_displacement(tuple(edge.tolist())), HALF, atol=1e-4)
    with pytest.raises(BadInputError, match=r"with goal_half_range_m, .* a task of your own whose goal_moves is True"):
        PARTS.task.goal_displacement((0.5, 0.1, 0.5))


def test_a_task_whose_furniture_stands_still_has_no_moving_goal() -> None:
    with pytest.raises(BadInputError, match="goal_half_range_m must be null for task shelf"):
        with_fields(PARTS.task, goal_half_range_m=[0.1, 0.1, 0.1])


@pytest.mark.parametrize("half", [(0.0, 0.0, 0.0), (-0.1, 0.1, 0.1)])
def test_a_goal_range_must_be_one(half: tuple[float, float, float]) -> None:
    with pytest.raises(BadInputError, match="must not be negative, and above 0"):
        _derived(half)


def test_the_goal_moves_positions_alone() -> None:
    drawn = drawn_starts(_cell(), SETTINGS)
    assert np.allclose(pose.rotation_distance(drawn.starts, _derived().task.nominal_start), 0.0, atol=1e-6)


class _Movable(ShelfTask):
    goal_moves: ClassVar[bool] = True


def test_a_task_of_ones_own_draws_starts_as_they_lie_from_its_moved_goals() -> None:
    task = _Movable.model_construct(**{**dict(PARTS.task), "goal_half_range_m": (0.1, 0.0, 0.1)})
    seen, shown_from = (
        draw(np.random.default_rng(0), 2000)[:, :3] - task.nominal_start[:3]
        for draw in (task.draw_starts, task.draw_demonstrated_starts)
    )
    half = np.array(task.start_half_range_m)
    np.testing.assert_allclose(np.abs(shown_from).max(axis=0), half, rtol=0.02)
    assert (np.abs(seen).max(axis=0)[[0, 2]] > half[[0, 2]] + 0.08).all()
    assert np.abs(seen[:, 1]).max() <= half[1]
