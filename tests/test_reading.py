"""Reading demonstrations: files of both kinds, several of them, globs."""

from pathlib import Path

import numpy as np
import pytest
from helpers_shown import arc, recorded, shown
from recording_files import declared

from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.reading import files_of, read_demonstrations
from koopdqn.errors import BadInputError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Ten CSV files of one demonstration each, told apart by their start, and an HDF5 file of two."""
    for index in range(10):
        write_csv(tmp_path / f"log_{index + 1}.csv", [recorded(arc(0.001 * index))])
    write_hdf5(tmp_path / "two.hdf5", shown(recorded(arc(0.02)), recorded(arc(0.03))))
    return tmp_path


def starts(*sources: str, any_task: bool = False) -> list[float]:
    read = read_demonstrations(sources, "demonstrated", "UR5", any_task)
    return [round(1e3 * (item.poses[0, 2] - 0.55)) for item in read.items]


def test_a_glob_is_read_in_natural_order(folder: Path) -> None:
    assert starts(f"{folder}/log_*.csv") == list(range(10))


def test_files_of_both_kinds_follow_one_another(folder: Path) -> None:
    assert starts(str(folder / "two.hdf5"), str(folder / "log_3.csv")) == [20, 30, 2]


def test_a_glob_relative_to_the_working_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert files_of(["*_1.csv", "two.hdf5"]) == [Path("log_1.csv"), Path("two.hdf5")]


def test_a_file_may_be_named_like_a_glob(folder: Path) -> None:
    odd = (folder / "log_1.csv").rename(folder / "log[1].csv")
    assert files_of([str(odd)]) == [odd]


def test_csv_and_hdf5_of_the_same_demonstrations_are_alike(folder: Path) -> None:
    write_csv(folder / "both.csv", read_demonstrations([str(folder / "two.hdf5")], "demonstrated", "UR5").items)
    kinds = [read_demonstrations([str(folder / name)], "demonstrated", "UR5") for name in ("two.hdf5", "both.csv")]
    assert kinds[0].digest() == kinds[1].digest()


def test_hdf5_of_another_task_is_refused_unless_any_will_do(folder: Path) -> None:
    with pytest.raises(BadInputError, match=r"task shelf, found task demonstrated"):
        read_demonstrations([str(folder / "two.hdf5")], "shelf", "UR5")
    assert read_demonstrations([str(folder / "two.hdf5")], "shelf", "UR5", any_task=True).task == "shelf"


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("none_*.csv", "none that match"),
        ("none.csv", "found nothing"),
        (".", "found something else"),
        ("**.csv", "must name files, found .*entire path component"),
    ],
)
def test_what_names_no_file_is_refused(folder: Path, source: str, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        read_demonstrations([str(folder / source)], "demonstrated", "UR5")


def test_a_link_to_itself_is_refused(folder: Path) -> None:
    (folder / "loop.csv").symlink_to(folder / "loop.csv")
    with pytest.raises(BadInputError, match=r"must name files|found nothing"):
        read_demonstrations([str(folder / "loop.csv")], "demonstrated", "UR5")


def test_no_file_counts_twice(folder: Path) -> None:
    with pytest.raises(BadInputError, match="twice"):
        files_of([f"{folder}/log_*.csv", str(folder / "log_2.csv")])


def test_held_out_demonstrations_stay_marked(tmp_path: Path) -> None:
    from dataclasses import replace

    from koopdqn.demonstrations.hdf5 import read_hdf5

    three = shown(*(recorded(arc(0.01 * index)) for index in range(3)))
    write_hdf5(tmp_path / "demos.hdf5", replace(three, held_out=1))
    read = read_hdf5(tmp_path / "demos.hdf5")
    assert read.held_out == 1
    assert read.digest() == three.digest()
    with pytest.raises(BadInputError, match="found 3"):
        replace(three, held_out=3)
    np.testing.assert_array_equal(read.items[2].poses, three.items[2].poses)


def test_one_source_need_not_be_in_a_list(folder: Path) -> None:
    one = folder / "log_3.csv"
    assert files_of(str(one)) == files_of(one) == [one]
    assert len(read_demonstrations(one, "demonstrated", "UR5")) == 1
    with pytest.raises(BadInputError, match="must name a file at least, found none"):
        read_demonstrations([], "demonstrated", "UR5")


def test_a_file_in_two_spellings_is_one_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "link.csv").symlink_to(folder / "log_1.csv")
    for other in ("./log_1.csv", "log_1.csv", str(folder / "link.csv")):
        with pytest.raises(BadInputError, match="must name every file once, found twice"):
            files_of([str(folder / "log_1.csv"), other])


def test_own_hdf5_is_read_as_it_stands_but_can_be_cut(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    there_and_back = np.concatenate([arc(), np.repeat(arc()[-1:], 90, axis=0), arc()[::-1]])
    write_hdf5(folder / "motions.hdf5", shown(recorded(there_and_back, idle=20)))
    source = folder / "motions.hdf5"
    for fields in ({"base": [1, 0, 0, 0, 0, 0]}, {"tool": [0, 0, 0.1, 0, 0, 0], "units": "mm"}):
        with pytest.raises(
            BadInputError, match=f"import.{next(iter(fields))}.*: must be left out for .*koopdqn writes"
        ):
            read_demonstrations(source, "demonstrated", "UR5", declared=declared(fields))
    # Beside a file that needs them they are for that one.
    np.save(folder / "other.npy", 100.0 * arc()[:, :3])
    needed = declared({"units": "cm", "orientation": [1, 0, 0, 0], "rate_hz": 50, "columns": ["x", "y", "z"]})
    both = read_demonstrations([source, folder / "other.npy"], "demonstrated", "UR5", declared=needed)
    assert len(both) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "motions.hdf5: read as it stands" in told
    assert "import.rate_hz" in told
    whole = read_demonstrations(source, "demonstrated", "UR5", declared=declared({"cut": False}))
    cut = read_demonstrations(source, "demonstrated", "UR5", declared=declared({"cut": True}))
    assert len(whole) == len(cut) == 1
    # The way back is left out.
    np.testing.assert_allclose(cut.items[0].poses[-1, :3], arc()[-1, :3], atol=5e-3)
