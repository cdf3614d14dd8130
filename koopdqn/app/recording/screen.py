"""The screen of a recording: its lines of text for a size, and the picture on it; it asks nothing."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from rich.style import Style
from rich.text import Text

from koopdqn import pose
from koopdqn.app.recording.recorder import Recorder
from koopdqn.oracles.terminal.picture import AXES, BEFORE, GOAL, WENT
from koopdqn.oracles.terminal.screen import GAP, Region, beside, wrapped
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Image, Line, Sphere
from koopdqn.robot.view import View, choose_view
from koopdqn.tasks.workcell import Workcell, build_scene

_DIM: Final = Style(dim=True)
_BOLD: Final = Style(bold=True)
_HEAD: Final = Style(reverse=True, bold=True)
_START: Final = Style(color="bright_white", bold=True)
_TOOL: Final = Style(color="yellow", bold=True)
_GOAL: Final = Style(color="green", bold=True)

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


def compose(shown: Shown, place: Region, width: int, height: int) -> list[Text]:
    """Return the screen's ``height`` lines, each at most ``width`` characters, the picture's place in them free."""
    # One short of the width: a character in the corner makes some terminals scroll.
    status = wrapped(shown.status, width - 1, _BOLD)[:_MOST_STATUS]
    status += [Text("")] * (not status)
    body = height - 1 - len(KEYS) - len(status)
    if shown.help:
        lines = [Text(line) for line in HELP[:body]]
    else:
        right = _right(shown, width - place.width - (GAP if place.width else 0))
        lines = beside(_left(shown, place, body), right, place.width)
    lines = (lines + [Text("")] * body)[:body]
    lines = [_head(shown, width), *lines, *(Text(line, style=_DIM) for line in KEYS)]
    for line in lines:
        line.truncate(width, overflow="crop")
    return [*lines, *status]


def _head(shown: Shown, width: int) -> Text:
    state = shown.recorder.state
    text = f" koopdqn  {shown.recorder.task.name}   demonstration {len(state.kept)}   {len(state.kept)} kept"
    return Text(text[:width].ljust(width), style=_HEAD)


def _left(shown: Shown, place: Region, body: int) -> list[Text]:
    if not place.width:
        return []
    if shown.remark:
        return [Text(""), *wrapped(shown.remark, place.width, _DIM)]
    legend = Text.assemble(("s", _START), " start ", ("t", _TOOL), " tool ", ("g", _GOAL), " goal")
    axes = "  xyz base axes"
    if len(legend) + len(axes) <= place.width:
        legend += Text(axes, style=_DIM)
    return [*(shown.picture or [Text("")] * place.rows), legend][:body]


def _right(shown: Shown, width: int) -> list[Text]:
    recorder = shown.recorder
    task, here = recorder.task, recorder.here
    away = (task.goal - here)[pose.POSITION] * 1e3
    left = pose.multiply(pose.conjugate(here[pose.QUATERNION]), task.goal[pose.QUATERNION])
    turn = np.degrees(pose.to_rotation_vector(left))
    reached = bool(task.reached(here[None])[0])
    broken = bool(task.rule_broken(here[None])[0])
    moves, samples = recorder.state.moves, recorder.samples
    apart = f"{np.linalg.norm(away):.1f} mm and {np.linalg.norm(turn):.1f}° away"
    return [
        Text("              x       y       z", style=_DIM),
        _row("tool", here[pose.POSITION] * 1e3, "mm"),
        _row("goal", task.goal[pose.POSITION] * 1e3, "mm"),
        _row("to go", away, "mm", signed=True),
        _row("turn", turn, "° tool", signed=True),
        _pair("goal", "reached, " + apart if reached else apart, _GOAL if reached else Style()),
        *(wrapped(f"rule   BROKEN here: {task.rule}", width, _TOOL) if broken else [_pair("rule", "held")]),
        Text(""),
        _pair("step", f"{recorder.step * 1e3:.4g} mm, {np.degrees(recorder.turn):.3g}°"),
        _pair("path", f"{moves} move{'' if moves == 1 else 's'}, {recorder.length:.3f} m"),
        _pair("", f"{samples} sample{'' if samples == 1 else 's'} when played"),
        _pair("kept", f"{len(recorder.state.kept)}"),
        *([_pair("in", shown.file, _DIM)] if recorder.state.kept else []),
        Text(""),
        *(Text(f"{first:<16}{second}") for first, second in _MOVING),
    ]


def _row(name: str, values: Array, unit: str, *, signed: bool = False) -> Text:
    sign = "+" if signed else ""
    # Adding zero makes of a rounded −0 a 0.
    numbers = "".join(f"{round(float(value), 1) + 0.0:>{sign}8.1f}" for value in values)
    return Text.assemble((f"{name:<7}", _DIM), numbers, (f" {unit}", _DIM))


def _pair(name: str, value: str, style: Style | None = None) -> Text:
    return Text.assemble((f"{name:<7}", _DIM), (value, style or Style()))


_AXIS_M: Final = 0.13
_AXIS_SHAFT_M: Final = 0.0025
_PATH_M: Final = 0.005
_TIP_M: Final = 0.014
_GHOST: Final = 0.3


class RecordingCamera:
    """Draws a recording in a scene of its own. Close it."""

    def __init__(self, workcell: Workcell, size: tuple[int, int]) -> None:
        """Prepare for pictures of ``size`` (width, height) [pixels].

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        self._goal = workcell.task.goal
        self._workcell = workcell
        self._goal_joints = workcell.reachability.enter(self._goal).joints
        scene = build_scene(workcell.task, workcell.arm)
        # Shadows take nine tenths of the time where the processor draws.
        scene.model.vis.quality.shadowsize = scene.model.vis.quality.offsamples = 0
        self._camera = Camera(scene, size)
        self._seen_from: View | None = None

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._camera.close()

    def picture(self, recorder: Recorder) -> tuple[Image, dict[str, tuple[float, float]]]:
        """Return the picture (height, width, 3) of where a recording is, and where things are in it.

        Those are shares (0…1) of width and height: s the start, t the tool, g the goal, x, y and z the ends of the
        base's axes.
        """
        path = np.array(recorder.state.path)[:, pose.POSITION]
        here, goal = path[-1], self._goal[pose.POSITION]
        axes = here + _AXIS_M * np.eye(3)
        view = self._view(recorder)
        lines = [Line(np.array([here, end]), colour, _AXIS_SHAFT_M) for end, colour in zip(axes, AXES, strict=True)]
        if recorder.state.moves:
            lines.append(Line(path, WENT, _PATH_M))
        image = self._camera.picture(
            recorder.joints,
            view,
            lines=lines,
            spheres=[Sphere(path[0], BEFORE, _TIP_M), Sphere(goal, GOAL, _TIP_M), Sphere(here, WENT, _TIP_M)],
            ghosts=[] if self._goal_joints is None else [Ghost(self._goal_joints, _GHOST)],
        )
        size = self._camera.size
        points = np.array([*axes, path[0], goal, here])
        places = view.pixels(points, size, self._camera.scene.model.vis.global_.fovy) / np.array(size)
        return image, {mark: (float(x), float(y)) for mark, (x, y) in zip("xyzsgt", places, strict=True)}

    def _view(self, recorder: Recorder) -> View:
        if self._seen_from is None:
            # One for the whole session, so that left stays left.
            self._seen_from = choose_view(self._camera.scene, self._motion(recorder.joints), self._camera.size)
        return self._seen_from

    def _motion(self, otherwise: Array) -> Array:
        """Return joint angles (N, 6) [rad] of what is about to be shown: the task's own way, or one posture."""
        task = self._workcell.task
        limit = 20 * int(task.nominal_path.length / task.step_m)
        joints, _ = self._workcell.reachability.follow(task.demonstrator.roll_out(task.nominal_start, limit))
        return otherwise[None] if joints is None else joints
