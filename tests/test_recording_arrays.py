"""Arrays, data sets and bags are the same motion; pickles are refused unread."""

import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
from parts import load_parts
from recording_files import (
    HZ,
    MATRICES,
    POSES,
    ROWS,
    TIMES,
    XYZW,
    declared,
    joints_along,
    motion,
    numbered,
    poses_in,
    same,
    written,
)

from koopdqn import pose
from koopdqn.demonstrations.recordings import tree
from koopdqn.demonstrations.recordings.load import load
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm

TWO = np.stack([motion(), motion(0.05)])
RATE = {"rate_hz": HZ}
RATED_WXYZ = {"rate_hz": HZ, "quaternion": "wxyz"}
RATED_XYZW = {"rate_hz": HZ, "quaternion": "xyzw"}


@pytest.fixture(scope="module")
def arm() -> Arm:
    return load_parts().arm


@pytest.fixture(scope="module")
def joints(arm: Arm) -> Array:
    return joints_along(arm)


def _npz(path: Path, **arrays: Any) -> None:
    np.savez_compressed(path, **arrays)


def _cells(items: list[Array]) -> np.ndarray:
    cells = np.empty(len(items), dtype=object)
    cells[:] = items
    return cells


def _robomimic(path: Path, order: str = "xyzw") -> None:
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": HZ}})
        for index, poses in enumerate(TWO):
            group = data.create_group(f"demo_{index}")
            group["actions"] = np.zeros((ROWS, 7))
            for name in ("obs", "next_obs"):
                group[f"{name}/robot0_eef_pos"] = poses[:, :3]
                group[f"{name}/robot0_eef_quat"] = poses[:, [4, 5, 6, 3]]
                group[f"{name}/robot0_joint_vel"] = np.zeros((ROWS, 7))
                group[f"{name}/agentview_image"] = np.zeros((ROWS, 4, 4, 3), dtype=np.uint8)


def _other_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for index, poses in enumerate(TWO):
            file[f"trial_{index}/ee_position"] = poses[:, :3]
            file[f"trial_{index}/ee_quaternion"] = poses[:, [4, 5, 6, 3]]
            file[f"trial_{index}/time"] = TIMES


