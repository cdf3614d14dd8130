"""CSV demonstrations: what is written is read back, what loggers write is read, what is wrong is named."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from koopdqn import pose
from koopdqn.demonstrations.csv import ROTATIONS, Rotation, write_csv
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.recordings.load import load
from koopdqn.demonstrations.recordings.recording import NOTHING
from koopdqn.errors import BadInputError

HEAD = "t,x,y,z,qw,qx,qy,qz"
ROWS = ["0.0,0.40,0.1,0.2,1,0,0,0", "0.1,0.41,0.1,0.2,1,0,0,0", "0.2,0.42,0.1,0.2,1,0,0,0"]


def read_csv(path: Path) -> tuple[Demonstration, ...]:
    return load(path, NOTHING, None).items


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "log.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@given(
    vectors=arrays(float, (5, 3), elements=st.floats(-1.7, 1.7)),
    positions=arrays(float, (5, 3), elements=st.floats(-2.0, 2.0)),
    rotation=st.sampled_from(list(ROTATIONS)),
)
def test_what_is_written_is_read_back(
    tmp_path_factory: pytest.TempPathFactory, vectors: np.ndarray, positions: np.ndarray, rotation: Rotation
) -> None:
    item = Demonstration(0.1 * np.arange(5.0), pose.make(positions, pose.from_rotation_vector(vectors)))
    path = tmp_path_factory.mktemp("csv") / "demos.csv"
    write_csv(path, [item, item], rotation)
    first, second = read_csv(path)
    np.testing.assert_array_equal(first.times, item.times)
    np.testing.assert_array_equal(first.poses[:, pose.POSITION], item.poses[:, pose.POSITION])
    assert pose.rotation_distance(first.poses, item.poses).max() < 1e-7
    np.testing.assert_array_equal(first.poses, second.poses)


@pytest.mark.parametrize(
    "text",
    [
        "\n".join([HEAD, *ROWS]),
        "\ufeff" + "\n".join([HEAD, *ROWS]) + "\n",
        "\r\n".join([HEAD, *ROWS]) + "\r\n\r\n",
        "\n".join([HEAD, *ROWS]).replace(",", ";"),
        "\n".join([HEAD, *ROWS]).replace(",", "\t"),
        "\n".join([HEAD, *ROWS]).replace(",", "  "),
        "\n".join([HEAD, *ROWS]).replace(",", ";").replace(".", ","),
        "\n".join(["# of an arm", "", HEAD.upper(), *ROWS, " "]),
        "\n".join([", ".join(HEAD.split(",")), *ROWS]),
        "\n".join([HEAD + ",force", *(row + ",3.5" for row in ROWS)]),
        "\n".join([HEAD, *(row.replace("1,0,0,0", "0.999,0,0,0") for row in ROWS)]),
        "\n".join([HEAD, ROWS[0], ROWS[1].replace("1,0,0,0", "-1,0,0,0"), ROWS[2]]),
        "\n".join(["x,y,z,qw,qx,qy,qz,t", *(f"{row[4:]},{row[:3]}" for row in ROWS)]),
        "\n".join([HEAD, *(row + "," for row in ROWS)]),
    ],
    ids=[
        "plain",
        "mark",
        "crlf",
        "semicolons",
        "tabs",
        "blanks",
        "decimal commas",
        "case",
        "blanks in header",
        "extra",
        "rounded",
        "sign",
        "order",
        "separator at the end",
    ],
)
def test_files_of_many_loggers_say_the_same(tmp_path: Path, text: str) -> None:
    (item,) = read_csv(written(tmp_path, text))
    np.testing.assert_allclose(item.poses[:, 0], [0.40, 0.41, 0.42])
    np.testing.assert_array_equal(item.times, [0.0, 0.1, 0.2])
    np.testing.assert_allclose(item.poses[:, 3:], [[1.0, 0.0, 0.0, 0.0]] * 3)


def test_utf16_of_a_spreadsheet_is_read(tmp_path: Path) -> None:
    (item,) = read_csv(written(tmp_path, "\n".join([HEAD, *ROWS]).encode("utf-16")))
    assert len(item) == 3


def test_demonstrations_are_told_apart_by_their_column(tmp_path: Path) -> None:
    rows = [f"{name},{row}" for name in ("second", "first") for row in ROWS]
    second, first = read_csv(written(tmp_path, "\n".join(["demo," + HEAD, *rows[:3], *rows[3:5]])))
    assert (len(second), len(first)) == (3, 2)


def test_a_time_that_repeats_now_and_then_keeps_its_first_row(tmp_path: Path) -> None:
    rows = [f"{0.1 * i:.1f},{0.4 + 0.01 * i},0.1,0.2,1,0,0,0" for i in range(20)]
    again = rows[7].replace(",0.2,", ",0.9,")
    (item,) = read_csv(written(tmp_path, "\n".join([HEAD, *rows[:8], again, *rows[8:]])))
    assert len(item) == 20
    assert item.poses[:, 2].max() == 0.2


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (["", ""], ("rows of numbers", "found none")),
        ([HEAD], ("rows of numbers below its header", "found none")),
        ([HEAD, ROWS[0]], ("at least 2 samples", "found 1")),
        (["t,x,y,qw,qx,qy,qz", "0,0,0,1,0,0,0"], ("columns of a pose", "x y z", "import.columns")),
        (["t,x,y,z", "0,0,0,0"], ("import.orientation", "only positions")),
        ([HEAD + ",x", *(row + ",0" for row in ROWS)], ("every column once", "two named x")),
        ([HEAD, *ROWS[:2], "0.2,nan,0.1,0.2,1,0,0,0"], ("line 4", "x", "nan")),
        ([HEAD, *ROWS[:2], "0.2,,0.1,0.2,1,0,0,0"], ("line 4", "x", "finite")),
        ([HEAD, *ROWS[:2], "0.2,left,0.1,0.2,1,0,0,0"], ("line 4", "left")),
        ([HEAD, *ROWS[:2], "0.2,0.4_2,0.1,0.2,1,0,0,0"], ("line 4", "x must be a finite number", "0.4_2")),
        ([HEAD, *ROWS[:2], "0.2,０.42,0.1,0.2,1,0,0,0"], ("line 4", "x must be a finite number", "０.42")),
        ([HEAD, *ROWS[:2], "0.2,0x1p-2,0.1,0.2,1,0,0,0"], ("line 4", "x must be a finite number", "0x1p-2")),
        ([HEAD, *ROWS[:2], '"' + "9" * 200_000 + '",0,0.1,0.2,1,0,0,0'], ("must be rows of cells", "field larger")),
        ([HEAD, *ROWS[:2], "0.2,0.42,0.1", "0.3,0.43,0.1,0.2,1,0,0,0"], ("line 4", "8 cells", "found 3")),
        ([HEAD, *ROWS[:2], "0,2,0,42,0,1,0,2,1,0,0,0"], ("line 4", "8 cells as the header", "found 12")),
        ([HEAD, *(row.replace("0.4", "40") for row in ROWS)], ("import.units", "mm or cm", "40", "metres")),
        ([HEAD, *(row.replace("1,0,0,0", "2,0,0,0") for row in ROWS)], ("line 2", "length 1", "2")),
        (["t,x,y,z,rx,ry,rz", *(row[:-8] + ",180,0,0" for row in ROWS)], ("import.rotation", "import.angles", "180")),
        (["t,x,y,z,roll,pitch,yaw", *(row[:-8] + ",0,90,0" for row in ROWS)], ("import.angles", "90", "rad")),
        ([HEAD, ROWS[0], ROWS[2], ROWS[1]], ("line 4", "increase", "0.1 after 0.2", "column demo")),
        ([HEAD, *[ROWS[0]] * 5], ("import.rate_hz", "4 of 5", "repeat")),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, lines: list[str], words: tuple[str, ...]) -> None:
    with pytest.raises(BadInputError) as caught:
        read_csv(written(tmp_path, "\n".join(lines)))
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_binary_content_is_no_csv(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="must be a table in text, HDF5"):
        read_csv(written(tmp_path, b"t,x\n\x00\x01\xff\xfe"))


@pytest.mark.parametrize(("name", "kind"), [("trajectory.json", "JSON"), ("trajectory.yaml", "YAML")])
def test_text_that_is_no_table_is_named(tmp_path: Path, name: str, kind: str) -> None:
    path = tmp_path / name
    path.write_text('{"points": [[0, 1], [2, 3]]}')
    with pytest.raises(BadInputError, match=f"must be a table in text, .* found {kind} at"):
        load(path, NOTHING, None)


def test_one_odd_byte_is_no_reason_to_refuse_a_file(tmp_path: Path) -> None:
    text = "\n".join(["# arm 3, 20 °C, Müller", HEAD, *ROWS])
    (item,) = read_csv(written(tmp_path, text.encode("cp1252")))
    assert len(item) == 3


def test_of_two_orientations_in_a_row_one_is_said_to_be_read(tmp_path: Path) -> None:
    path = written(tmp_path, "\n".join([HEAD + ",rx,ry,rz", *(row + ",0,0,0" for row in ROWS)]))
    assert "orientation from qw qx qy qz" in load(path, NOTHING, None).reasons


def test_a_clock_in_milliseconds_is_asked_for_and_one_since_1970_is_seen(tmp_path: Path) -> None:
    ticks = [f"{20 * index},{row[4:]}" for index, row in enumerate(ROWS)]
    with pytest.raises(BadInputError, match=r"import.clock: .* 20 s from row to row are too long"):
        read_csv(written(tmp_path, "\n".join([HEAD, *ticks])))
    since = [f"{1_700_000_000_000 + 20 * index},{row[4:]}" for index, row in enumerate(ROWS)]
    (item,) = read_csv(written(tmp_path, "\n".join([HEAD, *since])))
    np.testing.assert_allclose(item.times, [0.0, 0.02, 0.04])


@pytest.mark.parametrize(("first", "step"), [(2_000_000_000, 20_000), (1_500_000_000, 20_000_000)])
def test_a_count_since_the_machine_began_is_no_time_since_1970(tmp_path: Path, first: int, step: int) -> None:
    """Microseconds and nanoseconds of the size of seconds since 1970."""
    ticks = [f"{first + step * index},{row[4:]}" for index, row in enumerate(ROWS)]
    with pytest.raises(BadInputError, match=r"import.clock: .* from row to row are too long"):
        read_csv(written(tmp_path, "\n".join([HEAD, *ticks])))


def test_a_tool_offset_and_joints_count_whatever_the_clock_is_called(tmp_path: Path) -> None:
    offset = ",".join(f"tcp_offset_{index}" for index in range(6))
    for clock in ("t", "time"):
        rows = [f"{row},0,0,0.15,0,0,0" for row in ROWS]
        (item,) = read_csv(written(tmp_path, "\n".join([HEAD.replace("t", clock, 1) + "," + offset, *rows])))
        np.testing.assert_allclose(item.poses[:, 2], 0.05)


def test_bars_separate_whatever_the_columns_are_called(tmp_path: Path) -> None:
    (item,) = read_csv(written(tmp_path, "\n".join([HEAD, *ROWS]).replace(",", "|")))
    assert len(item) == 3
