"""Joints in recordings, alone and beside poses, and names with numbers in them."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from parts import load_parts
from recording_files import HZ, POSES, ROWS, TIMES, declared, joints_along, motion, numbered, poses_in, same, written

from koopdqn import pose
from koopdqn.demonstrations.recordings.load import load
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm

BASE = [0.5, 0.2, 0.8, 0.0, 0.0, 1.0]


@pytest.fixture(scope="module")
def arm() -> Arm:
    return load_parts().arm


@pytest.fixture(scope="module")
def joints(arm: Arm) -> Array:
    return joints_along(arm)


def in_world(poses: Array) -> Array:
    """Return poses told in the frame in which the arm's base stands at BASE."""
    base = pose.make(BASE[:3], pose.from_rotation_vector(np.array(BASE[3:])))
    return pose.compose(np.broadcast_to(base, poses.shape), poses)


def at_tip(poses: Array) -> Array:
    return pose.compose(poses, np.broadcast_to(pose.make([0, 0, 0.15], [1, 0, 0, 0]), poses.shape))


def test_joints_are_told_in_the_arms_base_whatever_is_declared(tmp_path: Path, arm: Arm, joints: Array) -> None:
    written(tmp_path / "log.csv", f"timestamp {numbered('actual_q', 6)}", TIMES, joints)
    loaded = load(tmp_path / "log.csv", declared({"base": BASE, "tool": [0, 0, 0.1, 0, 0, 0]}), arm)
    same(loaded.items[0].poses, POSES)
    assert any("import.base and import.tool without effect" in reason for reason in loaded.reasons)


@pytest.mark.parametrize(
    ("first", "second"), [("q_d", "q"), ("q_des", "q_meas"), ("q_cmd", "q"), ("joint_des", "joint_pos")]
)
def test_of_two_sets_of_joints_the_measured_one_is_read(
    tmp_path: Path, arm: Arm, joints: Array, first: str, second: str
) -> None:
    names = f"timestamp {numbered(first, 6)} {numbered(second, 6)}"
    written(tmp_path / "log.csv", names, TIMES, joints + 0.1, joints)
    same(load(tmp_path / "log.csv", declared({}), arm).items[0].poses, POSES)


def test_of_sets_of_joints_that_names_do_not_tell_apart_one_is_named(tmp_path: Path, arm: Arm, joints: Array) -> None:
    names = f"timestamp {numbered('leader_q', 6)} {numbered('follower_q', 6)}"
    written(tmp_path / "log.csv", names, TIMES, joints + 0.1, joints)
    with pytest.raises(
        BadInputError, match=r"one of the 2 sets of joints .*, found nothing; valid: leader q, follower q"
    ):
        load(tmp_path / "log.csv", declared({}), arm)
    same(load(tmp_path / "log.csv", declared({"pose": "follower"}), arm).items[0].poses, POSES)


@pytest.mark.parametrize("held", [False, True])
def test_joints_show_the_tool_of_poses_told_in_the_world(tmp_path: Path, arm: Arm, joints: Array, held: bool) -> None:
    angles = np.repeat(joints[:1], ROWS, axis=0) if held else joints
    if held:
        angles[:, 0] += np.linspace(0.0, 0.3, ROWS)
    flange = arm.forward(angles)
    tip = in_world(at_tip(flange))
    names = f"timestamp {numbered('actual_q', 6)} {numbered('actual_TCP_pose', 6)}"
    written(tmp_path / "log.csv", names, TIMES, angles, tip[:, :3], pose.to_rotation_vector(tip[:, 3:]))
    loaded = load(tmp_path / "log.csv", declared({"base": BASE}), arm)
    same(loaded.items[0].poses, flange, 1e-5)
    assert any("0.0, 0.0, 150.0" in reason for reason in loaded.reasons)


@pytest.mark.parametrize(("unit", "given"), [(" [deg]", {}), (" [rad]", {}), ("", {}), ("", {"angles": "deg"})])
def test_joints_beside_a_pose_may_be_in_degrees(
    tmp_path: Path, arm: Arm, joints: Array, unit: str, given: dict[str, str]
) -> None:
    tip, shown = at_tip(POSES), joints if unit == " [rad]" else np.degrees(joints)
    names = ["t", "x", "y", "z", "qw", "qx", "qy", "qz", *(f"joint_{number}{unit}" for number in range(1, 7))]
    rows = np.column_stack([TIMES, tip, shown])
    text = "\n".join([",".join(names), *(",".join(f"{value:.9f}" for value in row) for row in rows)])
    (tmp_path / "log.csv").write_text(text + "\n", encoding="utf-8")
    loaded = load(tmp_path / "log.csv", declared(given), arm)
    same(loaded.items[0].poses, POSES, 1e-5)
    assert any("0.0, 0.0, 150.0" in reason for reason in loaded.reasons)
    assert loaded.items[0].joints is None


@pytest.mark.parametrize("name", ["ur5", "robot0"])
def test_a_number_in_a_name_leaves_nothing_beside_it_out(tmp_path: Path, name: str) -> None:
    times = np.cumsum(np.linspace(0.01, 0.05, ROWS))
    arrays: dict[str, Any] = {"time": times, name: POSES}
    np.savez(tmp_path / "log.npz", **arrays)
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["timestamp"], file[f"{name}/position"], file[f"{name}/quaternion"] = times, POSES[:, :3], POSES[:, 3:]
    for path in (tmp_path / "log.npz", tmp_path / "log.h5"):
        (item,) = load(path, declared({"quaternion": "wxyz"}), None).items
        same(item.poses, POSES)
        np.testing.assert_allclose(np.diff(item.times), np.diff(times), atol=1e-9)


def test_long_numbers_tell_demonstrations_apart(tmp_path: Path) -> None:
    days = np.repeat([20240115.0, 20240116.0], ROWS)
    both = np.concatenate([motion(), motion(0.05)])
    np.savez(tmp_path / "log.npz", episode_id=days, position=both[:, :3], quaternion=both[:, 3:])
    found = poses_in(tmp_path / "log.npz", quaternion="wxyz", rate_hz=HZ)
    assert len(found) == 2
    same(found[1], motion(0.05))


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("head", ["r", "R", "rot_"])
def test_entries_of_a_rotation_matrix_are_an_orientation(tmp_path: Path, first: int, head: str) -> None:
    entries = " ".join(f"{head}{row}{column}" for row in range(first, first + 3) for column in range(first, first + 3))
    matrices = pose.to_matrix(POSES[:, 3:]).reshape(ROWS, 9)
    same(poses_in(written(tmp_path / "log.csv", f"t x y z {entries}", TIMES, POSES[:, :3], matrices))[0], POSES, 1e-5)


def test_a_quaternion_of_no_length_is_refused_by_its_key() -> None:
    with pytest.raises(BadInputError, match=r"import.*orientation must be a quaternion, of length 1, found \[0.0, 0.0"):
        declared({"orientation": [0, 0, 0, 0]})
