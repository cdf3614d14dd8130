"""Paths that pass themselves: unfolded, every passage is a place of its own, and nothing else changes."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers_shelf import PARTS
from helpers_shown import arc, derivation, recorded, shown
from helpers_unfolding import (
    all_the_way,
    eight,
    eights,
    one_by_one,
    person_of,
    strokes,
    task,
    unfolded,
    unfolding,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import load_parts
from scipy.spatial import KDTree

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import Greedy
from koopdqn.intent.detour import detour
from koopdqn.intent.fit import agent_steps, fit
from koopdqn.intent.model import IntentModel
from koopdqn.paths import arc_lengths, hausdorff
from koopdqn.pose import Array
from koopdqn.rl.starts import StartSampler
from koopdqn.tasks.obstacles import Obstacle
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import demonstrator_next_poses
from koopdqn.tasks.unfolding import Unfolding
from koopdqn.tasks.workcell import open_workcell


def unfolding_of_task() -> Unfolding:
    found = task().person_frame.unfolding
    assert found is not None
    return found


@cache
def intent() -> IntentModel:
    demonstrations = derivation(holdout=0).derive(shown(*map(recorded, eights()))).training
    return fit(demonstrations, task(), PARTS.intent, PARTS.trust, PARTS.reward).model


def test_a_path_that_passes_itself_is_cut_once_between_each_two_passages() -> None:
    found = unfolding()
    assert len(found.cuts) == 1
    crossing = np.array([0.45, *(eight()[:, 1:3].mean(axis=0))])
    assert pose.norm(found.path[found.cuts[0], :3] - crossing) > 0.05


@pytest.mark.parametrize(
    "trajectories", [[arc(0.01), arc(-0.01)], [strokes(0.0, 0.2, 0.195)], [arc()]], ids=["an arc", "a hook", "one"]
)
def test_a_path_that_does_not_pass_itself_is_left_as_it_is(trajectories: list[Array]) -> None:
    assert unfolded(trajectories) is None


def test_demonstrations_that_do_not_tell_their_passages_are_left_as_they_are() -> None:
    half = eight()[:150]
    assert unfolded([eight(), eight(), half]) is None


def test_unfolded_the_path_does_not_pass_itself() -> None:
    flat, lifted = eights()[0], unfolding().to_frame(eights()[0], unfolding().begun(eights()[0]))
    arcs = arc_lengths(flat[:, :3])
    far = np.abs(arcs[:, None] - arcs) > 0.05

    def nearest(poses: Array) -> float:
        apart = np.linalg.norm(poses[:, None, :3] - poses[None, :, :3], axis=2)
        return float(apart[far].min())

    assert nearest(flat) < 0.002
    assert nearest(lifted) > 0.03


def test_the_goal_and_orientations_stay() -> None:
    rows = eights()[0]
    lifted = unfolding().to_frame(rows, unfolding().begun(rows))
    assert np.allclose(lifted[-1], rows[-1], atol=1e-9)
    assert (lifted[:, 3:] == rows[:, 3:]).all()


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 399), st.floats(-0.008, 0.008), st.floats(-0.008, 0.008), st.floats(-0.008, 0.008))
def test_folding_back_is_the_inverse_beside_the_path_too(row: int, x: float, y: float, z: float) -> None:
    path = eight()
    starts = unfolding().begun(path)
    beside = path.copy()
    beside[:, :3] += [x, y, z]
    back = unfolding().from_frame(unfolding().to_frame(beside, starts))
    assert np.allclose(back[row], beside[row], atol=1e-6)


def test_legs_go_on_one_step_at_a_time_as_along_a_whole_path() -> None:
    for rows in eights():
        told = one_by_one(unfolding(), rows)
        assert (told == unfolding().begun(rows)).all()
        assert len(np.unique(told, axis=0)) == 2


@pytest.mark.parametrize("intent_of", ["pose", "fourier"])
def test_exploring_along_a_later_leg_counts_as_begun_on_it(intent_of: str) -> None:
    parts = load_parts(f"intent={intent_of}")
    made = derivation(holdout=0).derive(shown(*map(recorded, eights())))
    fitted = fit(made.training, made.task, parts.intent, parts.trust, parts.reward)
    shown_paths = agent_steps(made.training, made.task)
    agent = PARTS.agent.model_copy(update={"exploring_starts": 1.0, "exploring_in_region": 0.0})
    cell, model = open_workcell(made.task, PARTS.arm), fitted.model
    sampler = StartSampler(cell, model.start_frame, model.placed(shown_paths), 800, agent)
    rng = np.random.default_rng(4)
    legs = made.task.legs(made.task.nominal_start)
    told = 0
    for each in (sampler.draw(rng) for _ in range(60)):
        places = np.concatenate([rows[:, :3] for rows in shown_paths])
        begun = np.concatenate([made.task.begun(rows) for rows in shown_paths])
        near = begun[np.linalg.norm(places - each.pose[:3], axis=1) < 0.03]
        later = (near[:, None] == legs[1:]).all(axis=2).any(axis=1)
        if later.all() or not later.any():
            told += 1
            assert (each.start == legs[1]).all() == later.all()
    assert told > 20


def test_shapes_of_several_actions_a_pose_are_kept() -> None:
    rows = eights()[0][:30].reshape(6, 5, 7)
    lifted = unfolding().to_frame(rows, np.repeat(rows[:1, :1], 6, axis=0))
    assert lifted.shape == (6, 5, 7)
    assert np.allclose(unfolding().from_frame(lifted), rows, atol=1e-6)


def test_a_frame_keeps_its_unfolding() -> None:
    frame = StartFrame(eight()[0, :3], eight()[-1, :3], follows=False, unfolding=unfolding())
    for held in (frame.arrays(), {**frame.described(), **frame.learned()}):
        again = StartFrame.restore(held)
        assert again.unfolding is not None
        for name, values in unfolding().arrays().items():
            assert (again.unfolding.arrays()[name] == values).all()


def test_an_unfolding_of_before_paths_could_turn_back_is_read() -> None:
    held = {name: values for name, values in unfolding().arrays().items() if name != "unfolding_back"}
    found = Unfolding.restore(held)
    assert found is not None
    assert not found.back.any()


def test_its_arrays_are_those_documented() -> None:
    documented = (Path(__file__).parent.parent / "docs" / "files.md").read_text(encoding="utf-8")
    assert all(f"| `frame_{name}` |" in documented for name in unfolding().arrays())


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("path", np.zeros((2, 7))),
        ("path", np.full((360, 7), np.nan)),
        ("lifts", np.zeros(3)),
        ("axis", np.zeros(2)),
        ("cuts", np.array([10**6])),
        ("cuts", np.array([], dtype=int)),
        ("cuts", np.array([50, 40])),
        ("cuts", np.array([50, 51])),
        ("back", np.array([True, False])),
        ("overlap", np.array(0)),
    ],
)
def test_a_damaged_unfolding_is_refused(name: str, values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="the unfolding must"):
        Unfolding.restore({**unfolding().arrays(), f"unfolding_{name}": values})


def test_a_task_made_from_demonstrations_says_that_its_path_passes_itself() -> None:
    made = derivation(holdout=0).derive(shown(*map(recorded, eights())))
    assert made.task.passes_itself
    assert any("it has 2 legs" in note for note in made.notes)
    plain = derivation(holdout=0).derive(shown(recorded(arc(0.01)), recorded(arc(-0.01))))
    assert not plain.task.passes_itself
    assert not any("passes itself" in note for note in plain.notes)


def test_the_demonstrator_goes_all_the_way() -> None:
    all_the_way(person_of(task()), task())


def test_the_intent_goes_all_the_way_and_its_own_path_too() -> None:
    model = intent()
    all_the_way(Greedy(model, task()), task())
    path = model.intended_paths(task().nominal_start[None], 800, task().step_m)[:, 0]
    assert hausdorff(path[:, :3], task().trajectories[0][:, :3]) < 0.02


def test_the_same_place_is_predicted_by_the_leg() -> None:
    place = eight().copy()[:, :3]
    arcs = arc_lengths(place)
    apart = np.linalg.norm(place[:, None] - place, axis=2) + 10.0 * (np.abs(arcs[:, None] - arcs) < 0.05)
    first, last = np.sort(np.unravel_index(apart.argmin(), apart.shape))
    pose_there = eight()[first][None]
    cut = unfolding_of_task().path[unfolding_of_task().cuts]
    ways = [intent().intended(pose_there, start)[0, :3] - pose_there[0, :3] for start in (eight()[:1], cut)]
    shown_ways = [place[row + 3] - place[row] for row in (first, last)]
    for way, shown_way in zip(ways, shown_ways, strict=True):
        assert way @ shown_way > 0.9 * pose.norm(way) * pose.norm(shown_way)


def test_legs_are_those_of_the_task_whatever_the_intent() -> None:
    rows = task().trajectories[1]
    assert (task().begun(rows) == unfolding_of_task().begun(rows)).all()
    assert (task().onward(rows[-1:], rows[:1]) == unfolding_of_task().onward(rows[-1:], rows[:1])).all()
    assert len(task().legs(rows[0])) == 2
    plain = derivation(holdout=0).derive(shown(recorded(arc(0.01)), recorded(arc(-0.01)))).task
    assert (plain.begun(arc()) == arc()[0]).all()
    assert (plain.legs(arc()[0]) == arc()[:1]).all()
    # Whoever shows it takes the way of the leg, at every pose of a demonstration.
    wished = demonstrator_next_poses(task(), rows[:-8], task().begun(rows)[:-8])
    ways, shown_ways = wished[:, :3] - rows[:-8, :3], rows[3:-5, :3] - rows[:-8, :3]
    cosine = (ways * shown_ways).sum(axis=1) / pose.norm(ways) / pose.norm(shown_ways)
    assert np.mean(cosine > 0.7) > 0.95


def test_obstacles_are_refused_on_a_path_that_passes_itself() -> None:
    held = {"name": "thing", "shape": "sphere", "center_m": (0.45, 0.0, 0.6), "radius_m": 0.02}
    obstacles = (Obstacle.model_validate(held),)
    among = task().model_copy(update={"obstacles": obstacles})
    with pytest.raises(BadInputError, match="must not pass itself, found one that does"):
        detour(open_workcell(among, PARTS.arm), intent(), np.array([task().nominal_start]))
    # Before anything is fitted.
    with pytest.raises(BadInputError, match="must not pass itself, found one that does"):
        derivation(holdout=0, obstacles=obstacles).derive(shown(*map(recorded, eights())))


def test_inspect_says_how_many_legs_a_path_has_that_passes_itself(
    tmp_path: Path,
) -> None:
    write_hdf5(tmp_path / "eights.hdf5", shown(*map(recorded, eights())))
    assert cli.main(["inspect", f"demos={tmp_path / 'eights.hdf5'}", f"out={tmp_path / 'seen'}"]) == 0
    found = json.loads((tmp_path / "seen/inspect.json").read_text())["findings"]
    (line,) = (each for each in found if each["name"] == "one task")
    assert line["state"] == "good"
    assert "its path passes itself and has 2 legs" in line["text"]


@pytest.mark.slow
def test_a_path_that_passes_itself_is_learned_measured_and_not_corrected(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demos, run, measured = tmp_path / "demos.hdf5", tmp_path / "run", tmp_path / "eval"
    write_hdf5(demos, shown(*(recorded(eight(0.004, phase)) for phase in range(6))))
    given = [f"demos={demos}", "task=demonstrated", f"out={run}", "seed=3"]
    assert cli.main(["train", *given]) == 0
    assert cli.main(["eval", f"run={run}", f"out={measured}"]) == 0
    report = json.loads((measured / "eval.json").read_text())
    assert report["success_rate"] >= 0.95
    assert report["holdout"]["hausdorff_mm"]["policy"][0] < 20.0
    rows, explained = eight(0.004, 0), tmp_path / "explained"
    # Well before the place where one leg gives way to the other, and well behind it.
    for row, leg in ((100, 1), (300, 2)):
        pose_given = ",".join(f"{value:.6f}" for value in rows[row])
        assert cli.main(["explain", f"run={run}", f"explain.pose=[{pose_given}]", f"out={explained}-{leg}"]) == 0
        told = json.loads(Path(f"{explained}-{leg}/explain.json").read_text())
        assert (told["leg"], told["legs"]) == (leg, 2)
        best = max(told["actions"], key=lambda action: action["reward"])
        assert (np.array(best["reached"][:3]) - rows[row, :3]) @ (rows[row + 6, :3] - rows[row, :3]) > 0.0
    capsys.readouterr()
    assert cli.main(["correct", f"run={run}", "waypoints=[[0.45,0.0,0.4]]", f"out={tmp_path / 'corrected'}"]) == 2
    assert "must not pass itself" in capsys.readouterr().err


@pytest.mark.parametrize("trust", ["tube", "paper"])
def test_pictures_show_the_trust_domain_where_the_path_lies(trust: str) -> None:
    demonstrations = derivation(holdout=0).derive(shown(*map(recorded, eights()))).training
    fitted = fit(demonstrations, task(), PARTS.intent, load_parts(f"trust={trust}").trust, PARTS.reward)
    frame = fitted.model.start_frame
    drawn = fitted.trust.drawn(frame).arrays()["middle" if trust == "tube" else "mean"][:, :3]
    path = np.concatenate(task().trajectories)[:, :3]
    assert KDTree(path).query(drawn)[0].max() < 0.01
    assert KDTree(path).query(fitted.trust.arrays()["middle" if trust == "tube" else "mean"][:, :3])[0].max() > 0.05
    with_ball = fitted.trust.extended(frame.each(task().trajectories)[0][100:101], np.array([0.02]))
    assert np.allclose(with_ball.drawn(frame).balls.poses[0], task().trajectories[0][100], atol=1e-6)
