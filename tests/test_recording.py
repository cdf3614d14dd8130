"""Recording by keys: what keys do to the path, what is kept, and what is on disk whenever it stops."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from keyboard_parts import shown_by_keys
from parts import Parts, load_parts
from small_run import SMALL

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.app.hydra.compose import composed
from koopdqn.app.recording import DemoSettings
from koopdqn.app.recording.playing import overlap_turns, play, round_corners, seconds_along
from koopdqn.app.recording.recorder import MOVES, Recorder, State, target
from koopdqn.app.recording.screen import HELP, Shown, compose
from koopdqn.app.recording.session import LOG, Recording
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.intent.fit import fit
from koopdqn.pose import POSITION, QUATERNION
from koopdqn.robot.ur import URArm
from koopdqn.settings import load_settings
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Workcell, open_workcell

FILE = "demos.hdf5"
FEW = settings(max_examples=15)


@pytest.fixture(scope="module")
def small() -> Parts:
    """A short path, shown by keys in a moment."""
    return load_parts(*SMALL)


@pytest.fixture(scope="module")
def cell(small: Parts) -> Workcell:
    return open_workcell(small.task, small.arm)


@pytest.fixture
def recorder(cell: Workcell, small: Parts) -> Recorder:
    return Recorder(cell, small.demo, 0)


@pytest.fixture
def opened(cell: Workcell, small: Parts) -> Callable[..., Recording]:
    """Open the recording in a folder, as the command does."""

    def recording(folder: Path, seed: int = 0) -> Recording:
        folder.mkdir(exist_ok=True)
        return Recording(cell, small.demo, seed, folder, FILE)

    return recording


@pytest.fixture(scope="module")
def keys(cell: Workcell, small: Parts) -> str:
    """The keys of two demonstrations and of one half made, with detours."""
    recorder = Recorder(cell, small.demo, 0)
    pressed = ""
    for _ in range(2):
        pressed += "rb" if recorder.press("r").changed and recorder.press("b").changed else ""
        pressed += shown_by_keys(recorder) + "e"
        recorder.press("e")
    return pressed + "+rr-uas"


def press(recorder: Recorder | Recording, keys: str) -> None:
    for key in keys:
        reply = recorder.press(key)
        assert reply.changed, (key, reply.text)


def same(a: State, b: State) -> bool:
    digests = [[Demonstrations("t", "a", [item]).digest() for item in state.kept] for state in (a, b)]
    there = np.array_equal(np.array(a.path), np.array(b.path)) and np.array_equal(a.joints[-1], b.joints[-1])
    return there and a.start == b.start and digests[0] == digests[1]


@given(key=st.sampled_from(MOVES), seed=st.integers(0, 99), step=st.floats(1e-3, 0.1), turn=st.floats(0.01, 0.8))
def test_a_move_is_as_long_as_said_and_never_passes_the_goal(key: str, seed: int, step: float, turn: float) -> None:
    here, goal = (
        pose.make(values[:3], values[3:]) for values in np.random.default_rng(seed).normal(scale=0.1, size=(2, 7))
    )
    there = target(key, here, goal, step, turn)
    moved, turned = float(pose.position_distance(here, there)), float(pose.rotation_distance(here, there))
    if key == "g":
        assert moved == pytest.approx(min(step, pose.position_distance(here, goal)))
    elif key == "o":
        assert turned == pytest.approx(min(turn, pose.rotation_distance(here, goal)))
        assert pose.rotation_distance(there, goal) == pytest.approx(pose.rotation_distance(here, goal) - turned)
    assert (moved == 0.0) == (key in "ikjltho")
    assert (turned < 1e-9) == (key in "wsadrfg")
    if key in "wsadrf":
        assert moved == pytest.approx(step)
    if key in "ikjlth":
        axis = pose.to_rotation_vector(pose.multiply(pose.conjugate(here[QUATERNION]), there[QUATERNION]))
        assert np.abs(axis).max() == pytest.approx(turn)
    pair = dict(zip("wsadrfikjlth", "swdafrkiljht", strict=True))
    if key in pair:
        back = target(pair[key], there, goal, step, turn)
        assert pose.position_distance(back, here) < 1e-12
        assert pose.rotation_distance(back, here) < 1e-7


@FEW
@given(first=st.text("wsadrfgo+-bxn", max_size=12), then=st.text("wsadrfgoijkthlbxne", max_size=12))
def test_undo_is_the_exact_inverse(cell: Workcell, small: Parts, first: str, then: str) -> None:
    recorder = Recorder(cell, small.demo, 0)
    for key in first:
        recorder.press(key)
    states = [recorder.state]
    for key in then:
        if recorder.press(key, sure=True).changed:
            states.append(recorder.state)
    for before in reversed(states[:-1]):
        assert recorder.press("u").changed
        assert same(recorder.state, before)


def test_a_shown_task_ends_at_the_goal_and_begins_at_its_start(recorder: Recorder, small: Parts) -> None:
    start = recorder.here
    shown_by_keys(recorder)
    reply = recorder.press("e")
    assert reply.changed, reply.text
    (item,) = recorder.state.kept
    assert pose.position_distance(item.poses[0], start) < 1e-9
    assert small.task.reached(item.poses[-1:])[0]
    assert item.joints is not None
    assert recorder.state.moves == 0
    assert recorder.state.start == 1
    assert pose.position_distance(recorder.here, start) > 1e-3, "the next start is another"


def test_discarding_loses_the_present_one_alone(recorder: Recorder) -> None:
    shown_by_keys(recorder)
    press(recorder, "e")
    begun = recorder.state
    press(recorder, "rab")
    press(recorder, "rx")
    assert same(recorder.state, begun)
    press(recorder, "u")
    assert recorder.state.moves == 1, "and even that comes back"


def test_what_came_before_the_start_mark_is_dropped(recorder: Recorder) -> None:
    press(recorder, "rra")
    marked = recorder.here
    press(recorder, "b")
    assert recorder.state.moves == 0
    assert np.array_equal(recorder.here, marked)
    assert not recorder.press("b").changed
    press(recorder, "g")
    recorder.press("e", sure=True)
    assert pose.position_distance(recorder.state.kept[0].poses[0], marked) < 1e-9


def test_a_move_that_the_arm_cannot_make_changes_nothing_and_says_why(workcell: Workcell, parts: Parts) -> None:
    recorder = Recorder(workcell, parts.demo, 0)
    for key, reason in (("g", "collision: "), ("f", "collision: pedestal_plate with ")):
        press(recorder, "b" if recorder.state.moves else "")
        for _ in range(200):
            before = recorder.state
            reply = recorder.press(key)
            if not reply.changed:
                break
        assert recorder.state is before
        assert reply.text.startswith("Refused: ")
        assert "\n" not in reply.text
        assert reason in reply.text


def test_an_end_off_the_goal_is_told_and_kept_when_meant(recorder: Recorder, small: Parts) -> None:
    press(recorder, "gg")
    before = recorder.state
    apart = 1e3 * float(pose.position_distance(recorder.here, small.task.goal))
    reply = recorder.press("e")
    assert not reply.changed
    assert recorder.state is before
    assert reply.text.startswith(f"{apart:.1f} mm, 0.0° off the goal: fit and train refuse over 5 mm, 1°")
    assert recorder.press("e").changed
    demonstrations = Demonstrations(small.task.name, small.arm.name, recorder.state.kept)
    with pytest.raises(BadInputError, match="must end within"):
        fit(demonstrations, small.task, small.intent, small.trust, small.reward)
    # Said of one end, it is asked again at another.
    press(recorder, "g")
    recorder.press("e")
    press(recorder, "g")
    assert not recorder.press("e").changed


def test_steps_have_limits_and_a_path_needs_one(recorder: Recorder, small: Parts) -> None:
    assert not recorder.press("e").changed
    assert not recorder.press("u").changed
    assert not recorder.press("x").changed
    assert not recorder.press("z").changed
    sizes = {recorder.step}
    while recorder.press("-").changed:
        sizes.add(recorder.step)
    assert min(sizes) < 0.001
    assert recorder.step == min(sizes)
    press(recorder, "r")
    assert "must be at least one step" in recorder.press("e").text
    while recorder.press("+").changed:
        sizes.add(recorder.step)
    assert recorder.step == max(sizes) > small.demo.keyboard.step_m


@given(seed=st.integers(0, 99), around=st.integers(0, 40), count=st.integers(2, 60))
def test_rounding_keeps_the_ends_and_stays_within_its_window(seed: int, around: int, count: int) -> None:
    steps = np.random.default_rng(seed).normal(size=(count, 3))
    poses = pose.make(np.cumsum(steps, axis=0), [1.0, 0.0, 0.0, 0.0])
    result = round_corners(poses, around)
    assert len(result) == len(poses) + 2 * around
    assert np.array_equal(result[[0, -1]], poses[[0, -1]])
    padded = np.concatenate([np.repeat(poses[:1], around, axis=0), poses, np.repeat(poses[-1:], around, axis=0)])
    furthest = around * np.linalg.norm(steps, axis=1).max()
    assert np.linalg.norm((result - padded)[:, POSITION], axis=1).max() <= furthest + 1e-9
    straight = pose.make(np.linspace(0, 1, count)[:, None] * np.ones(3), [1.0, 0.0, 0.0, 0.0])
    assert np.allclose(np.diff(round_corners(straight, around)[:, :3] @ [1, -1, 0]), 0.0), "a straight line stays one"


@given(keys=st.text("wsadrfijo", min_size=1, max_size=20), scale=st.floats(0.1, 4))
def test_turns_are_made_during_the_move_that_follows_them(small: Parts, keys: str, scale: float) -> None:
    path = [small.task.nominal_start]
    keyboard = small.demo.keyboard
    for key in keys:
        path.append(target(key, path[-1], small.task.goal, scale * keyboard.step_m, keyboard.turn_rad))
    found = overlap_turns(np.array(path), small.demo)
    assert pose.rotation_distance(found[[0, -1]], np.array(path)[[0, -1]]).max() < 1e-7
    # Wherever a move ends, the tool is turned as it was when the key was pressed.
    for before, after in pairwise(path):
        if pose.position_distance(before, after) > 0:
            apart = pose.position_distance(found, after) + pose.rotation_distance(found, after)
            assert apart.min() < 1e-7
    longest = seconds_along(np.array(path), small.demo)[-1]
    assert seconds_along(found, small.demo)[-1] <= longest * (1 + 1e-9), "both at once never takes longer"
    last_move = max((index for index, key in enumerate(keys) if key in "wsadrf"), default=-1)
    if last_move == len(keys) - 1:
        still = pose.position_distance(found[1:], found[:-1]) < 1e-12
        turning = pose.rotation_distance(found[1:], found[:-1]) > 1e-6
        assert not (still & turning).any(), "nothing is turned on the spot"


@pytest.mark.parametrize("rounding", [0.0, 0.06])
def test_the_speed_is_the_set_one_however_long_a_person_thinks(
    recorder: Recorder, cell: Workcell, small: Parts, rounding: float
) -> None:
    shown_by_keys(recorder)
    path, joints = np.array(recorder.state.path), recorder.state.joints[0]
    demo: DemoSettings = small.demo.model_copy(
        update={"keyboard": small.demo.keyboard.model_copy(update={"rounding_m": rounding})}
    )
    item, reason = play(path, joints, demo, cell.reachability)
    assert not reason
    interval = np.diff(item.times)
    np.testing.assert_allclose(interval[interval > 0.5 * demo.sample_seconds], demo.sample_seconds, atol=1e-9)
    speeds = pose.position_distance(item.poses[1:], item.poses[:-1]) / interval
    assert speeds.max() <= demo.speed_m_s * (1 + 1e-6)
    longer = item.times[-1] - float(seconds_along(path, demo)[-1])
    assert 0 <= longer <= rounding / demo.speed_m_s + 2 * demo.sample_seconds
    assert item.joints is not None
    assert all(cell.scene.contact(each) == "" for each in item.joints)


def test_a_path_that_rounding_would_take_through_the_scene_is_rounded_less(workcell: Workcell, parts: Parts) -> None:
    recorder = Recorder(workcell, parts.demo, 0)
    while recorder.press("a").changed:
        pass
    # Beside the wall, back out and over: the corner of the way is where the bottle would not pass.
    while not recorder.press("a").changed:
        press(recorder, "s")
    for _ in range(3):
        recorder.press("a")
    path, joints = np.array(recorder.state.path), recorder.state.joints[0]
    wide = parts.demo.model_copy(update={"keyboard": parts.demo.keyboard.model_copy(update={"rounding_m": 0.1})})
    item, reason = play(path, joints, wide, workcell.reachability)
    assert reason.startswith("collision: ")
    assert item.joints is not None
    assert not any(workcell.scene.contact(each) for each in item.joints)


def test_the_same_keys_give_the_same_bytes(tmp_path: Path, opened: Callable[..., Recording], keys: str) -> None:
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        recording = opened(folder)
        press(recording, keys)
        recording.close()
    for name in (FILE, LOG):
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes()
    assert len(read_hdf5(folders[0] / FILE)) == 2


def test_stopped_anywhere_it_goes_on_to_the_same_bytes(
    tmp_path: Path, opened: Callable[..., Recording], keys: str
) -> None:
    whole = opened(tmp_path / "whole")
    press(whole, keys)
    end = keys.index("e")
    for cut in (0, 1, end, end + 1, end + 4, len(keys)):
        folder = tmp_path / str(cut)
        recording = opened(folder)
        press(recording, keys[:cut])
        kept = recording.recorder.state
        recording.close()
        # As a crash in the middle of a write leaves it.
        with (folder / LOG).open("a") as log:
            log.write('{"key": "')
        recording = opened(folder)
        assert same(recording.recorder.state, kept)
        press(recording, keys[cut:])
        recording.close()
        for name in (FILE, LOG):
            assert (folder / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_key_on_disk_before_its_demonstration_makes_it_anew(
    tmp_path: Path, opened: Callable[..., Recording], keys: str
) -> None:
    recording = opened(tmp_path / "a")
    press(recording, keys[: keys.rindex("e") + 1])
    recording.close()
    path = tmp_path / "a" / FILE
    whole = path.read_bytes()
    both = read_hdf5(path)
    write_hdf5(path, replace(both, items=both.items[:1]))
    opened(tmp_path / "a").close()
    assert path.read_bytes() == whole
    path.unlink()
    opened(tmp_path / "a").close()
    assert path.read_bytes() == whole


def test_a_file_that_the_log_does_not_know_is_left_alone(
    tmp_path: Path, opened: Callable[..., Recording], demonstrations: Demonstrations
) -> None:
    for keys in ("", "rr"):
        folder = tmp_path / f"with {keys}"
        recording = opened(folder)
        press(recording, keys)
        recording.close()
        write_hdf5(folder / FILE, replace(demonstrations, items=demonstrations.items[:1]))
        before = (folder / FILE).read_bytes()
        with pytest.raises(BadInputError, match="must hold the 0 demonstrations"):
            opened(folder)
        assert (folder / FILE).read_bytes() == before


def test_the_only_demonstration_taken_back_is_under_way_again(tmp_path: Path, opened: Callable[..., Recording]) -> None:
    recording = opened(tmp_path / "a")
    made = shown_by_keys(recording.recorder)
    recording = opened(tmp_path / "b")
    press(recording, made)
    before = recording.recorder.state
    press(recording, "e")
    assert len(read_hdf5(tmp_path / "b" / FILE)) == 1
    press(recording, "u")
    assert same(recording.recorder.state, before)
    assert recording.demonstrations() is None
    assert not (tmp_path / "b" / FILE).exists()
    recording.close()
    assert same(opened(tmp_path / "b").recorder.state, before)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda log: log.replace('"key": "r"', '"key": "?"', 1), "must do what it did then"),
        (lambda log: log.replace('"kind": "key"', '"kind": "kex"', 1), "line 2: must be a line of a recording"),
        (lambda log: log.split("\n", 1)[1], "line 1: the first line"),
        (lambda log: log.replace('"speed_m_s": 0.1', '"speed_m_s": 0.2'), "run: speed_m_s must be as"),
        (lambda log: log.replace('"seed": 0', '"seed": 1'), "run: seed must be as the recording began with (1, "),
        (lambda log: log[: log.index('"key": "e"')].rsplit("\n", 1)[0] + "\n", "must hold the 0 demonstrations that"),
    ],
)
def test_a_log_that_is_another_is_refused_and_nothing_is_touched(
    tmp_path: Path, opened: Callable[..., Recording], keys: str, damage: Callable[[str], str], expected: str
) -> None:
    recording = opened(tmp_path / "a")
    press(recording, keys)
    recording.close()
    log, kept = tmp_path / "a" / LOG, (tmp_path / "a" / FILE).read_bytes()
    log.write_text(damage(log.read_text()))
    damaged = log.read_bytes()
    with pytest.raises(BadInputError) as error:
        opened(tmp_path / "a")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
    assert (log.read_bytes(), (tmp_path / "a" / FILE).read_bytes()) == (damaged, kept)


@settings(max_examples=40)
@given(width=st.integers(20, 240), height=st.integers(8, 80), pictures=st.booleans(), helps=st.booleans())
def test_a_screen_fits_its_terminal(
    cell: Workcell, small: Parts, width: int, height: int, pictures: bool, helps: bool
) -> None:
    recorder = Recorder(cell, small.demo, 0)
    content = Shown(recorder, "runs/demos.hdf5", "a status " * 40, help=helps)
    lines = compose(content, width, height, pictures=pictures)
    assert len(lines) == height
    assert all(line.cell_len <= width for line in lines)
    assert lines[-1].cell_len < width, "a full last line would scroll"


def test_a_screen_says_where_tool_and_goal_are(recorder: Recorder, small: Parts) -> None:
    press(recorder, "rgj")
    lines = [line.plain for line in compose(Shown(recorder, "f", "told"), 80, 24, pictures=True)]
    text = " ".join(" ".join(lines).split())
    away = 1e3 * float(pose.position_distance(recorder.here, small.task.goal))
    assert f"{away:.1f} mm and 5.0° away" in text
    assert "rule BROKEN here" in text
    for values in (recorder.here[:3], small.task.goal[:3]):
        assert " ".join(f"{1e3 * value:.1f}" for value in values) in text
    assert "+0.0 -5.0 +0.0" in text, "about which axis of the tool it is to be turned back"
    for word in ("10 mm, 5°", "3 moves", "0 kept", "w s +x -x", "i k about tool x", "e end", "q finish", "? help"):
        assert word in text, word
    assert lines[-1] == "told"
    content = Shown(recorder, "f", "", help=True)
    helping = "\n".join(line.plain for line in compose(content, 80, 24, pictures=True))
    assert all(line in helping for line in HELP)


def learned(folder: Path, recorder: Recorder, *overrides: str) -> tuple[float, float]:
    """Show a task three times, train on it, and return the success rate and the share of steps no action matches."""
    for _ in range(3):
        shown_by_keys(recorder)
        press(recorder, "e")
    folder.mkdir(exist_ok=True)
    path, run, measured = folder / FILE, folder / "run", folder / "eval"
    task, arm = recorder.task.name, "UR5"
    write_hdf5(path, Demonstrations(task, arm, recorder.state.kept))
    assert cli.main(["train", *overrides, f"demos={path}", f"out={run}", "--json"]) == 0
    assert cli.main(["eval", f"run={run}", f"out={measured}", "eval.dynamics=false", "--json"]) == 0
    success, unmatched = (
        json.loads(file.read_text())[key]
        for file, key in ((measured / "eval.json", "success_rate"), (run / "fit.json", "unmatched_share"))
    )
    return success, unmatched


@pytest.mark.slow
def test_a_recorded_task_is_learned(tmp_path: Path, recorder: Recorder) -> None:
    assert learned(tmp_path, recorder, *SMALL) == (1.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["shelf", "knife"])
def test_a_whole_task_shown_by_keys_is_learned(tmp_path: Path, task: str) -> None:
    node, demo = composed([f"task={task}", "out=unused"]), load_parts().demo
    workcell = open_workcell(load_settings(node.task, Task, "task"), load_settings(node.robot, URArm, "robot"))
    success, unmatched = learned(tmp_path, Recorder(workcell, demo, 0), f"task={task}")
    assert success == 1.0
    # Table 1 turns only in place or toward the goal; the knife is turned on its way.
    assert task == "knife" or unmatched == 0.0


def test_starts_are_of_the_side_that_is_demonstrated() -> None:
    parts = load_parts("task=both_sides")
    recorder = Recorder(open_workcell(parts.task, parts.arm), parts.demo, 0)
    side = np.sign(parts.task.nominal_start[1])
    for start in range(8):
        assert np.sign(recorder._begun(start, ()).path[0][1]) == side
