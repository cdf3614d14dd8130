"""Paths that turn back, close or come through their goal: every passage is a leg, and the last one ends at the goal."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_shelf import PARTS
from helpers_shown import derivation, recorded, shown
from helpers_unfolding import (
    BY_GOAL,
    STEP,
    all_the_way,
    circle,
    one_by_one,
    person_of,
    shaped,
    shapes,
    strokes,
    unfolded,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import load_parts
from scipy.spatial import KDTree

from koopdqn import pose
from koopdqn.artifact import described
from koopdqn.evaluation.baselines import Greedy
from koopdqn.intent.fit import fit
from koopdqn.paths import hausdorff, to_step
from koopdqn.pose import Array
from koopdqn.settings import load_settings
from koopdqn.tasks.demonstrated import DemonstratedTask
from koopdqn.tasks.task import Task
from koopdqn.tasks.unfolding import Unfolding


@pytest.mark.parametrize(("name", "cuts"), [("there and back", [0.2]), ("there and back twice", [0.2, 0.0, 0.2])])
def test_a_path_that_turns_back_is_cut_where_it_does(name: str, cuts: list[float]) -> None:
    found = unfolded(shapes()[name])
    assert found is not None
    assert found.back.all()
    turns = [[rows[99 * (leg + 1), 1] for leg in range(len(cuts))] for rows in shapes()[name]]
    tips = np.mean(turns, axis=0)
    assert np.abs(found.path[found.cuts, 1] - tips).max() < 0.002
    # Floors lie apart, and between them the path goes on beyond its turn.
    for rows in to_step(shapes()[name], STEP, 0.1):
        begun = found.begun(rows, hindsight=True)
        legs = np.concatenate([[0], np.cumsum((begun[1:] != begun[:-1]).any(axis=1))])
        assert legs[-1] == len(cuts)
        for leg, cut in enumerate(cuts):
            around = rows[np.isin(legs, (leg, leg + 1)), 1]
            assert rows[legs == leg + 1, 1][0] == (around.max() if cut > 0.0 else around.min())
        whole = found.whole(rows)
        assert pose.position_distance(whole[1:], whole[:-1]).max() < 2.0 * STEP
        assert whole[:, 1].max() > rows[:, 1].max() + 0.005
        floors = found.to_frame(rows, begun)
        for leg in range(len(cuts)):
            assert KDTree(floors[legs == leg, :3]).query(floors[legs == leg + 1, :3])[0].min() > 0.015


def test_a_leg_ends_where_the_path_turns_back_and_not_before() -> None:
    found = unfolded(shapes()["there and back"])
    assert found is not None
    rows = to_step([strokes(0.0, 0.21, 0.06)], STEP, 0.1)[0]
    tip = found.path[found.cuts[0], 1]
    told = one_by_one(found, rows)
    assert (told == found.begun(rows)).all()
    before = (told == rows[0]).all(axis=1)
    assert rows[before, 1].max() < tip < rows[before, 1].max() + 2.0 * STEP
    # Of a whole path that turns back too early it is known afterwards where that was; under way it is not.
    for turn in (0.201, 0.21):
        whole = to_step([strokes(0.0, turn, 0.06)], STEP, 0.1)[0]
        assert (one_by_one(found, whole) == whole[0]).all() == (turn < tip)
        begun = found.begun(whole, hindsight=True)
        assert int((begun == whole[0]).all(axis=1).sum()) == int(whole[:, 1].argmax())


@settings(deadline=None, max_examples=30)
@given(
    st.lists(st.floats(0.01, 0.12), min_size=2, max_size=9),
    st.integers(1, 3),
    st.sampled_from([0.001, 0.0021]),
    st.floats(0.0, 0.006),
)
def test_whatever_the_strokes_legs_are_told_alike_and_lead_to_the_goal(
    lengths: list[float], count: int, step: float, wave: float
) -> None:
    corners = np.cumsum([0.0, *(length * (-1) ** k for k, length in enumerate(lengths))])
    paths = to_step([strokes(*corners, phase=k, wave=wave) for k in range(count)], step, 0.1)
    found = Unfolding.of(paths, step, BY_GOAL)
    if found is None:
        return
    assert found.lifts[-1] == 0.0
    for rows in paths:
        assert found.on_last_leg(found.begun(rows, hindsight=True)[-1:])[0]
        assert (one_by_one(found, rows) == found.begun(rows)).all()
        whole = found.whole(rows)
        wide = 0.002 * found.overlap
        assert pose.position_distance(whole[1:], whole[:-1]).max() < 2.0 * wide
        # What leads from floor to floor is no part of where the path lies.
        laid = found.laid(whole)
        assert KDTree(rows[:, :3]).query(laid[:, :3])[0].max() < 2.0 * wide
        assert KDTree(laid[:, :3]).query(rows[:, :3])[0].max() < 2.0 * wide


def hooked(radius: float, rounds: float) -> Array:
    """Return poses (N, 7) along a stroke that ends in rounds of a circle [m]."""
    angle = np.linspace(0.0, 2.0 * np.pi * rounds, 200)
    rows = strokes(-0.2, 0.0)
    circle_there = np.repeat(rows[-1:], 200, axis=0)
    circle_there[:, 1:3] += radius * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)
    return np.concatenate([rows, circle_there])


def test_a_tip_circled_by_less_than_can_be_told_is_no_passage() -> None:
    assert unfolded([hooked(0.0035, 2.0)]) is None


def test_samples_that_turn_on_the_spot_do_not_make_floors_endless() -> None:
    rows = strokes(0.0, 0.15, 0.05)
    turn = pose.from_rotation_vector(np.linspace(0.0, 1.5, 300)[:, None] * [1.0, 0.0, 0.0])
    spot = pose.make(np.repeat(rows[:1, :3], 300, axis=0), pose.multiply(rows[:1, 3:], turn[::-1]))
    found = unfolded([np.concatenate([spot, rows])])
    assert found is not None
    (path,) = to_step([np.concatenate([spot, rows])], STEP, 0.005)
    assert len(found.whole(path)) < len(path) + 60


def test_a_hook_at_the_end_that_touches_nothing_is_no_passage() -> None:
    assert unfolded([hooked(0.012, 0.75)]) is None


def test_an_intent_that_does_not_unfold_is_asked_for_a_task_that_does_not() -> None:
    demonstrations = shown(*map(recorded, shapes()["there and back"]))
    assert derivation(holdout=0).derive(demonstrations, unfolds=load_parts("intent=pose").intent.unfolds).task.unfolds
    plain = derivation(holdout=0).derive(demonstrations, unfolds=load_parts("intent=fourier").intent.unfolds).task
    assert not plain.unfolds
    assert plain.arrived(plain.goal[None], plain.nominal_start[None])[0]


def test_the_unfolding_that_a_run_holds_counts() -> None:
    made = shaped("there and back")
    own = made.person_frame.unfolding
    assert own is not None
    other = replace(own, cuts=own.cuts - 1)
    fresh = load_settings(described(made), Task, "task")
    assert isinstance(fresh, DemonstratedTask)
    assert fresh.showing(list(made.trajectories), other).person_frame.unfolding is other
    assert (made.legs(made.nominal_start)[1] == own.starts[0]).all()


def test_the_model_of_a_path_through_its_goal_converges() -> None:
    made = derivation(holdout=0).derive(shown(*map(recorded, shapes()["through the goal"])))
    report = fit(made.training, made.task, PARTS.intent, PARTS.trust, PARTS.reward).report
    assert report["converging_share"] == 1.0
    assert report["length_ratio"] == pytest.approx(1.0, abs=0.1)


def test_legs_of_one_place_begin_a_hair_apart() -> None:
    rows = strokes(0.0, 0.2, 0.0, 0.2, 0.1)
    found = unfolded([rows])
    assert found is not None
    assert len(found.cuts) == 3
    assert found.on_last_leg(found.starts).tolist() == [False, False, True]
    assert not found.on_last_leg(rows[:1])[0]


@pytest.mark.parametrize("name", ["closed", "through the goal"])
def test_the_goal_is_passed_on_the_way_and_ends_the_last_leg_alone(name: str) -> None:
    assert shaped(name).passes_itself
    rows = shaped(name).trajectories[0]
    begun = shaped(name).begun(rows)
    there, ended = shaped(name).reached(rows), shaped(name).arrived(rows, begun)
    assert there[: len(rows) // 2].any()
    assert not ended[: len(rows) // 2].any()
    assert ended[-1]
    several = shaped(name).arrived(np.repeat(rows[:, None], 3, axis=1), begun)
    assert (several == ended[:, None]).all()
    assert (shaped(name).arrived(rows, None) == there).all()


def test_a_path_that_ends_exactly_where_it_begins_is_taken() -> None:
    closed = derivation(holdout=0).derive(shown(recorded(circle(0.0)))).task
    assert pose.position_distance(closed.nominal_start, closed.goal) < 1e-9
    assert closed.passes_itself
    drawn = closed.draw_starts(np.random.default_rng(0), 20)
    assert not closed.arrived(drawn, drawn).any()


@pytest.mark.parametrize("name", list(shapes()))
def test_the_demonstrator_and_the_intent_go_all_the_way_of_a_shape(name: str) -> None:
    made = derivation(holdout=0).derive(shown(*map(recorded, shapes()[name])))
    model = fit(made.training, made.task, PARTS.intent, PARTS.trust, PARTS.reward).model
    for controller in (Greedy(model, made.task), person_of(made.task)):
        all_the_way(controller, made.task)
    path = model.intended_paths(made.task.nominal_start[None], 800, made.task.step_m)[:, 0]
    assert hausdorff(path[:, :3], made.task.trajectories[0][:, :3]) < 0.02
