"""Whatever bytes a file holds, reading it ends soon: with its content, or with one line that says what is wrong."""

import io
import json
import os
import signal
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from demos_file import unsealed
from hypothesis import given, settings
from hypothesis import strategies as st
from questions import written

from koopdqn.artifact import Artifact, read_artifact, write_artifact
from koopdqn.confined import confined
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.recording import NOTHING
from koopdqn.errors import BadInputError
from koopdqn.files import DEEPEST_JSON, parse_json, read_json
from koopdqn.oracles.base import Answer
from koopdqn.oracles.journal import read_records

POSES = np.array([[0.4, 0.1 * i, 0.3, 1.0, 0.0, 0.0, 0.0] for i in range(5)])
SHOWN = Demonstrations("shelf", "UR5", [Demonstration(0.1 * np.arange(5.0), POSES, np.zeros((5, 6)))])


def _hdf5(path: Path) -> None:
    write_hdf5(path, SHOWN)


def _foreign_hdf5(path: Path) -> None:
    write_hdf5(path, SHOWN)
    unsealed(path)


def _artifact(path: Path) -> None:
    write_artifact(path, Artifact("intent", {"a": np.eye(3), "b": np.array(True)}, {"x": {"y": [1.5, None]}}))


def _csv(path: Path) -> None:
    write_csv(path, SHOWN.items)


def _journal(path: Path) -> None:
    written(path, [Answer(True, "anna", 0.5), Answer(None, "anna", 0.5), Answer(False, "anna", 0.5, undo=1)])


def _json(path: Path) -> None:
    path.write_text(json.dumps({"a": [1, 2.5, {"b": None}]}))


FILES: dict[str, tuple[Callable[[Path], None], Callable[[Path], object]]] = {
    "demos.hdf5": (_hdf5, read_hdf5),
    "foreign.hdf5": (_foreign_hdf5, read_hdf5),
    "intent.npz": (_artifact, lambda path: read_artifact(path, "intent")),
    "policy.safetensors": (_artifact, lambda path: read_artifact(path, "intent")),
    "demos.csv": (_csv, lambda path: load(path, NOTHING, None)),
    "feedback.jsonl": (_journal, read_records),
    "train.json": (_json, lambda path: read_json(path, "the report")),
}


def error_of(read: Callable[[Path], object], path: Path) -> str:
    """Return the one line with which reading a file is refused; empty if it is read."""
    try:
        read(path)
    except BadInputError as error:
        text = str(error)
    else:
        return ""
    assert len(text.splitlines()) == 1
    return text


@pytest.mark.parametrize("name", FILES)
@settings(max_examples=60)
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, name: str
) -> None:
    make, read = FILES[name]
    path = tmp_path_factory.mktemp("damaged") / name
    make(path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, max(len(content) - 1, 0)))
        kind = data.draw(st.sampled_from(["flip", "flip", "flip", "cut", "put", "copy", "number"]))
        if kind == "flip" and content:
            content[place] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "cut":
            del content[place : place + data.draw(st.integers(1, 200))]
        elif kind == "put":
            content[place:place] = data.draw(st.binary(min_size=1, max_size=20))
        elif kind == "copy":
            content[place:place] = content[: data.draw(st.integers(0, 100))]
        else:
            content[place : place + 8] = data.draw(st.sampled_from([b"\xff" * 8, bytes(8), b"\xff\xff\xff\x7f" * 2]))
    path.write_bytes(content)
    began = time.monotonic()
    assert error_of(read, path) == "" or str(path) in error_of(read, path)
    assert time.monotonic() - began < 40


@settings(max_examples=30)
@given(content=st.binary(max_size=400), name=st.sampled_from(sorted(FILES)))
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes, name: str) -> None:
    path = tmp_path_factory.mktemp("any") / name
    path.write_bytes(content)
    error_of(FILES[name][1], path)


def refused(read: Callable[[], object], message: str) -> None:
    began = time.monotonic()
    with pytest.raises(BadInputError, match=message) as caught:
        read()
    assert "\n" not in str(caught.value)
    assert time.monotonic() - began < 20


def npy(shape: tuple[int, ...], content: bytes, dtype: str = "<f8") -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


@pytest.mark.parametrize(
    ("entries", "compression", "message"),
    [
        ({"a.npy": npy((2**21,), bytes(2**24))}, zipfile.ZIP_DEFLATED, "must not be compressed"),
        ({"a.npy": npy((10**13,), bytes(64))}, zipfile.ZIP_STORED, "must have the bytes that its shape needs"),
        ({"a.npy": npy((10**13,), b"", "<U0")}, zipfile.ZIP_STORED, "must be of numbers, booleans or text"),
        ({"a.npy": npy((1,), bytes(8), "|O")}, zipfile.ZIP_STORED, "must be of numbers, booleans or text"),
        ({f"{i}.npy": b"" for i in range(1001)}, zipfile.ZIP_STORED, "must hold at most 1000 arrays"),
        ({"a.npy": b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535}, zipfile.ZIP_STORED, "must be a whole artifact"),
    ],
    ids=["compressed", "claimed", "empty text", "pickled", "many", "deep header"],
)
def test_an_npz_takes_no_more_memory_than_it_has_bytes(
    tmp_path: Path, entries: dict[str, bytes], compression: int, message: str
) -> None:
    path = tmp_path / "intent.npz"
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    refused(lambda: read_artifact(path, "intent"), message)


