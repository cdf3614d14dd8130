"""CSV demonstrations: what is written is read back, what loggers write is read, what is wrong is named."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from koopdqn import pose
from koopdqn.demonstrations.csv import ROTATIONS, Rotation, read_csv, write_csv
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError

HEAD = "t,x,y,z,qw,qx,qy,qz"
ROWS = ["0.0,0.40,0.1,0.2,1,0,0,0", "0.1,0.41,0.1,0.2,1,0,0,0", "0.2,0.42,0.1,0.2,1,0,0,0"]


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
        (["", ""], ("header", "empty")),
        ([HEAD], ("at least 2 samples", "none")),
        ([HEAD, ROWS[0]], ("at least 2 samples", "found 1")),
        (["t,x,y,qw,qx,qy,qz", "0,0,0,1,0,0,0"], ("missing: z", "roll pitch yaw")),
        (["t,x,y,z", "0,0,0,0"], ("exactly one of", "found 0")),
        ([HEAD + ",rx,ry,rz", *(row + ",0,0,0" for row in ROWS)], ("exactly one of", "found 2")),
        ([HEAD + ",x", *(row + ",0" for row in ROWS)], ("its own name", "x")),
        ([HEAD, *ROWS[:2], "0.2,nan,0.1,0.2,1,0,0,0"], ("line 4", "x", "nan")),
        ([HEAD, *ROWS[:2], "0.2,,0.1,0.2,1,0,0,0"], ("line 4", "x", "finite")),
        ([HEAD, *ROWS[:2], "0.2,left,0.1,0.2,1,0,0,0"], ("line 4", "left")),
        ([HEAD, *ROWS[:2], "0.2,0.4_2,0.1,0.2,1,0,0,0"], ("line 4", "x must be a finite number", "0.4_2")),
        ([HEAD, *ROWS[:2], "0.2,０.42,0.1,0.2,1,0,0,0"], ("line 4", "x must be a finite number", "０.42")),
        ([HEAD, *ROWS[:2], "0.2,0x1p-2,0.1,0.2,1,0,0,0"], ("line 4", "x must be a finite number", "0x1p-2")),
        ([HEAD, *ROWS[:2], '"' + "9" * 200_000 + '",0,0.1,0.2,1,0,0,0'], ("must be CSV text", "field larger")),
        ([HEAD, *ROWS[:2], "0.2,0.42,0.1"], ("line 4", "8 cells", "found 3")),
        ([HEAD, *(row.replace("0.4", "40") for row in ROWS)], ("metres", "40", "mm")),
        ([HEAD, *(row.replace("1,0,0,0", "2,0,0,0") for row in ROWS)], ("line 2", "length 1", "2")),
        (["t,x,y,z,rx,ry,rz", *(row[:-8] + ",180,0,0" for row in ROWS)], ("radians", "180", "degrees")),
        (["t,x,y,z,roll,pitch,yaw", *(row[:-8] + ",0,90,0" for row in ROWS)], ("radians", "90", "degrees")),
        ([HEAD, ROWS[0], ROWS[2], ROWS[1]], ("line 4", "increase", "0.1 after 0.2", "column demo")),
        ([HEAD, *[ROWS[0]] * 5], ("increase", "4 of 5")),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, lines: list[str], words: tuple[str, ...]) -> None:
    with pytest.raises(BadInputError) as caught:
        read_csv(written(tmp_path, "\n".join(lines)))
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_binary_content_is_no_csv(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="UTF-8"):
        read_csv(written(tmp_path, b"\x89HDF\r\n\x1a\n\x00\xff\xfe"))
