"""The doctor for demonstrations: each step does what its name says, each fault is found, the source stays."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_shown import arc, recorded, turned_by
from parts import load_parts

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.demonstrations.cleaning import STEPS, InspectSettings, clean, evened, jump_of, outlying, repeats
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.demonstrations.inspection import compare, describe, findings, follow
from koopdqn.demonstrations.schema import InspectionFile
from koopdqn.paths import to_count
from koopdqn.robot.arm import Arm


def steps(**on: bool) -> InspectSettings:
    """Return settings in which only the named steps are on."""
    return InspectSettings.model_validate({**dict.fromkeys(STEPS, False), **on})


@pytest.fixture(scope="module")
def arm() -> Arm:
    return load_parts().arm


def test_no_step_changes_nothing() -> None:
    item = recorded(arc(), idle=20, noise=0.001)
    assert clean(item, steps()).item is item


def test_a_clean_recording_passes_every_sieve() -> None:
    item = recorded(arc())
    assert not repeats(item).any()
    assert not outlying(item).any()


def test_repeated_samples_are_left_out_and_rests_stay() -> None:
    held = np.repeat(arc(count=60), 3, axis=0)
    item = Demonstration(0.01 * np.arange(float(len(held))), held)
    cleaned = clean(item, steps(repeated=True))
    assert cleaned.repeated == 120
    np.testing.assert_array_equal(cleaned.item.poses, item.poses[::3])
    rested = np.concatenate([arc()[:100], np.repeat(arc()[100:101], 80, axis=0), arc()[101:]])
    left = clean(Demonstration(0.02 * np.arange(float(len(rested))), rested), steps(repeated=True)).item
    assert np.diff(left.times).max() == pytest.approx(79 * 0.02)


@pytest.mark.parametrize("index", [0, 1, 3, 77, 150, -2, -1])
def test_a_spike_is_left_out_and_nothing_else(index: int) -> None:
    poses = recorded(arc(), noise=0.0003).poses.copy()
    poses[index, 2] += 0.05
    found = np.flatnonzero(outlying(Demonstration(0.02 * np.arange(float(len(poses))), poses)))
    assert found.tolist() == [index % len(poses)]


def test_a_longer_last_step_is_no_outlier() -> None:
    position = np.array([[0.4, 0.02 * min(i, 9) + 0.1 * (i > 9), 0.3] for i in range(11)])
    assert not outlying(Demonstration(np.arange(11.0), pose.make(position, [1.0, 0.0, 0.0, 0.0]))).any()


@pytest.mark.parametrize("count", [8, 14, 20, 30])
def test_a_jump_is_told_however_short_the_recording(count: int) -> None:
    position = np.linspace([0.4, -0.15, 0.3], [0.4, 0.15, 0.3], count)
    position[count // 2 :, 2] += 0.25
    item = Demonstration(0.1 * np.arange(float(count)), pose.make(position, [1.0, 0.0, 0.0, 0.0]))
    assert jump_of(item) == pytest.approx(0.25, abs=0.01)


def test_a_few_waypoints_are_followed_as_many_samples_are(arm: Arm) -> None:
    whole = turned_by(arc(), np.pi)
    found = []
    for every in (1, 50):
        rows = np.append(np.arange(0, len(whole) - 1, every), len(whole) - 1)
        found.append(follow(Demonstration(0.05 * rows, whole[rows]), arm))
    assert [each.share for each in found] == [1.0, 1.0]
    assert [each.why for each in found] == ["", ""]


def test_a_corner_is_no_outlier_and_no_jump() -> None:
    position = np.array([[0.4, 0.025 * min(i, 40 - i), 0.3] for i in range(41)])
    item = Demonstration(0.1 * np.arange(41.0), pose.make(position, [1.0, 0.0, 0.0, 0.0]))
    assert not outlying(item).any()
    assert jump_of(item) == 0.0


def test_a_step_that_stays_is_a_jump(arm: Arm) -> None:
    poses = arc()
    poses[100:, 0] += 0.05
    stepped = recorded(poses)
    assert jump_of(stepped) == pytest.approx(0.05, abs=0.002)
    assert jump_of(recorded(arc())) == 0.0
    # A tracker that interpolates jumps in two steps.
    halfway = stepped.poses.copy()
    place = int(np.linalg.norm(np.diff(stepped.poses[:, :3], axis=0), axis=1).argmax())
    halfway[place] = 0.5 * (stepped.poses[place - 1] + stepped.poses[place + 1])
    assert jump_of(Demonstration(stepped.times, halfway)) == pytest.approx(0.025, abs=0.002)
    found = describe(stepped, clean(stepped, steps(smoothing=True)), arm, None)
    assert found.jump_mm == pytest.approx(50, abs=2)
    assert found.outliers == 0
    [line] = [each for each in findings([found], compare([stepped]), "arm", "") if each.name == "samples"]
    assert line.state == "look"
    assert "50 mm from one sample to the next, far faster than the rest, in 0" in line.text


@pytest.mark.parametrize("after_m", [0.0, 0.02])
def test_a_fast_smooth_motion_between_rests_or_slow_ones_is_no_jump(arm: Arm, after_m: float) -> None:
    rest, share = np.zeros(100), np.linspace(0.0, 1.0, 10)
    way = 0.3 * share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    along = np.concatenate([rest, way, 0.3 + after_m * np.linspace(0.0, 1.0, 101)[1:]])
    position = np.array([0.45, -0.1, 0.35]) + np.random.default_rng(0).normal(scale=0.0002, size=(210, 3))
    position[:, 1] += along
    item = Demonstration(0.1 * np.arange(210.0), pose.make(position, [1.0, 0.0, 0.0, 0.0]))
    assert describe(item, clean(item, steps()), arm, None).jump_mm == 0.0


def test_a_motion_that_begins_and_ends_slowly_is_not_hurried_where_rest_is_cut() -> None:
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 200))
    position = np.stack([np.full(200, 0.45), 0.3 * share, np.full(200, 0.35)], axis=1)
    slow = Demonstration(0.02 * np.arange(200.0), pose.make(position, [1.0, 0.0, 0.0, 0.0]))
    cut = clean(slow, steps(idle_ends=True))
    speed = np.linalg.norm(np.diff(cut.item.poses[:, :3], axis=0), axis=1) / np.diff(cut.item.times)
    assert min(cut.before, cut.after) > 0.0
    assert speed[0] <= 1.01 * speed[1]
    assert speed[-1] <= 1.01 * speed[-2]
    assert cut.before + cut.after + np.ptp(cut.item.times) == pytest.approx(np.ptp(slow.times))


def test_even_steps_keep_the_path() -> None:
    item = recorded(arc())
    kept = np.sort(np.random.default_rng(0).permutation(len(item) - 2)[:120]) + 1
    rows = np.concatenate([[0], kept, [len(item) - 1]])
    even = evened(Demonstration(item.times[rows], item.poses[rows]))
    np.testing.assert_allclose(np.diff(even.times), np.diff(even.times)[0])
    nearest = np.linalg.norm(even.poses[:, None, :3] - item.poses[None, :, :3], axis=2).min(axis=1)
    assert nearest.max() < 0.002


@pytest.mark.parametrize("jump", [36 * 3600.0, 30 * 86400.0])
def test_a_clock_that_jumps_by_days_is_not_filled_with_samples(jump: float) -> None:
    item = recorded(arc())
    times = item.times + jump * (np.arange(len(item)) >= 100)
    np.testing.assert_array_equal(evened(Demonstration(times, item.poses)).times, times)


def test_the_arm_follows_what_it_can(arm: Arm) -> None:
    inside = follow(recorded(arc()), arm)
    assert inside.share == 1.0
    assert inside.singular is not None
    assert inside.singular > 0
    out = arc()
    out[:, 0] += np.linspace(0.0, 0.8, len(out))
    gone = follow(recorded(out), arm)
    assert 0 < gone.share < 1
    assert gone.why
    far = arc()
    far[:, 0] += 2.0
    assert follow(recorded(far), arm).singular is None


def test_joint_speed_is_inverse_to_time(arm: Arm) -> None:
    item = recorded(arc())
    slow = follow(Demonstration(2.0 * item.times, item.poses), arm)
    assert slow.speed == pytest.approx(0.5 * (follow(item, arm).speed or 0.0))


def test_the_odd_one_and_the_double_are_found() -> None:
    items = [recorded(arc(0.004 * index)) for index in range(5)]
    beside = compare([*items, recorded(arc(0.15)), items[2]])
    assert beside.odd == [5]
    assert [(pair.first, pair.second) for pair in beside.duplicates] == [(2, 6)]
    assert beside.spread_mm[0] > beside.spread_mm[-1]


def test_two_ways_are_told_and_starts_apart_are_none(arm: Arm) -> None:
    bulges, starts, spread = [], [], []
    for index in range(6):
        bulge, side = arc(0.004 * index), 1.0 if index % 2 else -1.0
        bulge[:, 0] += side * 0.06 * np.sin(np.linspace(0.0, np.pi, len(bulge)))
        start = arc(0.004 * index)
        start[:, 0] += side * np.linspace(0.08, 0.0, len(start))
        bulges.append(recorded(bulge))
        starts.append(recorded(start))
        spread.append(recorded(arc(0.03 * index)))
    assert compare(bulges).ways == [[0, 2, 4], [1, 3, 5]]
    assert compare(bulges).parted.startswith("demonstrations go two ways (0, 2, 4 and 1, 3, 5): what lies between")
    for others in (starts, spread, bulges[:3], [*bulges[::2], bulges[1]]):
        assert compare(others).ways == []
        assert compare(others).parted == ""
    each = [describe(bulges[0], clean(bulges[0], steps()), arm, None)]
    [line] = [one for one in findings(each, compare(bulges), "arm", "") if one.name == "spread"]
    assert line.state == "look"


@pytest.mark.parametrize("count", [3, 4, 6])
def test_one_driven_backwards_is_odd_however_few_there_are(count: int) -> None:
    items = [recorded(arc(0.004 * index)) for index in range(count)]
    assert compare(items).odd == []
    back = Demonstration(items[1].times, items[1].poses[::-1].copy())
    assert compare([items[0], back, *items[2:]]).odd == [1]


def test_the_mean_of_others_is_that_of_those_that_follow() -> None:
    items = [recorded(arc(0.004 * index**2)) for index in range(5)]
    paths = [1e3 * to_count(item.poses, 51)[:, :3] for item in items]
    for others in range(1, 5):
        apart = [
            np.linalg.norm(
                paths[i] - np.mean([paths[(i + k) % 5] for k in range(1, others + 1)], axis=0), axis=1
            ).mean()
            for i in range(5)
        ]
        assert compare(items).left_out_mm[others - 1] == pytest.approx(np.mean(apart), rel=1e-9)


def test_what_is_alike_is_enough_and_one_alone_is_not() -> None:
    assert compare([recorded(arc(0.001 * index)) for index in range(4)]).enough
    assert not compare([recorded(arc())]).enough


def run(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    assert cli.main([*arguments, "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def _finding(found: dict[str, Any], name: str) -> dict[str, str]:
    [line] = [each for each in found["findings"] if each["name"] == name]
    result: dict[str, str] = line
    return result


def test_inspect_says_what_fit_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    good = [recorded(arc(0.004 * index)) for index in range(4)]
    back = Demonstration(good[3].times, good[3].poses[::-1].copy())
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.stack([0.45 + 0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(200, 0.35)], axis=1)
    bit = arc()[:10]
    sets = {
        "good": (good, "good", "starts and ends"),
        "back": ([good[0], back, *good[1:]], "bad", "demonstration 1 must end within task.end_spread"),
        "circle": ([Demonstration(0.02 * np.arange(200.0), pose.make(circle, [1.0, 0, 0, 0]))], "good", "starts and"),
        "bit": ([Demonstration(0.02 * np.arange(10.0), bit)], "bad", "must start at"),
    }
    for name, (items, state, text) in sets.items():
        write_csv(Path(f"{name}.csv"), items)
        line = _finding(run(capsys, "inspect", f"demos={name}.csv", f"out=runs/{name}"), "one task")
        assert line["state"] == state
        assert text in line["text"]
        short = ("intent.count=40", "intent.copies=2", f"out=runs/fit-{name}")
        assert (cli.main(["fit", "task=demonstrated", f"demos={name}.csv", *short]) == 0) == (state == "good")
        capsys.readouterr()
    line = _finding(run(capsys, "inspect", "task=shelf", "demos=good.csv", "out=runs/shelf"), "one task")
    assert line["state"] == "bad"
    assert "of the goal of task shelf" in line["text"]


def test_inspect_writes_what_its_schema_says_and_leaves_the_source(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for index in range(3):
        write_csv(Path(f"log_{index}.csv"), [recorded(arc(0.01 * index), idle=30, noise=0.0003, seed=index)])
    before = {path: path.read_bytes() for path in Path().glob("*.csv")}
    result = run(capsys, "inspect", "log_0.csv", "log_1.csv", "log_2.csv", "out=seen")
    assert {path: path.read_bytes() for path in Path().glob("*.csv")} == before
    assert json.loads(Path("seen/inspect.json").read_text()) == result
    report = InspectionFile.model_validate(result)
    assert report.steps == list(STEPS)
    assert all(one.idle_before_seconds > 0.3 for one in report.demonstrations)
    assert Path("seen/inspect.png").read_bytes()[:4] == b"\x89PNG"
    assert [len(item) for item in read_hdf5(Path("seen/demos.hdf5")).items] == [
        one.kept for one in report.demonstrations
    ]


@pytest.mark.parametrize("command", ["inspect", "import"])
def test_a_log_in_which_nothing_moves_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    still = np.repeat(arc()[:1], 50, axis=0)
    write_csv(tmp_path / "still.csv", [Demonstration(0.02 * np.arange(50.0), still)])
    assert cli.main([command, str(tmp_path / "still.csv"), f"out={tmp_path}/out"]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "found it standing still" in told[0]


def test_several_motions_are_cut_when_that_is_confirmed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    there, rest = arc(), 60
    once = [np.repeat(there[:1], rest, axis=0), there, np.repeat(there[-1:], rest, axis=0), there[::-1]]
    poses = np.concatenate([*once, *once])
    content = "time,tool_x,tool_y,tool_z,tool_qw,tool_qx,tool_qy,tool_qz\n"
    content += "\n".join(",".join(f"{v:.7f}" for v in (0.02 * i, *row)) for i, row in enumerate(poses.tolist()))
    Path("log.csv").write_text(content)
    whole = run(capsys, "import", "log.csv", "out=whole")
    assert whole["demonstrations"] == 1
    assert run(capsys, "import", "log.csv", "import.cut=true", "out=cut")["demonstrations"] == 2
    assert run(capsys, "import", "log.csv", "import.cut=false", "out=one")["sha256"] == whole["sha256"]


def test_files_alone_and_demos_are_the_same_and_not_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["a b.csv", "c,d.csv", "e=f.csv"]
    for name in names:
        write_csv(Path(name), [recorded(arc())])
    assert run(capsys, "import", *names, "out=one")["files"] == names
    assert cli.main(["import", "a b.csv", "demos=c", "out=two"]) == 2
    assert "found both" in capsys.readouterr().err
