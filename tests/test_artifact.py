from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays_of
from parts import Parts
from safetensors import SafetensorError

from koopdqn.artifact import Artifact, arrays_digest, described, read_artifact, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.intent.model import IntentSettings
from koopdqn.rl.settings import AgentSettings
from koopdqn.settings import load_settings

SUFFIXES = [".npz", ".safetensors"]
ARRAYS = {"matrix": np.arange(6.0).reshape(2, 3), "count": np.array(7), "on": np.array([True, False])}
ABOUT: dict[str, Any] = {"seed": 0, "made_from": {"demonstrations": "ab"}, "list": [1.5, None]}

any_array = st.sampled_from([np.float64, np.float32, np.int64, np.bool_]).flatmap(
    lambda dtype: arrays_of.arrays(dtype, arrays_of.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4))
)


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=25)
@given(arrays=st.dictionaries(st.from_regex(r"[a-z]{1,5}(/[a-z0-9.]{1,5})?", fullmatch=True), any_array, max_size=4))
def test_what_is_written_is_read_with_every_type_shape_and_bit(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, arrays: dict[str, np.ndarray]
) -> None:
    path = tmp_path_factory.mktemp("artifact") / f"x{suffix}"
    write_artifact(path, Artifact("intent", arrays, ABOUT))
    found = read_artifact(path, "intent")
    assert found.about == ABOUT
    assert found.arrays.keys() == arrays.keys()
    for name, values in arrays.items():
        assert found.arrays[name].dtype == values.dtype
        assert found.arrays[name].shape == values.shape
        assert found.arrays[name].tobytes() == values.tobytes()
    assert arrays_digest(found.arrays) == arrays_digest(arrays)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_content_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    turned_round = dict(reversed(list(ABOUT.items())))
    for name, about in (("a", ABOUT), ("b", ABOUT), ("c", turned_round)):
        write_artifact(tmp_path / f"{name}{suffix}", Artifact("intent", ARRAYS, about))
    one, two, three = ((tmp_path / f"{name}{suffix}").read_bytes() for name in "abc")
    assert one == two == three


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_arrays_in_another_memory_order_are_the_same_content(tmp_path: Path, suffix: str) -> None:
    columns = {"matrix": np.asfortranarray(ARRAYS["matrix"])}
    rows = {"matrix": ARRAYS["matrix"]}
    assert arrays_digest(columns) == arrays_digest(rows)
    for name, arrays in (("a", columns), ("b", rows), ("c", {"matrix": ARRAYS["matrix"].T.copy().T})):
        write_artifact(tmp_path / f"{name}{suffix}", Artifact("intent", arrays, {}))
    assert len({(tmp_path / f"{name}{suffix}").read_bytes() for name in "abc"}) == 1


@given(st.integers(0, 5), st.floats(-1, 1))
def test_the_digest_changes_with_any_value_name_type_or_shape(index: int, change: float) -> None:
    values = np.arange(6.0)
    changed = values.copy()
    changed[index] += change
    assert (arrays_digest({"a": changed}) == arrays_digest({"a": values})) == np.array_equal(changed, values)
    variants: list[dict[str, np.ndarray]] = [
        {"b": values},
        {"a": values.astype(np.float32)},
        {"a": values.reshape(2, 3)},
        {},
    ]
    assert len({arrays_digest(item) for item in [{"a": values}, *variants]}) == 5


def refused(path: Path, message: str, kind: str = "intent") -> None:
    with pytest.raises(BadInputError, match=message) as caught:
        read_artifact(path, kind)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_is_missing_cut_or_something_else_is_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    refused(path, "must exist")
    write_artifact(path, Artifact("intent", ARRAYS, ABOUT))
    whole = path.read_bytes()
    for kept in (0, 10, len(whole) // 2, len(whole) - 5):
        path.write_bytes(whole[:kept])
        refused(path, "must be")
    path.write_text("just a text\n")
    refused(path, "must be")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_another_kind_is_refused_by_name(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    write_artifact(path, Artifact("policy", ARRAYS, ABOUT))
    refused(path, "must be of kind intent, found kind policy")


def test_another_format_version_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.npz"
    with monkeypatch.context() as patch:
        patch.setattr("koopdqn.artifact.FORMAT_VERSION", 99)
        write_artifact(path, Artifact("intent", ARRAYS, ABOUT))
    refused(path, "must have format version 1, found 99")


def test_arrays_changed_by_hand_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    write_artifact(path, Artifact("intent", ARRAYS, ABOUT))
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    arrays["matrix"] = arrays["matrix"] + 1e-9
    np.savez(path, **arrays)
    refused(path, "changed by hand")


def test_files_of_others_are_refused(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    refused(tmp_path / "x.npz", "must be a whole artifact")
    save_file({"a": np.zeros(3)}, tmp_path / "x.safetensors")
    refused(tmp_path / "x.safetensors", "must be a whole artifact")


def test_nothing_that_unpickles_is_read(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", koopdqn=np.array({"kind": "intent"}, dtype=object))
    refused(tmp_path / "x.npz", "must be a whole artifact")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failed_write_keeps_the_old_file(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    write_artifact(path, Artifact("intent", ARRAYS, ABOUT))
    old = path.read_bytes()
    with pytest.raises((ValueError, SafetensorError)):
        write_artifact(path, Artifact("intent", {"text": np.array(["a", None], dtype=object)}, ABOUT))
    with pytest.raises(ValueError, match="JSON compliant"):
        write_artifact(path, Artifact("intent", ARRAYS, {"loss": float("nan")}))
    assert path.read_bytes() == old
    assert len(list(tmp_path.iterdir())) == 1


def test_described_settings_load_as_themselves(parts: Parts, paper: Parts) -> None:
    for some in (parts, paper):
        for value, base in ((some.intent, IntentSettings), (some.agent, AgentSettings)):
            node = described(value)
            assert described(load_settings(node, base, "group")) == node
