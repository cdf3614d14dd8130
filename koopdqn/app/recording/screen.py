"""The screen of a recording: its lines and its picture, and the loop that takes keys and shows what they do."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from rich.style import Style
from rich.text import Text

from koopdqn import pose
from koopdqn.app.recording.recorder import Recorder
from koopdqn.app.recording.session import Recording
from koopdqn.console import counted
from koopdqn.oracles.terminal.device import Graphics
from koopdqn.oracles.terminal.graphics import Picture, Window
from koopdqn.oracles.terminal.picture import BEFORE, WENT, Marks, WorkcellCamera
from koopdqn.oracles.terminal.picture import GOAL as GOAL_COLOUR
from koopdqn.oracles.terminal.screen import (
    BOLD,
    DIM,
    GAP,
    GOAL,
    beside,
    framed,
    help_body,
    key_lines,
    picture_lines,
    region,
    wrapped,
)
from koopdqn.pose import Array
from koopdqn.robot.render import Ghost, Image, Line
from koopdqn.robot.view import View, choose_view
from koopdqn.tasks.task import breaks_rule
from koopdqn.tasks.workcell import Workcell

START: Final = Style(color="bright_white", bold=True)
_TOOL: Final = Style(color="yellow", bold=True)
_MOST_STATUS: Final = 3
"""Lines at the bottom that tell what a key did."""

_MOVING: Final = (
    ("w s  +x -x", "i k  about tool x"),
    ("a d  +y -y", "j l  about tool y"),
    ("r f  +z -z", "t h  about tool z"),
    ("g  to the goal", "o  turn as the goal"),
)
KEYS: Final = (
    "b start here  e end, keep it  u undo  x discard  n new start",
    "+ - size of steps  ? help  q finish",
)
HELP: Final = (
    "Show the task: drive the tool from the start to the goal.",
    "",
    "w s  a d  r f   a step along +x -x, +y -y, +z -z of the base",
    "i k  j l  t h   a turn about +x -x, +y -y, +z -z of the tool",
    "g               a step straight at the goal, not past it",
    "o               a turn toward the goal's orientation",
    "+ -             larger or smaller steps, by a factor of two",
    "b               the demonstration starts here",
    "e               it ends here and is kept; another start is drawn",
    "x               discards the moves, back to the drawn start",
    "n               discards the moves, another start is drawn",
    "u               undoes moves and b, e, x, n, one by one",
    "q               finishes; run=FOLDER goes on another time",
    "",
    "Every key and every kept demonstration is on disk at once.",
    "The path is played at a steady speed, its corners rounded",
    "off; how long you think has no part in it.",
    "",
    "Any key goes back.",
)


@dataclass(frozen=True)
class Shown:
    """What the screen shows.

    Attributes:
        recorder: what is recorded.
        file: where the kept demonstrations are, for people.
        status: what the last key did, in one line or a few.
        picture: the picture's lines of characters; none where it is drawn in pixels or not at all.
        remark: a line in place of the picture.
        help: whether to show the help instead.
    """

    recorder: Recorder
    file: str
    status: str
    picture: Sequence[Text] = ()
    remark: str = ""
    help: bool = False


def compose(content: Shown, width: int, height: int, *, pictures: bool) -> list[Text]:
    """Return the screen's ``height`` lines, each at most ``width`` characters."""
    place = region(width, height, pictures=pictures)
    status = status_lines(content.status, width)
    keys = [] if content.help else key_lines(KEYS, width, height)
    room = height - 1 - len(keys) - len(status)
    if content.help:
        body = help_body(HELP, width, room)
    else:
        left = picture_lines(content.picture, [_legend(place.width)], content.remark, place)[:room]
        body = beside(left, _right(content, width - place.width - (GAP if place.width else 0)), place.width)
    kept = len(content.recorder.state.kept)
    head = f" koopdqn  {content.recorder.task.name}   demonstration {kept}   {kept} kept"
    return framed(head, body, keys, status, width, height)


def status_lines(status: str, width: int) -> list[Text]:
    """Return what a key did, as a few lines at the bottom of a screen of that width."""
    # One short of the width: a character in the corner makes some terminals scroll.
    lines = wrapped(status, width - 1, BOLD)[:_MOST_STATUS] or [Text("")]
    for line in lines:
        line.truncate(width - 1, overflow="crop")
    return lines


def _legend(width: int) -> Text:
    legend = Text.assemble(("s", START), " start ", ("t", _TOOL), " tool ", ("g", GOAL), " goal")
    axes = "  xyz base axes"
    return legend + Text(axes, style=DIM) if len(legend) + len(axes) <= width else legend