WRITERS: dict[str, tuple[str, Callable[[Path], object], dict[str, Any], int]] = {
    "npy of poses": ("a.npy", lambda p: np.save(p, np.hstack([POSES[:, :3], XYZW])), RATED_XYZW, 1),
    "npy with a clock": ("a.npy", lambda p: np.save(p, np.column_stack([TIMES, POSES])), {"quaternion": "wxyz"}, 1),
    "npy, quaternion first": ("a.npy", lambda p: np.save(p, np.hstack([XYZW, POSES[:, :3]])), RATED_XYZW, 1),
    "npy of several": ("a.npy", lambda p: np.save(p, TWO), RATED_WXYZ, 2),
    "npy in centimetres": (
        "a.npy",
        lambda p: np.save(p, TWO * [100, 100, 100, 1, 1, 1, 1]),
        {**RATE, "quaternion": "wxyz", "units": "cm"},
        2,
    ),
    "npy of matrices": ("a.npy", lambda p: np.save(p, MATRICES), RATE, 1),
    "npy in Fortran's order": (
        "a.npy",
        lambda p: np.save(p, np.asfortranarray(POSES)),
        RATED_WXYZ,
        1,
    ),
    "npz named": (
        "a.npz",
        lambda p: _npz(p, t=TIMES, ee_pos=POSES[:, :3], ee_quat=XYZW, grip=TIMES, image=np.zeros((3, 9, 9))),
        {"quaternion": "xyzw"},
        1,
    ),
    "npz of demonstrations": (
        "a.npz",
        lambda p: _npz(p, demo_1=TWO[1], demo_0=TWO[0]),
        RATED_WXYZ,
        2,
    ),
    "npz of one array and a clock": ("a.npz", lambda p: _npz(p, t=TIMES, arm=POSES), {"quaternion": "wxyz"}, 1),
    "npz of poses and a clock": ("a.npz", lambda p: _npz(p, poses=POSES, t=TIMES[:, None]), {"quaternion": "wxyz"}, 1),
    "npz of matrices": ("a.npz", lambda p: _npz(p, T=MATRICES, stamp=TIMES), {}, 1),
    "mat of columns": (
        "a.mat",
        lambda p: scipy.io.savemat(p, {"t": TIMES, "position": POSES[:, :3].T, "quat": XYZW.T}),
        {"quaternion": "xyzw"},
        1,
    ),
    "mat of a structure": (
        "a.mat",
        lambda p: scipy.io.savemat(p, {"log": {"time": TIMES, "T": MATRICES.transpose(1, 2, 0)}}, do_compression=True),
        {},
        1,
    ),
    "mat of cells": (
        "a.mat",
        lambda p: scipy.io.savemat(p, {"demos": _cells([np.column_stack([TIMES, each]) for each in TWO])}),
        {"quaternion": "wxyz"},
        2,
    ),
    "mat of structures": (
        "a.mat",
        lambda p: scipy.io.savemat(
            p, {"demo": [{"t": TIMES, "pos": each[:, :3], "quat": each[:, 3:]} for each in TWO]}
        ),
        {"quaternion": "wxyz"},
        2,
    ),
    "robomimic": ("a.hdf5", _robomimic, {}, 2),
    "HDF5 of others": ("a.h5", _other_hdf5, {"quaternion": "xyzw"}, 2),
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_array_says_the_same(tmp_path: Path, name: str) -> None:
    file, write, fields, count = WRITERS[name]
    write(tmp_path / file)
    items = load(tmp_path / file, declared(fields), None).items
    assert len(items) == count
    for item, expected in zip(items, TWO, strict=False):
        same(item.poses, expected)
        np.testing.assert_allclose(item.times, TIMES, atol=1e-9)


def test_joints_give_the_flange(tmp_path: Path, arm: Arm, joints: Array) -> None:
    written(
        tmp_path / "log.csv", f"timestamp {numbered('actual_q', 6)} {numbered('actual_qd', 6)}", TIMES, joints, joints
    )
    (item,) = load(tmp_path / "log.csv", declared({}), arm).items
    same(item.poses, POSES)
    assert item.joints is not None
    np.testing.assert_allclose(item.joints, joints, atol=1e-8)
    with pytest.raises(BadInputError, match="need an arm"):
        poses_in(tmp_path / "log.csv")


def test_joints_show_the_tool_in_the_flange(tmp_path: Path, arm: Arm, joints: Array) -> None:
    tip = pose.compose(POSES, np.broadcast_to(pose.make([0, 0, 0.15], [1, 0, 0, 0]), POSES.shape))
    names = f"timestamp {numbered('actual_q', 6)} {numbered('actual_TCP_pose', 6)}"
    vectors = pose.to_rotation_vector(tip[:, 3:])
    written(tmp_path / "log.csv", names, TIMES, joints, tip[:, :3], vectors)
    loaded = load(tmp_path / "log.csv", declared({}), arm)
    same(loaded.items[0].poses, POSES, 1e-5)
    assert any("0.0, 0.0, 150.0" in reason for reason in loaded.reasons)


class Bomb:
    """What runs a program when it is unpickled."""

    def __reduce__(self) -> tuple[Callable[[str], Any], tuple[str]]:
        return (exec, ("raise SystemExit('unpickled')",))


def test_columns_of_one_array_may_be_declared_by_their_place(tmp_path: Path) -> None:
    _npz(tmp_path / "a.npz", arm=POSES[:, :3], t=TIMES)
    places = {name: index for index, name in enumerate("xyz")}
    item, *_ = poses_in(tmp_path / "a.npz", columns=places, orientation=[1, 0, 0, 0])
    np.testing.assert_array_equal(item[:, :3], POSES[:, :3])


def test_arrays_of_another_length_are_said_to_be_left_out(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["obs/ee_position"], file["obs/ee_quaternion"] = POSES[:, :3], POSES[:-5, 3:]
    with pytest.raises(BadInputError, match=rf"left out beside tables of {ROWS} rows: .*quaternion of {ROWS - 5} rows"):
        poses_in(tmp_path / "a.h5", orientation=None)
    said = declared({**RATE, "orientation": [1, 0, 0, 0], "columns": {"x": 0, "y": 1, "z": 2}})
    loaded = load(tmp_path / "a.h5", said, None)
    assert any(f"of {ROWS - 5} rows" in reason for reason in loaded.reasons)


@pytest.mark.parametrize("columns", [7, 8, 16])
def test_one_sample_is_too_few_in_any_form(tmp_path: Path, columns: int) -> None:
    np.save(tmp_path / "a.npy", np.zeros((1, columns)))
    with pytest.raises(BadInputError, match="two rows or more"):
        poses_in(tmp_path / "a.npy")


def _pickled_npz(path: Path) -> None:
    np.savez(path, poses=np.array([Bomb()], dtype=object))


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("a.pkl", lambda p: p.write_bytes(pickle.dumps(Bomb()))),
        ("a.dat", lambda p: p.write_bytes(pickle.dumps(Bomb()))),
        ("a.csv", lambda p: p.write_bytes(pickle.dumps(Bomb()))),
        ("a.npy", lambda p: np.save(p, np.array([Bomb()], dtype=object))),
        ("a.npz", _pickled_npz),
    ],
)
def test_a_pickle_is_refused_unread(tmp_path: Path, name: str, write: Callable[[Path], object]) -> None:
    write(tmp_path / name)
    with pytest.raises(BadInputError, match="is a pickle"):
        poses_in(tmp_path / name)


