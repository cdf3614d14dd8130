"""The tutorials: the pouring task is one that tells something, and recordings become a checked URScript."""

from pathlib import Path

import numpy as np
import pytest
from helpers_shown import arc, recorded
from parts import straight_poses
from program_reader import read_servoj
from recording_files import joined, numbered, written
from test_programs import assert_within_limits

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.app.api import load_config, open_workcell
from koopdqn.programs.timing import Limits
from koopdqn.tasks.workcell import COLLISION, Workcell

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = (ROOT / "docs" / "tutorial-own-task.md", ROOT / "docs" / "tutorial-recordings.md")


@pytest.fixture
def pouring(monkeypatch: pytest.MonkeyPatch) -> Workcell:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    return open_workcell(load_config("task=pouring", config_dir=ROOT / "examples" / "conf"))


def test_the_person_pours_into_the_glass_and_nowhere_else(pouring: Workcell) -> None:
    task = pouring.task
    starts, _, _ = pouring.reachability.draw_starts(task, np.random.default_rng(1), 5)
    for start in [task.nominal_start, *starts]:
        path = task.demonstrator.roll_out(start, 1000)
        joints, reason = pouring.reachability.follow(path)
        assert joints is not None, reason
        assert not task.rule_broken(path).any()
        assert task.reached(path[-1:])[0]


def test_the_straight_line_hits_the_rack_and_tilting_at_once_spills(pouring: Workcell) -> None:
    task = pouring.task
    line = straight_poses(task.nominal_start[:3], task.goal[:3], 200, task.nominal_start[3:])
    joints, reason = pouring.reachability.follow(line)
    assert joints is None
    assert reason == COLLISION
    tilted = pose.make(task.nominal_start[:3], task.goal[pose.QUATERNION])
    np.testing.assert_array_equal(task.rule_broken(np.array([task.nominal_start, tilted, task.goal])), [0, 1, 0])


def test_the_files_that_the_tutorial_shows_are_those_of_the_examples() -> None:
    text = TUTORIALS[0].read_text(encoding="utf-8")
    shown = [line for block in text.split("```")[1::2] for line in block.splitlines()[1:]]
    held = "\n".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "examples" / "pouring.py", ROOT / "examples" / "conf" / "task" / "pouring.yaml")
    )
    lines = [
        line for line in shown if line.startswith(("class ", "    ", "  - ", "glass_m", "mouth_m", "spill", "near"))
    ]
    assert len(lines) > 10
    assert [line for line in lines if line not in held.splitlines()] == []


@pytest.mark.slow
def test_three_commands_lead_from_recordings_to_a_checked_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for index in range(3):
        item = recorded(arc(0.01 * index), idle=20)
        names = joined(["timestamp", numbered("actual_TCP_pose", 6)])
        written(
            tmp_path / f"log_{index}.csv",
            names,
            item.times,
            item.poses[:, pose.POSITION],
            pose.to_rotation_vector(item.poses[:, pose.QUATERNION]),
            delimiter=" ",
        )
    assert cli.main(["inspect", "log_0.csv", "log_1.csv", "log_2.csv", "out=looked"]) == 0
    assert cli.main(["train", "task=demonstrated", "demos=log_*.csv", "out=mine"]) == 0
    assert cli.main(["export", "run=mine", "out=program"]) == 0
    settings, arm = load_config().program, load_config().robot
    limits = Limits(
        settings.speed_share * np.array(arm.velocity_limits),
        np.full(6, settings.acceleration_rad_s2),
        np.full(6, settings.jerk_rad_s3),
        settings.tool_speed_m_s,
    )
    _, stream = read_servoj(tmp_path / "program" / "program.script")
    assert_within_limits(stream, limits)
