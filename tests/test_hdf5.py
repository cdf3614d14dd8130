import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from demos_file import unsealed
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError


def random_set(seed: int, count: int) -> Demonstrations:
    rng = np.random.default_rng(seed)
    items = []
    for index in range(count):
        length = int(rng.integers(2, 9))
        poses = pose.make(rng.normal(size=(length, 3)), rng.normal(size=(length, 4)))
        joints = rng.normal(size=(length, 6)) if index % 2 else None
        items.append(Demonstration(np.cumsum(rng.uniform(0.01, 1, length)), poses, joints))
    return Demonstrations("knife", "UR5", items)


def assert_same(found: Demonstrations, wanted: Demonstrations) -> None:
    assert (found.task, found.arm, len(found)) == (wanted.task, wanted.arm, len(wanted))
    for a, b in zip(found.items, wanted.items, strict=True):
        np.testing.assert_array_equal(a.times, b.times)
        np.testing.assert_array_equal(a.poses, b.poses)
        assert (a.joints is None) == (b.joints is None)
        if a.joints is not None and b.joints is not None:
            np.testing.assert_array_equal(a.joints, b.joints)
    assert found.digest() == wanted.digest()


# Each is read in a process of its own.
@settings(max_examples=25)
@given(seed=st.integers(0, 1000), count=st.integers(1, 12))
def test_what_is_written_is_read_bit_for_bit_in_order(
    tmp_path_factory: pytest.TempPathFactory, seed: int, count: int
) -> None:
    wanted, path = random_set(seed, count), tmp_path_factory.mktemp("hdf5") / "demos.hdf5"
    write_hdf5(path, wanted)
    assert_same(read_hdf5(path), wanted)


def test_generated_demonstrations_come_back_bit_for_bit(tmp_path: Path, demonstrations: Demonstrations) -> None:
    write_hdf5(tmp_path / "demos.hdf5", demonstrations)
    assert_same(read_hdf5(tmp_path / "demos.hdf5"), demonstrations)


def test_the_layout_is_robomimics(tmp_path: Path) -> None:
    wanted = random_set(0, 2)
    write_hdf5(tmp_path / "demos.hdf5", wanted)
    with h5py.File(tmp_path / "demos.hdf5") as file:
        data = file["data"]
        assert sorted(data) == ["demo_0", "demo_1"]
        assert data.attrs["total"] == sum(len(item) for item in wanted.items)
        assert json.loads(data.attrs["env_args"])["env_name"] == "knife"
        assert data.attrs["quaternion_order"] == "wxyz"
        demo = data["demo_1"]
        assert demo.attrs["num_samples"] == len(wanted.items[1])
        np.testing.assert_array_equal(demo["obs/eef_pos"], wanted.items[1].poses[:, :3])
        np.testing.assert_array_equal(demo["obs/eef_quat"], wanted.items[1].poses[:, 3:])
        assert demo["obs/joint_pos"].shape == (len(wanted.items[1]), 6)
        assert "joint_pos" not in data["demo_0/obs"]


def refused(path: Path, message: str) -> None:
    with pytest.raises(BadInputError, match=message) as caught:
        read_hdf5(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    refused(tmp_path / "none.hdf5", "must be a file, found nothing")
    refused(tmp_path, "must be a file")


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_truncated_file_is_refused(tmp_path: Path, kept: float) -> None:
    path = tmp_path / "demos.hdf5"
    write_hdf5(path, random_set(0, 3))
    path.write_bytes(path.read_bytes()[: int(kept * path.stat().st_size)])
    refused(path, "must hold the bytes it was written with" if kept else "must be HDF5 in robomimic's layout")
    if kept:
        unsealed(path)
        refused(path, "must be HDF5 in robomimic's layout")


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "demos.hdf5"
    path.write_text("t,x,y,z\n0,1,2,3\n")
    refused(path, "must be HDF5 in robomimic's layout")


def _other_version(file: h5py.File) -> None:
    file["data"].attrs["format_version"] = 99


def _other_order(file: h5py.File) -> None:
    file["data"].attrs["quaternion_order"] = "xyzw"


def _no_quaternions(file: h5py.File) -> None:
    del file["data/demo_1/obs/eef_quat"]


def _no_data(file: h5py.File) -> None:
    file.move("data", "date")


def _no_demonstrations(file: h5py.File) -> None:
    for name in list(file["data"]):
        del file["data"][name]


def _odd_name(file: h5py.File) -> None:
    file.move("data/demo_0", "data/demo_first")


def _wrong_count(file: h5py.File) -> None:
    file["data/demo_0"].attrs["num_samples"] = 77


def _text_for_numbers(file: h5py.File) -> None:
    shape = file["data/demo_0/obs/eef_pos"].shape
    del file["data/demo_0/obs/eef_pos"]
    file["data/demo_0/obs"].create_dataset("eef_pos", data=np.full(shape, b"far"))


def _broken_json(file: h5py.File) -> None:
    file["data"].attrs["env_args"] = "{"


def _env_args_is_a_list(file: h5py.File) -> None:
    file["data"].attrs["env_args"] = "[1]"


def _not_finite(file: h5py.File) -> None:
    file["data/demo_0/obs/eef_pos"][0, 0] = np.nan


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_other_version, "format_version must be 1, found 99"),
        (_other_order, "quaternion_order must be wxyz, found xyzw"),
        (_no_quaternions, "eef_quat"),
        (_no_data, "data"),
        (_no_demonstrations, "at least one demonstration"),
        (_odd_name, "first"),
        (_wrong_count, r"demo_0: eef_pos and eef_quat must have shapes \(77, 3\)"),
        (_text_for_numbers, "must hold numbers"),
        (_broken_json, "must be HDF5 in robomimic's layout"),
        (_env_args_is_a_list, "must be HDF5 in robomimic's layout"),
        (_not_finite, "must be finite"),
    ],
)
def test_a_damaged_file_is_refused_in_one_line(
    tmp_path: Path, damage: Callable[[h5py.File], None], message: str
) -> None:
    path = tmp_path / "demos.hdf5"
    write_hdf5(path, random_set(0, 3))
    with h5py.File(path, "r+") as file:
        damage(file)
    refused(path, "must hold the bytes it was written with")
    unsealed(path)
    refused(path, message)