def _huge(file: h5py.File) -> None:
    del file["data/demo_0/obs/eef_pos"]
    file["data/demo_0/obs"].create_dataset("eef_pos", shape=(10**9, 3), dtype="f8", chunks=(1000, 3))


def _linked(file: h5py.File) -> None:
    del file["data/demo_0/obs/eef_pos"]
    file["data/demo_0/obs/eef_pos"] = h5py.ExternalLink("other.hdf5", "/x")


def _outer_linked(file: h5py.File) -> None:
    file.move("data", "other")
    file["data"] = h5py.SoftLink("/other")


def _external(file: h5py.File) -> None:
    del file["data/demo_0/obs/eef_pos"]
    file["data/demo_0/obs"].create_dataset("eef_pos", shape=(5, 3), dtype="f8", external=[("/etc/passwd", 0, 120)])


def _virtual(file: h5py.File) -> None:
    del file["data/demo_0/obs/eef_pos"]
    layout = h5py.VirtualLayout(shape=(5, 3), dtype="f8")
    layout[:] = h5py.VirtualSource("other.hdf5", "x", shape=(5, 3))
    file["data/demo_0/obs"].create_virtual_dataset("eef_pos", layout)


def _endless(file: h5py.File) -> None:
    file["data"].attrs["format_version"] = float("inf")


def _deep(file: h5py.File) -> None:
    file["data"].attrs["env_args"] = "[" * 60_000


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (_huge, "must hold at most 268435456 bytes of numbers, found 24000000"),
        (_linked, "must lie in the file itself, found a link"),
        (_outer_linked, "must lie in the file itself, found a link"),
        (_external, "must lie in the file itself, found it in others"),
        (_virtual, "must lie in the file itself, found it in others"),
        (_endless, "format_version must be 1, found inf"),
        (_deep, "env_args a JSON object"),
    ],
)
def test_an_hdf5_file_holds_its_numbers_itself_and_not_too_many(
    tmp_path: Path, damage: Callable[[h5py.File], None], message: str
) -> None:
    path = tmp_path / "demos.hdf5"
    write_hdf5(path, SHOWN)
    with h5py.File(path, "r+") as file:
        damage(file)
    unsealed(path)
    refused(lambda: read_hdf5(path), message)


def _never() -> tuple[None, list[np.ndarray]]:
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT, signal.SIGTERM])
    while True:
        pass


def _endless_memory() -> tuple[None, list[np.ndarray]]:
    return None, [np.ones(2**20) for _ in range(10**6)]


def _killed() -> tuple[None, list[np.ndarray]]:
    os.kill(os.getpid(), signal.SIGKILL)
    return None, []


@pytest.mark.parametrize(
    ("read", "seconds", "message"),
    [
        (_never, 1.0, "must take at most 2 s, found that it takes longer|took too long"),
        (_endless_memory, 60.0, "must not take more memory"),
        (_killed, 1.0, "the library gave up on it"),
    ],
)
def test_a_reader_that_hangs_grows_or_dies_is_ended(read: Callable[[], object], seconds: float, message: str) -> None:
    refused(lambda: confined(read, seconds), message)  # type: ignore[arg-type]  # they return nothing


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, "[" * 100_000 + "]" * 100_000, '{"a":' * 100 + "1" + "}" * 100, "NaN", "[1e999]", "1" * 5000],
)
def test_json_is_bounded_in_depth_and_numbers(tmp_path: Path, text: str) -> None:
    with pytest.raises(ValueError, match=r"deep|finite|Expecting|digits"):
        parse_json(text)
    (tmp_path / "train.json").write_text(text)
    refused(lambda: read_json(tmp_path / "train.json", "the report"), "must hold JSON")
    (tmp_path / "feedback.jsonl").write_text(f'{{"kind": "undo", "x": {text}}}\n')
    refused(lambda: read_records(tmp_path / "feedback.jsonl"), "must be a JSON object")


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats(-9, 9) | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)
    )
)
def test_json_that_is_not_too_deep_is_read_as_it_is(content: object) -> None:
    assert parse_json(json.dumps(content)) == content


def test_the_depth_of_json_ends_where_it_says() -> None:
    assert parse_json("[" * DEEPEST_JSON + "]" * DEEPEST_JSON)
    with pytest.raises(ValueError, match="deeper"):
        parse_json("[" * (DEEPEST_JSON + 1) + "]" * (DEEPEST_JSON + 1))


def test_a_journal_of_many_drops_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [Answer(True, "anna", 0.5)] * 3)
    monkeypatch.setattr("koopdqn.oracles.journal._MOST_READ_ANEW", 50)
    drop = '{"kind":"drop","number":2}\n'
    path.write_text(path.read_text() + drop * 10)
    assert len(read_records(path).items) == 3
    path.write_text(path.read_text() + drop * 10)
    refused(lambda: read_records(path), "drops must not make more than 50 lines be read anew")
