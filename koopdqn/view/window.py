"""MuJoCo's viewer as a window onto the same motions as the page, moved through by keys."""

import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import pairwise
from typing import Final

import mujoco
import numpy as np

from koopdqn.envs.display import has_display, try_window
from koopdqn.errors import BadInputError
from koopdqn.intent.box import Box
from koopdqn.intent.reward import SOURCES
from koopdqn.intent.trust import TrustDomain
from koopdqn.intent.tube import Tube
from koopdqn.plots import style
from koopdqn.plots.style import rgba
from koopdqn.pose import POSITION
from koopdqn.robot.render import Line, Sphere, draw
from koopdqn.robot.view import choose_view
from koopdqn.view.motions import Motion
from koopdqn.view.page import COLOURS, Shown

KEYS: Final = "space plays, left and right step, Home and End go to the ends, up and down choose a motion"
SECONDS: Final = 8.0
"""How long playing a motion takes."""
# As GLFW numbers keys.
_SPACE, _RIGHT, _LEFT, _DOWN, _UP, _HOME, _END = 32, 262, 263, 264, 265, 268, 269
_FRAME_SECONDS: Final = 1.0 / 50.0
_END_SECONDS: Final = 5.0
_BAR: Final = 40
_SIZE: Final = (1280, 720)
_RADIUS: Final = {"learned": 0.0032, "intent": 0.0022, "demonstration": 0.0022}
_TUBE_OPACITY: Final = 0.06
_TUBE_PIECES: Final = 60


def check_display() -> None:
    """Check that a window can be opened.

    Raises:
        BadInputError: there is no display.
    """
    if not has_display():
        raise BadInputError(
            "window: must be false where there is no display, found true with neither DISPLAY nor WAYLAND_DISPLAY set;"
            " view.html shows the same"
        )


class Player:
    """Which motion is shown, and where in it.

    Attributes:
        motions: to choose among.
        current: index of the one shown.
        step: where in it, a pose's number; not whole while it plays.
        playing: whether it moves by itself.
    """

    def __init__(self, motions: Sequence[Motion]) -> None:
        """Begin at the start of the first motion, playing."""
        self.motions = motions
        self.current = 0
        self.step = 0.0
        self.playing = True

    @property
    def motion(self) -> Motion:
        """The motion shown."""
        return self.motions[self.current]

    @property
    def last(self) -> int:
        """Its last step."""
        return len(self.motion.poses) - 1

    def press(self, key: int) -> None:
        """Take a key, by GLFW's number; others do nothing."""
        if key == _SPACE:
            self.playing = not self.playing
            if self.playing and self.step >= self.last:
                self.step = 0.0
        elif key in (_LEFT, _RIGHT):
            self.playing = False
            self.step = float(np.clip(round(self.step) + (1 if key == _RIGHT else -1), 0, self.last))
        elif key in (_HOME, _END):
            self.playing = False
            self.step = 0.0 if key == _HOME else float(self.last)
        elif key in (_UP, _DOWN):
            self.current = (self.current + (1 if key == _DOWN else -1)) % len(self.motions)
            self.step = 0.0

    def advance(self, seconds: float) -> None:
        """Let it play for a time [s]; it stops at its end."""
        if self.playing:
            self.step = min(self.step + seconds / SECONDS * self.last, float(self.last))
            self.playing = self.step < self.last

    def words(self) -> tuple[str, str]:
        """Return what stands in the window: of the motion, and of where in it, with a bar."""
        step, done = round(self.step), round(_BAR * self.step / max(self.last, 1))
        numbers = "   ".join(f"{strip.name} {strip.values[step]:.1f} {strip.unit}" for strip in self.motion.strips)
        bar = f"[{'#' * done}{'-' * (_BAR - done)}] step {step} of {self.last}"
        # MuJoCo's font has letters of ASCII alone.
        lines = (f"{self.motion.name}: {self.motion.remark}", f"{bar}\n{numbers}")
        name, place = (line.replace("°", "deg").encode("ascii", "replace").decode() for line in lines)
        return name, place


