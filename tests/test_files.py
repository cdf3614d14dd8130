import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.errors import BadInputError
from koopdqn.files import atomic_path, canonical_json, digest, read_json, write_json, write_text

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


class _BrokenError(Exception):
    """Anything that goes wrong while a file is written."""


def _fail_half_way(path: Path, error: type[BaseException]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("half of the n")
        assert path.read_text() == "old"
        raise error


def test_a_file_appears_whole_in_a_folder_made_for_it(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "text.txt"
    write_text(path, "ρ = 2τ\n")
    assert path.read_text(encoding="utf-8") == "ρ = 2τ\n"
    assert [item.name for item in path.parent.iterdir()] == ["text.txt"]


@pytest.mark.parametrize("error", [_BrokenError, KeyboardInterrupt, OSError])
def test_a_failure_keeps_the_old_file_and_leaves_no_part(tmp_path: Path, error: type[BaseException]) -> None:
    path = tmp_path / "text.txt"
    path.write_text("old")
    raised: type[BaseException] = BadInputError if error is OSError else error
    with pytest.raises(raised):
        _fail_half_way(path, error)
    assert path.read_text() == "old"
    assert [item.name for item in tmp_path.iterdir()] == ["text.txt"]


def test_where_nothing_can_be_written_the_reason_is_told(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("a file, no folder")
    with pytest.raises(BadInputError, match="must be writable, the system says"):
        write_text(tmp_path / "plain" / "text.txt", "x")
    (tmp_path / "folder").mkdir()
    with pytest.raises(BadInputError, match="must be writable"):
        write_text(tmp_path / "folder", "x")


@given(content=json_values)
def test_canonical_json_is_one_text_for_one_content(content: object) -> None:
    text = canonical_json(content)
    assert json.loads(text) == content
    assert canonical_json(json.loads(text)) == text
    assert text.isascii()
    assert digest(content) == digest(json.loads(text))


def test_the_order_of_keys_changes_nothing_and_a_value_does() -> None:
    assert canonical_json({"b": 1, "a": [1.5, None]}) == '{"a":[1.5,null],"b":1}'
    assert digest({"b": 1, "a": 2}) == digest({"a": 2, "b": 1}) != digest({"a": 2, "b": 2})
    assert len(digest({})) == 64


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_json_cannot_say_is_refused(tmp_path: Path, value: float) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        canonical_json(value)
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "x.json", {"a": value})
    assert not list(tmp_path.iterdir())


def test_json_for_people_comes_back(tmp_path: Path) -> None:
    write_json(tmp_path / "x.json", {"b": [1, 2.5], "a": None})
    assert (tmp_path / "x.json").read_text().startswith('{\n  "a": null,\n  "b"')
    assert read_json(tmp_path / "x.json", "the report") == {"a": None, "b": [1, 2.5]}


def test_json_that_is_missing_or_damaged_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe")
    for name in ("bad.json", "bytes.json", "none.json"):
        with pytest.raises(BadInputError, match=rf"the report must .*{name}") as caught:
            read_json(tmp_path / name, "the report")
        assert "\n" not in str(caught.value)
