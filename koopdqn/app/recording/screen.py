"""The screen of a recording: its lines and its picture, and the loop that takes keys and shows what they do."""

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
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
from koopdqn.oracles.terminal.picture import BEFORE, WENT, Picture, WorkcellCamera
from koopdqn.oracles.terminal.picture import GOAL as GOAL_COLOUR
from koopdqn.oracles.terminal.window import (
    DIM,
    GAP,
    GOAL,
    Window,
    beside,
    framed,
    picture_lines,
    region,
    status_lines,
    wrapped,
)
from koopdqn.pose import Array
from koopdqn.robot.render import Ghost, Line
from koopdqn.robot.view import View, choose_view
from koopdqn.tasks.task import breaks_rule
from koopdqn.tasks.workcell import Workcell

START: Final = Style(color="bright_white", bold=True)
_TOOL: Final = Style(color="yellow", bold=True)

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

    def body(_: int) -> list[Text]:
        left = picture_lines(content.picture, [_legend(place.width)], content.remark, place)
        return beside(left, _right(content, width - place.width - (GAP if place.width else 0)), place.width)

    kept = len(content.recorder.state.kept)
    head = f" koopdqn  {content.recorder.task.name}   demonstration {kept}   {kept} kept"
    helps = HELP if content.help else ()
    return framed(head, body, KEYS, helps, status_lines(content.status, width), width, height)


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

    def picture(self, recorder: Recorder) -> Picture:
        """Return the picture of where a recording is.

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


def record(recording: Recording, workcell: Workcell, graphics: Graphics, file: str) -> None:
    """Show a recording on the terminal and take the keys that drive it, until the person finishes or pauses.

    Whatever happens, the terminal is restored. ``file`` names the demonstrations for people.
    """
    recorder = recording.recorder

    def lines(picture: list[Text], width: int, height: int) -> list[Text]:
        shown = Shown(recorder, file, window.status, picture, window.remark, window.help)
        return compose(shown, width, height, pictures=window.pictures)

    window = Window(graphics, lines, "Drive the tool to the goal; ? lists the keys")
    with closing(window):
        # The text first: it can be read while the first picture is drawn.
        window.open()
        camera = window.start(partial(RecordingCamera, workcell))
        keys: list[str] = []
        changed = True
        while True:
            # What nobody sees is drawn when there is room for it.
            if changed and camera is not None and window.pictures:
                window.picture, changed = camera.picture(recorder), False
                window.paint()
            elif keys:
                window.paint()
            keys = window.keys()
            for key in keys:
                if window.helps(key):
                    continue
                if key == "q":
                    return
                reply = recording.press(key)
                window.status = reply.text
                changed |= reply.changed
