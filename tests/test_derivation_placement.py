"""Demonstrations moved to where the arm can follow them, and back."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from helpers_shown import arc, derivation, recorded
from hypothesis import given
from hypothesis import strategies as st
from parts import load_parts

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations, Placement, blocked_at, find_placement
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.demonstrations.reading import read_demonstrations
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.recording import NOTHING
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.tasks.obstacles import Obstacle
from koopdqn.tasks.workcell import Reachability, build_scene, open_workcell

PLACEMENTS = st.builds(
    lambda x, y, z, turn: Placement(np.array([x, y, z]), turn),
    *[st.floats(-1, 1)] * 3,
    st.floats(-np.pi, np.pi),
)


@cache
def arm() -> Reachability:
    parts = load_parts()
    return Reachability(parts.arm, build_scene(parts.task, parts.arm))


def shown() -> Demonstrations:
    return Demonstrations("demonstrated", "ur5", [recorded(arc(0.01 * index)) for index in range(2)])


@given(placement=PLACEMENTS)
def test_what_is_moved_and_moved_back_is_where_it_was(placement: Placement) -> None:
    moved = placement.moved(shown())
    assert moved.placement is placement
    back = placement.undone(moved)
    assert back.placement is None
    for item, original in zip(back.items, shown().items, strict=True):
        np.testing.assert_allclose(item.poses, original.poses, atol=1e-12)


@given(placement=PLACEMENTS)
def test_a_placement_is_rigid_and_keeps_the_vertical(placement: Placement) -> None:
    poses = shown().items[0].poses
    moved = placement.poses(poses)
    np.testing.assert_allclose(
        pose.position_distance(moved[1:], moved[:-1]), pose.position_distance(poses[1:], poses[:-1]), atol=1e-12
    )
    np.testing.assert_allclose(moved[:, 2] - poses[:, 2], placement.offset[2], atol=1e-12)
    # An axis of the flange keeps its angle to the vertical.
    up, was = (pose.rotate(rows[:, 3:], np.tile([0.0, 0.0, 1.0], (len(rows), 1)))[:, 2] for rows in (moved, poses))
    np.testing.assert_allclose(up, was, atol=1e-12)


def far_away() -> list[Array]:
    # The arm reaches 0.95 m; half of this lies beyond.
    return [Placement(np.array([0.25, 0.0, 0.25]), 0.0).poses(item.poses) for item in shown().items]


def test_what_cannot_be_followed_is_named_and_a_placement_found() -> None:
    rows = far_away()
    why = [blocked_at(arm(), path) for path in rows]
    assert any("unreachable" in each and "of its way, at [" in each for each in why)
    placement = find_placement(arm(), rows)
    assert all(blocked_at(arm(), placement.poses(path)) == "" for path in rows)


def test_what_a_camera_saw_far_off_is_placed_where_the_flange_rests() -> None:
    rows = [Placement(np.array([0.0, -1.0, -2.0]), 0.0).poses(item.poses) for item in shown().items]
    placement = find_placement(arm(), rows)
    assert all(blocked_at(arm(), placement.poses(path)) == "" for path in rows)


def test_what_the_arm_can_follow_is_left_where_it_is() -> None:
    # A turn on the spot: fast joints, but none too fast for a step.
    line = arc()
    spot = np.repeat(line[-1:], 27, axis=0)
    turn = pose.from_rotation_vector(np.linspace(0.0, 2.1, 27)[:, None] * [1.0, 0.0, 0.0])
    spot[:, pose.QUATERNION] = pose.multiply(spot[:, pose.QUATERNION], turn)
    rows = [np.concatenate([line, spot[1:]])] * 2
    assert [blocked_at(arm(), path) for path in rows] == ["", ""]
    assert any(blocked_at(arm(), path[::6]) for path in rows)
    assert str(find_placement(arm(), rows)) == str(Placement(np.zeros(3), 0.0))


def test_where_nothing_will_do_that_is_said() -> None:
    line = np.tile(arc()[0], (200, 1))
    line[:, 0] = np.linspace(-3.0, 3.0, 200)
    with pytest.raises(BadInputError, match=r"demos\.place=auto: must find a place .* found none among 1344"):
        find_placement(arm(), [line])


def test_files_keep_how_they_were_moved(tmp_path: Path) -> None:
    placement = Placement(np.array([0.1, -0.2, 0.3]), 0.5)
    write_hdf5(tmp_path / "moved.hdf5", placement.moved(shown()))
    found = read_hdf5(tmp_path / "moved.hdf5").placement
    assert found is not None
    np.testing.assert_array_equal([*found.offset, found.turn], [0.1, -0.2, 0.3, 0.5])
    write_hdf5(tmp_path / "as_recorded.hdf5", shown())
    assert read_hdf5(tmp_path / "as_recorded.hdf5").placement is None
    both = [str(tmp_path / name) for name in ("moved.hdf5", "as_recorded.hdf5")]
    with pytest.raises(BadInputError, match="moved alike"):
        read_demonstrations(both, "demonstrated", "ur5")


def test_export_undoes_a_placement(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_hdf5(tmp_path / "moved.hdf5", Placement(np.array([0.1, -0.2, 0.3]), 0.5).moved(shown()))
    assert cli.main(["export", "demos=moved.hdf5", "out=back"]) == 0
    for item, original in zip(load(tmp_path / "back" / "demos.csv", NOTHING, None).items, shown().items, strict=True):
        np.testing.assert_allclose(item.poses[:, :3], original.poses[:, :3], atol=1e-9)


def test_a_run_is_told_to_place_and_keeps_the_placement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    placed = Placement(np.array([0.25, 0.0, 0.25]), 0.0).moved(shown())
    write_csv(tmp_path / "far.csv", list(placed.items))
    short = ("task=demonstrated", "demos=far.csv", "intent.count=40", "intent.copies=2")
    assert cli.main(["fit", *short, "out=refused"]) == 2
    assert "demos.place=auto" in capsys.readouterr().err
    assert cli.main(["fit", *short, "demos.place=auto", "out=placed"]) == 0
    assert "about the base's vertical" in capsys.readouterr().err
    assert read_hdf5(tmp_path / "placed" / "demos.hdf5").placement is not None


def test_what_is_learned_from_still_says_how_it_was_moved() -> None:
    placement = Placement(np.array([0.02, -0.01, 0.03]), 0.2)
    assert derivation().derive(placement.moved(shown())).training.placement is placement


def test_the_arm_begins_in_a_posture_in_which_it_can_follow() -> None:
    ends = np.linspace([0.4, 0.4, 0.2], [0.5, -0.6, 0.3], 300)
    down = pose.make(ends, np.tile([0.0, 1.0, 0.0, 0.0], (300, 1)))
    ur5 = load_parts().arm
    task = derivation(place=None).derive(Demonstrations("demonstrated", "ur5", [recorded(down)] * 2)).task
    cell = open_workcell(task, ur5)
    for way in task.trajectories:
        assert blocked_at(arm(), way)
        assert not blocked_at(cell.reachability, way)
    # What stands there now says nothing about how people went.
    post = Obstacle(name="post", shape="box", center_m=(0.45, -0.1, 0.25), size_m=(0.02, 0.02, 0.02))
    beside = open_workcell(task.model_copy(update={"obstacles": (post,)}), ur5).reachability
    np.testing.assert_array_equal(beside.posture, cell.reachability.posture)
