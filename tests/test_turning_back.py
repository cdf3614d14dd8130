"""Paths that turn back, close or come through their goal: every passage is a leg, and the last one ends at the goal."""

import numpy as np
import pytest
from helpers_shelf import PARTS
from helpers_shown import derivation, recorded, shown
from helpers_unfolding import STEP, all_the_way, circle, one_by_one, person_of, shaped, shapes, strokes, unfolded
from scipy.spatial import KDTree

from koopdqn import pose
from koopdqn.evaluation.baselines import Greedy
from koopdqn.intent.fit import fit
from koopdqn.paths import hausdorff, to_step


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
