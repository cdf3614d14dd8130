"""A recording of a stranger that hangs, grows or lies about its size is refused soon, in one line."""

import io
import os
import time
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from recording_files import POSES, TIMES, XYZW, poses_in, same, written

from koopdqn import confined
from koopdqn.demonstrations.recordings import load, text
from koopdqn.errors import BadInputError

HEADER = "t,x,y,z,qw,qx,qy,qz"


def refused(path: Path, message: str) -> None:
    """Check that a file is refused in time, in one line that names it."""
    began = time.monotonic()
    with pytest.raises(BadInputError, match=message) as caught:
        poses_in(path)
    assert time.monotonic() - began < 60
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def npy(shape: tuple[int, ...], content: bytes, kind: str) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


@pytest.mark.parametrize(
    ("shape", "content", "kind", "message"),
    [
        ((1 << 40, 7), b"", "<f8", "at most 256 MiB"),
        ((1 << 23, 7), b"", "|u1", "at most 256 MiB"),
        ((1000, 7), bytes(64), "<f8", "intact npy or npz"),
        ((1 << 40, 7), b"", "|O", "is a pickle"),
    ],
)
def test_an_array_that_claims_more_than_it_holds(
    tmp_path: Path, shape: tuple[int, ...], content: bytes, kind: str, message: str
) -> None:
    (tmp_path / "a.npy").write_bytes(npy(shape, content, kind))
    refused(tmp_path / "a.npy", message)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("a.npy", npy(shape, content, kind))
    refused(tmp_path / "a.npz", message)


def test_an_archive_that_lies_about_its_size(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy((1 << 16, 7), bytes(7 << 19), "<f8"))
    content = path.read_bytes()
    size = len(npy((1 << 16, 7), bytes(7 << 19), "<f8")).to_bytes(4, "little")
    assert content.count(size) == 2
    path.write_bytes(content.replace(size, (1000).to_bytes(4, "little")))
    refused(path, "intact npy or npz")


def test_a_compressed_structure_that_grows(tmp_path: Path) -> None:
    content = {"log": {"poses": np.zeros((1 << 20, 33))}}
    scipy.io.savemat(tmp_path / "a.mat", content, do_compression=True)
    assert (tmp_path / "a.mat").stat().st_size < 1 << 20
    refused(tmp_path / "a.mat", "at most 256 MiB")


def test_groups_that_hold_themselves(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["log/poses"] = POSES
        file["log/log"] = file["log"]
    refused(tmp_path / "a.h5", "recursion")


def test_datasets_in_other_files_are_not_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["poses"] = POSES
    POSES.tofile(tmp_path / "secret.bin")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["linked"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/poses")
        file.create_dataset("outside", POSES.shape, "f8", external=[(str(tmp_path / "secret.bin"), 0, POSES.nbytes)])
    refused(tmp_path / "a.h5", "found none with two rows or more")


def test_rows_that_repeat_grow(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    rows = np.zeros(1 << 26, dtype=np.int8)
    parquet.write_table(pyarrow.table({"x": rows}), tmp_path / "a.parquet")
    assert (tmp_path / "a.parquet").stat().st_size < 1 << 20
    refused(tmp_path / "a.parquet", "at most 256 MiB")


@pytest.mark.parametrize("header", [HEADER, "time,pos_x,pos_y,pos_z,qw,qx,qy,qz"])
def test_a_line_of_endless_names(tmp_path: Path, header: str) -> None:
    names = header + "".join(f",c{index}" for index in range(20_000))
    (tmp_path / "a.csv").write_text(names + "\n" + "1," * 10 + "\n")
    refused(tmp_path / "a.csv", "cells|must have length 1")


@pytest.mark.parametrize("header", [f"demo,{HEADER}", "episode,time,pos_x,pos_y,pos_z,qw,qx,qy,qz"])
def test_a_demonstration_a_row(tmp_path: Path, header: str) -> None:
    lines = "".join(f"{index},0,0,0,0,1,0,0,0\n" for index in range(100_000))
    (tmp_path / "a.csv").write_text(f"{header}\n{lines}")
    refused(tmp_path / "a.csv", "at (most|least)")


def test_what_shakes_between_all_its_rows_is_cut_in_time(tmp_path: Path) -> None:
    rows = 40_000
    times = np.arange(rows) * 1e-5
    poses = np.repeat(POSES[:1], rows, axis=0)
    poses[:, 0] += 0.005 * np.sin(2 * np.pi * 16 * times / 0.5)
    np.save(tmp_path / "a.npy", np.column_stack([times, poses]))
    began = time.monotonic()
    assert len(poses_in(tmp_path / "a.npy", quaternion="wxyz")) == 1
    assert time.monotonic() - began < 60


def test_what_a_library_says_in_several_lines_is_told_in_one(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / "a.parquet").write_bytes(b"PAR1" + bytes(64) + (8).to_bytes(4, "little") + b"PAR1")
    refused(tmp_path / "a.parquet", "intact Parquet file")


def test_a_pipe_or_a_device(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    refused(tmp_path / "a.csv", "found a pipe or a device")
    refused(Path("/dev/zero"), "found a pipe or a device")


def test_a_reader_that_hangs_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "SECONDS", 0.5)
    monkeypatch.setattr(text, "read", lambda *_: time.sleep(100))
    (tmp_path / "log.csv").write_text("a,b\n1,2\n")
    refused(tmp_path / "log.csv", "at most 1 s")


def test_a_reader_that_grows_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "read", lambda *_: [bytes(1 << 33)])
    (tmp_path / "log.csv").write_text("a,b\n1,2\n")
    refused(tmp_path / "log.csv", "memory")


def test_a_bag_that_unpacks_to_much_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, Writer

    writer = Writer(tmp_path / "bag", version=9)
    writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with writer:
        pass
    (packed,) = (tmp_path / "bag").glob("*.zstd")
    # A frame of 64 MiB of zeros: blocks that repeat one byte 128 KiB long.
    blocks = [bytes([*((1 << 17 << 3 | 2 | (index == 511)).to_bytes(3, "little")), 0]) for index in range(512)]
    packed.write_bytes(b"\x28\xb5\x2f\xfd\x00\x58" + b"".join(blocks))
    (tmp_path / "scratch").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    monkeypatch.setattr(confined, "_UNPACKED_BYTES", 1 << 20)
    refused(tmp_path / "bag", "intact bag")
    assert list((tmp_path / "scratch").iterdir()) == []


def test_numbers_are_the_same_bytes_beyond_the_process(tmp_path: Path) -> None:
    written(tmp_path / "a.csv", "t x y z qx qy qz qw", TIMES, POSES[:, :3], XYZW, form="%.17g")
    (found,) = poses_in(tmp_path / "a.csv")
    same(found, POSES, within=1e-15)