def _right(shown: Shown, width: int) -> list[Text]:
    recorder = shown.recorder
    task, here = recorder.task, recorder.here
    away = (task.goal - here)[pose.POSITION] * 1e3
    left = pose.multiply(pose.conjugate(here[pose.QUATERNION]), task.goal[pose.QUATERNION])
    turn = np.degrees(pose.to_rotation_vector(left))
    reached = bool(task.reached(here[None])[0])
    broken = bool(breaks_rule(task, here[None])[0])
    moves, samples = recorder.state.moves, recorder.samples
    apart = f"{np.linalg.norm(away):.1f} mm and {np.linalg.norm(turn):.1f}° away"
    return [
        Text("              x       y       z", style=DIM),
        row("tool", here[pose.POSITION] * 1e3, "mm"),
        row("goal", task.goal[pose.POSITION] * 1e3, "mm"),
        row("to go", away, "mm", signed=True),
        row("turn", turn, "° tool", signed=True),
        pair("goal", "reached, " + apart if reached else apart, GOAL if reached else Style()),
        *(wrapped(f"rule   BROKEN here: {task.rule}", width, _TOOL) if broken else [pair("rule", "held")]),
        Text(""),
        pair("step", f"{recorder.step * 1e3:.4g} mm, {np.degrees(recorder.turn):.3g}°"),
        pair("path", f"{counted(moves, 'move')}, {recorder.length:.3f} m"),
        pair("", f"{counted(samples, 'sample')} when played"),
        pair("kept", f"{len(recorder.state.kept)}"),
        *([pair("in", shown.file, DIM)] if recorder.state.kept else []),
        Text(""),
        *(Text(f"{first:<16}{second}") for first, second in _MOVING),
    ]


def row(name: str, values: Array, unit: str, *, signed: bool = False) -> Text:
    """Return a line of three values (3,) under a name."""
    sign = "+" if signed else ""
    # Adding zero makes of a rounded −0 a 0.
    numbers = "".join(f"{round(float(value), 1) + 0.0:>{sign}8.1f}" for value in values)
    return Text.assemble((f"{name:<7}", DIM), numbers, (f" {unit}", DIM))


def pair(name: str, value: str, style: Style | None = None) -> Text:
    """Return a line of a name and a value."""
    return Text.assemble((f"{name:<7}", DIM), (value, style or Style()))


_PATH_M: Final = 0.005
_GHOST: Final = 0.3


class RecordingCamera(WorkcellCamera):
    """Draws a recording."""

    _seen_from: View | None = None

    def picture(self, recorder: Recorder) -> tuple[Image, Marks]:
        """Return the picture (height, width, 3) of where a recording is, and where things are in it.

        Marked are s the start, t the tool, g the goal, x, y and z the ends of the base's axes.
        """
        path = np.array(recorder.state.path)[:, pose.POSITION]
        goal = self.workcell.task.goal
        # One view for the whole session, so that left stays left.
        if self._seen_from is None:
            self._seen_from = choose_view(self.camera.scene, self._motion(recorder.joints), self.camera.size)
        goal_joints = self.workcell.reachability.enter(goal).joints
        return self.drawn(
            recorder.joints,
            self._seen_from,
            path[-1],
            [Line(path, WENT, _PATH_M)] if recorder.state.moves else [],
            {"s": (path[0], BEFORE), "g": (goal[pose.POSITION], GOAL_COLOUR), "t": (path[-1], WENT)},
            [] if goal_joints is None else [Ghost(goal_joints, _GHOST)],
        )

    def _motion(self, otherwise: Array) -> Array:
        """Return joint angles (N, 6) [rad] of what is about to be shown: the task's own way, or one posture."""
        task = self.workcell.task
        limit = 20 * int(task.nominal_path.length / task.step_m)
        joints, _ = self.workcell.reachability.follow(task.demonstrator.roll_out(task.nominal_start, limit))
        return otherwise[None] if joints is None else joints


_WAIT_SECONDS: Final = 0.1
"""How often the size of the screen is looked at."""


class RecordingScreen:
    """Shows a recording on the terminal and takes the keys, until the person finishes."""

    def __init__(self, recording: Recording, workcell: Workcell, graphics: Graphics, file: str) -> None:
        """Prepare for a recording that keys drive; ``file`` names the demonstrations for people."""
        self._recording = recording
        self._workcell = workcell
        self._window: Window[RecordingCamera] = Window(graphics, self._repaint)
        self._shown = Shown(recording.recorder, file, "Drive the tool to the goal; ? lists the keys")
        self._picture: Picture | None = None

    def run(self) -> None:
        """Take keys until the person finishes or pauses; whatever happens, the terminal is restored."""
        window = self._window
        try:
            window.open()
            # The text first: it can be read while the first picture is drawn.
            self._repaint()
            window.start(partial(RecordingCamera, self._workcell))
            self._shown = replace(self._shown, remark=window.remark)
            self._show(anew=True)
            while True:
                keys = window.device.keys(_WAIT_SECONDS)
                changed = False
                for key in keys:
                    if key == "q" and not self._shown.help:
                        return
                    changed |= self._take(key)
                resized = window.resized()
                if keys or resized:
                    self._show(anew=changed or resized)
        finally:
            window.close()

    def _take(self, key: str) -> bool:
        """Do what a key says; return whether the picture is another now."""
        if self._shown.help or key == "?":
            self._shown = replace(self._shown, help=not self._shown.help)
            return False
        reply = self._recording.press(key)
        self._shown = replace(self._shown, status=reply.text)
        return reply.changed

    def _show(self, *, anew: bool) -> None:
        place, camera = self._window.place(), self._window.camera
        if camera is not None and place.width and (anew or self._picture is None or self._picture.place != place):
            self._picture = Picture(*camera.picture(self._recording.recorder), place)
        self._repaint()

    def _repaint(self) -> None:
        window = self._window

        def lines(picture_lines: list[Text], width: int, height: int) -> list[Text]:
            return compose(replace(self._shown, picture=picture_lines), width, height, pictures=window.pictures)

        window.paint(lines, None if self._shown.help else self._picture)