def watch(shown: Shown) -> None:
    """Show motions in MuJoCo's viewer until it is closed.

    Raises:
        WorkFailedError: the window cannot be opened.
    """
    from mujoco import viewer

    scene, pressed = shown.scene, deque[int]()
    player = Player([motion for motion in shown.motions if motion.kind != "intent"])
    # Not the scene's own, which checks of collisions overwrite.
    data = mujoco.MjData(scene.model)
    data.qpos[scene.joint_index] = scene.arm.home
    mujoco.mj_forward(scene.model, data)
    try_window()
    others = set(threading.enumerate())
    # Keys come from the window's own thread.
    opened = viewer.launch_passive(
        scene.model, data, key_callback=pressed.append, show_left_ui=False, show_right_ui=False
    )
    fixed = [Line(track, rgba(COLOURS["demonstration"]), 0.0016) for track in shown.tracks]
    if shown.trust is not None:
        fixed += tube(shown.trust)
    marks = [] if shown.goal is None else [Sphere(shown.goal[POSITION], rgba(COLOURS["intent"]), 0.008)]
    before, drawn = time.monotonic(), -1
    with _ended(others), closing(opened) as window:
        followed = next((motion.joints for motion in player.motions if len(motion.joints)), None)
        if followed is not None:
            view = choose_view(scene, followed, _SIZE)
            with window.lock():
                window.cam.lookat[:], window.cam.distance = view.lookat, view.distance
                window.cam.azimuth, window.cam.elevation = view.azimuth, view.elevation
        while window.is_running():
            while pressed:
                player.press(pressed.popleft())
            now = time.monotonic()
            player.advance(now - before)
            before = now
            with window.lock():
                joints = player.motion.joints
                if len(joints):
                    data.qpos[scene.joint_index] = joints[min(round(player.step), len(joints) - 1)]
                    mujoco.mj_forward(scene.model, data)
                if drawn != player.current:
                    window.user_scn.ngeom = 0
                    draw(window.user_scn, [*path_lines(player.motion), *fixed], marks)
                    drawn = player.current
            name, place = player.words()
            window.set_texts((None, mujoco.mjtGridPos.mjGRID_TOPLEFT, f"{name}\n{place}", ""))
            window.sync()
            time.sleep(_FRAME_SECONDS)


@contextmanager
def _ended(others: set[threading.Thread]) -> Iterator[None]:
    """Wait at the end for threads but the others: the viewer's may draw after GLFW has gone, and hang the process."""
    try:
        yield
    finally:
        for thread in set(threading.enumerate()) - others:
            thread.join(_END_SECONDS)


def path_lines(motion: Motion) -> list[Line]:
    """Return a motion's path, each piece in the colour of where its reward came from, as on the page."""
    points, radius = motion.poses[:, POSITION], _RADIUS[motion.kind]
    if motion.sources is None:
        return [Line(points, rgba(COLOURS[motion.kind]), radius)]
    begins = [0, *(np.flatnonzero(np.diff(motion.sources[1:])) + 1).tolist(), len(points) - 1]
    return [
        Line(points[begin : end + 1], rgba(style.SOURCES[SOURCES[motion.sources[end]]]), radius)
        for begin, end in pairwise(begins)
        if end > begin
    ]


def tube(trust: TrustDomain) -> list[Line]:
    """Return the trust domain as thick lines seen through, left open where nothing is trusted."""
    if isinstance(trust, Tube):
        middle, radius = trust.middle[:, POSITION], trust.radius[:, 0]
    elif isinstance(trust, Box) and trust.shaped:
        middle, radius = trust.mean[:, :3], trust.settings.sigmas * trust.deviation[:, :3].mean(axis=1)
    else:
        return []
    chosen = np.unique(np.linspace(0, len(middle) - 1, min(len(middle), _TUBE_PIECES)).round().astype(int))
    colour = rgba(COLOURS["trust"], _TUBE_OPACITY)
    return [
        Line(middle[[begin, end]], colour, float(radius[begin]))
        for begin, end in pairwise(chosen)
        if trust.known[begin : end + 1].all()
    ]