def test_what_is_too_large_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree, "LARGEST_BYTES", 1 << 20)
    zeros = np.zeros((100_000, 7))
    np.save(tmp_path / "a.npy", zeros)
    np.savez_compressed(tmp_path / "a.npz", a=zeros)
    scipy.io.savemat(tmp_path / "a.mat", {"a": zeros}, do_compression=True)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("a", shape=(1 << 40, 7), dtype="f8")
    for name in ("a.npy", "a.npz", "a.mat", "a.h5"):
        with pytest.raises(BadInputError, match="must hold at most 1 MiB"):
            poses_in(tmp_path / name)


@pytest.mark.parametrize("name", ["npy of poses", "npz named", "mat of a structure", "robomimic"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_a_damaged_file_is_refused_in_one_line(tmp_path: Path, name: str, share: float) -> None:
    file, write, fields, _ = WRITERS[name]
    path = tmp_path / file
    write(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(BadInputError) as caught:
        poses_in(path, **fields)
    assert "\n" not in str(caught.value)


def test_a_zip_bomb_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree, "LARGEST_BYTES", 1 << 20)
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(1 << 22))
    with pytest.raises(BadInputError, match="at most 1 MiB"):
        poses_in(tmp_path / "a.npz")


def test_an_unknown_kind_lists_those_that_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(b"\x00\x01\x02\x03")
    with pytest.raises(BadInputError, match="text, HDF5, npy, npz, MATLAB, Parquet, a ROS bag or MCAP"):
        poses_in(tmp_path / "a.bin")


@pytest.mark.parametrize("names", [["x", "y", "z", "qx", "qy", "qz", "qw", "gripper"], None])
def test_a_lerobot_data_set(tmp_path: Path, names: list[str] | None) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    (tmp_path / "meta").mkdir()
    (tmp_path / "data" / "chunk-000").mkdir(parents=True)
    features = {"observation.state": {"names": {"motors": names}}} if names else {}
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"fps": HZ, "features": features}))
    for index, poses in enumerate(TWO):
        state = np.hstack([poses[:, [0, 1, 2, 4, 5, 6, 3]], np.zeros((ROWS, 1))])
        columns = {"observation.state": list(state), "action": list(state), "episode_index": [index] * ROWS}
        table = pyarrow.table({**columns, "timestamp": TIMES, "frame_index": np.arange(ROWS)})
        parquet.write_table(table, tmp_path / "data" / "chunk-000" / f"episode_{index:06d}.parquet")
    if names is None:
        with pytest.raises(BadInputError, match=r"import\.columns"):
            poses_in(tmp_path)
        order = {f"{role}": f"state[{place}]" for place, role in enumerate(["x", "y", "z", "qx", "qy", "qz", "qw"])}
        found = poses_in(tmp_path, columns=order)
    else:
        found = poses_in(tmp_path)
    for poses, expected in zip(found, TWO, strict=True):
        same(poses, expected)


