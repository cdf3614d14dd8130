"""MuJoCo's viewer as a window: keys move through motions; paths and tube are drawn; without a display one line."""

import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from helpers_shelf import reward_of, shelf, taught
from helpers_view import motions, shown

from koopdqn.app import cli
from koopdqn.envs.display import try_window
from koopdqn.errors import WorkFailedError
from koopdqn.intent.tube import Tube
from koopdqn.plots import style
from koopdqn.plots.style import rgba
from koopdqn.pose import POSITION
from koopdqn.view import window as module
from koopdqn.view.window import Player, path_lines, tube, watch

SPACE, RIGHT, LEFT, DOWN, UP, HOME, END = 32, 262, 263, 264, 265, 268, 269


def test_keys_move_through_a_motion_and_choose_another() -> None:
    player = Player(motions())
    assert player.playing
    for key, step in (
        (RIGHT, 1),
        (RIGHT, 2),
        (LEFT, 1),
        (HOME, 0),
        (LEFT, 0),
        (END, player.last),
        (RIGHT, player.last),
    ):
        player.press(key)
        assert player.step == step
        assert not player.playing
    player.press(SPACE)
    assert (player.playing, player.step) == (True, 0)
    player.press(UP)
    assert player.current == len(motions()) - 1
    player.press(DOWN)
    assert (player.current, player.step) == (0, 0)


def test_it_plays_a_motion_in_its_time_and_stops_at_the_end() -> None:
    player = Player(motions())
    player.advance(module.SECONDS / 2)
    assert player.step == pytest.approx(player.last / 2)
    player.advance(module.SECONDS)
    assert (player.step, player.playing) == (player.last, False)
    name, place = player.words()
    assert name == f"{motions()[0].name}: {motions()[0].remark}"
    assert f"step {player.last} of {player.last}" in place
    assert "to the goal" in place
    assert "turn left to the goal 0.0 deg" in place


def test_a_path_is_drawn_whole_in_the_colours_of_its_rewards() -> None:
    motion = motions()[0]
    assert motion.sources is not None
    sources = np.array(motion.sources)
    sources[:30], sources[30:50] = 1, 4
    lines = path_lines(replace(motion, sources=sources))
    points = np.concatenate([lines[0].points[:1], *(line.points[1:] for line in lines)])
    np.testing.assert_array_equal(points, motion.poses[:, POSITION])
    assert [line.rgba for line in lines[:2]] == [rgba(style.SOURCES["trusted"]), rgba(style.SOURCES["certified"])]
    np.testing.assert_array_equal(lines[1].points[0], motion.poses[29, POSITION])


def test_the_tube_is_open_where_nothing_is_trusted() -> None:
    trust = reward_of(taught()).trust
    assert isinstance(trust, Tube)
    whole = tube(trust)
    doubt = trust.doubt.copy()
    doubt[len(doubt) // 2 :] = np.inf
    assert 0 < len(tube(replace(trust, doubt=doubt))) <= len(whole) / 2 + 1
    assert {line.radius for line in whole} <= set(trust.radius[:, 0].tolist())


class Fake:
    """A viewer that runs for some frames and presses keys."""

    def __init__(self, keys: list[int], frames: int) -> None:
        self.keys, self.frames = keys, frames
        self.cam = mujoco.MjvCamera()
        self.user_scn = mujoco.MjvScene(shelf().scene.model, 5000)
        self.shown: list[np.ndarray] = []
        self.texts: list[str] = []
        self.closed = False

    def launch(self, model: Any, data: Any, *, key_callback: Any, show_left_ui: bool, show_right_ui: bool) -> "Fake":
        self.data, self.press = data, key_callback
        return self

    def is_running(self) -> bool:
        return len(self.shown) < self.frames

    def lock(self) -> Any:
        return nullcontext()

    def set_texts(self, texts: tuple[Any, Any, str, str]) -> None:
        self.texts.append(texts[2])

    def sync(self) -> None:
        self.shown.append(self.data.qpos[shelf().scene.joint_index].copy())
        if self.keys:
            self.press(self.keys.pop(0))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Fake:
    made = Fake([END, RIGHT, DOWN, HOME], 6)
    stand_in = SimpleNamespace(launch_passive=made.launch)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", stand_in)
    monkeypatch.setattr(mujoco, "viewer", stand_in, raising=False)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr(module, "try_window", lambda: None)
    return made


def test_the_arm_follows_the_keys_until_the_window_is_closed(fake: Fake) -> None:
    watch(shown())
    assert fake.closed
    chosen = [motion for motion in motions() if motion.kind != "intent"]
    np.testing.assert_allclose(fake.shown[1], chosen[0].joints[-1])
    np.testing.assert_allclose(fake.shown[-1], chosen[1].joints[0])
    assert chosen[0].name in fake.texts[0]
    assert chosen[1].name in fake.texts[-1]
    assert fake.user_scn.ngeom > 100


def test_a_display_that_opens_no_window_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "glfw", SimpleNamespace(init=lambda: False))
    with pytest.raises(WorkFailedError, match="the window cannot be opened: this display opens none"):
        try_window()


def test_without_a_display_it_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "demos.csv").write_text("x,y,z\n0.4,0,0.4\n0.5,0,0.4\n")
    assert cli.main(["view", f"demos={tmp_path}/demos.csv", "window=true", f"out={tmp_path}/page"]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "window: must be false where there is no display" in line
