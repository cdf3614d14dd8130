"""Sets of people's motions."""

from pathlib import Path

import numpy as np
import pytest
from helpers_shown import arc, recorded
from people_sets import beside, sets_below

from koopdqn import pose
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError


def rostopic(path: Path, poses: pose.Array) -> None:
    """Write poses (N, 7) as ``rostopic echo -p`` prints them, the first one twice."""
    axes = [*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw")]
    lines = [",".join(["%time", *(f"field.pose.{name}" for name in axes)])]
    for time, row in zip([0, *range(len(poses))], np.concatenate([poses[:1], poses]), strict=True):
        lines.append(",".join(map(str, [1_000_000_000 + 10_000_000 * time, *row[:3], *row[4:], row[3]])))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_a_set_is_a_file_of_several_or_a_folder_of_single_ones(tmp_path: Path) -> None:
    for index in range(3):
        rostopic(tmp_path / "kinova" / f"take{index}.txt", arc(0.01 * index))
    (tmp_path / "lab").mkdir()
    write_csv(tmp_path / "lab" / "three.csv", [recorded(arc())] * 3)
    write_csv(tmp_path / "lab" / "two.csv", [recorded(arc())] * 2)
    found = sets_below(tmp_path)
    assert {name: len(items) for name, items in found.items()} == {"kinova": 3, "lab-three": 3}
    np.testing.assert_allclose(found["kinova"][1].poses, arc(0.01))
    np.testing.assert_allclose(found["kinova"][1].times, 0.01 * np.arange(200), atol=1e-9)


def test_two_sets_of_one_name_are_refused(tmp_path: Path) -> None:
    for place in ("a", "b"):
        (tmp_path / place / "lab").mkdir(parents=True)
        write_csv(tmp_path / place / "lab" / "three.csv", [recorded(arc())] * 3)
    with pytest.raises(BadInputError, match="found lab-three twice, once in"):
        sets_below(tmp_path)


def test_what_cannot_be_read_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "odd.txt").write_text("%time,b\n1,2\n", encoding="utf-8")
    assert sets_below(tmp_path) == {}
    assert "columns of a pose" in " ".join(capsys.readouterr().err.split())


def test_how_far_a_demonstration_turns_off_the_straight_turn_is_measured(tmp_path: Path) -> None:
    turned = arc()
    # There and back by 90° while start and goal are turned alike: 45° off on average.
    angle = 0.5 * np.pi * (1.0 - np.abs(np.linspace(-1.0, 1.0, len(turned))))
    turn = pose.from_rotation_vector(angle[:, None] * np.array([1.0, 0.0, 0.0]))
    turned[:, pose.QUATERNION] = pose.multiply(turned[:, pose.QUATERNION], turn)
    items = (recorded(arc()), recorded(arc(0.01)), recorded(turned))
    (tmp_path / "run").mkdir()
    write_hdf5(tmp_path / "run" / "demos.hdf5", Demonstrations("demonstrated", "unknown", items))
    assert beside(tmp_path, tmp_path / "run")["geodesic_deg"] == pytest.approx(45.0, abs=1.0)