def test_without_the_extras_the_error_names_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    (tmp_path / "a.parquet").write_bytes(b"PAR1")
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n")
    for name, extra in (("a.parquet", "lerobot"), ("a.bag", "ros")):
        with pytest.raises(BadInputError, match=rf"koopdqn\[{extra}\]"):
            poses_in(tmp_path / name)


def test_fields_of_an_array_are_columns(tmp_path: Path) -> None:
    names = ["t", "x", "y", "z", "qw", "qx", "qy", "qz"]
    rows = np.zeros(ROWS, dtype=[*((name, "f8") for name in names), ("note", "U4")])
    for name, column in zip(names, np.column_stack([TIMES, POSES]).T, strict=True):
        rows[name] = column
    np.save(tmp_path / "fields.npy", rows)
    np.savez(tmp_path / "fields.npz", motion=rows)
    for file in ("fields.npy", "fields.npz"):
        (item,) = load(tmp_path / file, declared({}), None).items
        same(item.poses, POSES)
        np.testing.assert_allclose(item.times, TIMES)


@pytest.mark.parametrize("count", [2, 3, 4, 7])
def test_one_clock_of_all_demonstrations_beside_their_poses(tmp_path: Path, count: int) -> None:
    poses = np.stack([motion(0.001 * index) for index in range(count)])
    np.savez(tmp_path / "stack.npz", poses=poses, time=TIMES)
    for item, shown in zip(
        load(tmp_path / "stack.npz", declared({"quaternion": "wxyz"}), None).items, poses, strict=True
    ):
        same(item.poses, shown)
        np.testing.assert_allclose(item.times, TIMES)


@pytest.mark.parametrize("count", [3, 4, 5, 7, 40])
def test_a_clock_of_each_demonstration_beside_their_poses(tmp_path: Path, count: int) -> None:
    poses = np.stack([motion(0.001 * index) for index in range(count)])
    times = np.stack([TIMES * (1.0 + 0.1 * index) for index in range(count)])
    np.savez(tmp_path / "stack.npz", poses=poses, time=times)
    items = load(tmp_path / "stack.npz", declared({"quaternion": "wxyz"}), None).items
    assert len(items) == count
    for item, shown, clock in zip(items, poses, times, strict=True):
        same(item.poses, shown)
        np.testing.assert_allclose(item.times, clock)


def test_logs_with_fields_beside_poses_are_left_aside(tmp_path: Path) -> None:
    log = np.zeros(30, dtype=[("level", "i4"), ("code", "f8")])
    np.savez(tmp_path / "beside.npz", poses=POSES, log_0=log, log_1=log)
    (item,) = load(tmp_path / "beside.npz", declared({"quaternion": "wxyz", "rate_hz": 50}), None).items
    same(item.poses, POSES)


def test_columns_of_samples_beside_another_stack_stand_upright(tmp_path: Path) -> None:
    images = np.zeros((3, ROWS, 2))
    np.savez(tmp_path / "beside.npz", position=POSES[:, :3].T, quat=POSES[:, 3:].T, time=TIMES[None], noise=images)
    (item,) = load(tmp_path / "beside.npz", declared({"quaternion": "wxyz"}), None).items
    same(item.poses, POSES)
