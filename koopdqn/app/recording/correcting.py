"""The screen on which a person shows a better way: its lines, and the loop that plays the path and takes keys."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import monotonic
from typing import Final, Generic, Never, TypeVar

import numpy as np
from rich.style import Style
from rich.text import Text

from koopdqn import pose
from koopdqn.app.recording.screen import START, pair, row, status_lines
from koopdqn.app.recording.showing import NOT_ADDED, REFUSED, Showing
from koopdqn.console import counted
from koopdqn.errors import KoopdqnError
from koopdqn.oracles.base import PauseRequested
from koopdqn.oracles.terminal.graphics import Window
from koopdqn.oracles.terminal.screen import DIM, GAP, GOAL, beside, framed, help_body, key_lines, wrapped
from koopdqn.pose import Array
from koopdqn.view.characters import Picture, Track

_LEARNED: Final = Style(color="cyan", bold=True)
_SHOWN: Final = Style(color="yellow", bold=True)
_TOOL: Final = Style(color="magenta", bold=True)
_TEXT_WIDTH: Final = 40
_LEAST_PICTURE: Final = (24, 6)
_MARGIN_M: Final = 0.02

# To the right and up, from above and from the side: signs of the base's axes, by which of x and y is to the right.
_X, _Y, _Z = np.eye(3)
_VIEWS: Final = {
    0: (("from above: x right, y up", _X, _Y), ("from the side: x right, z up", _X, _Z)),
    1: (("from above: y left, x up", -_Y, _X), ("from behind: y left, z up", -_Y, _Z)),
}

KEYS: Final = (
    "space stop, go   ← → along   w s ±x   a d ±y   r f ±z   + - step   Enter add",
    "u undo waypoint   x back on path   e correct   ? help   q quit",
)
HELP: Final = (
    "Stop the path where you would go otherwise; show the better way.",
    "",
    "space     stops the path and lets it go on",
    "← →       a step back, and on along it",
    "w s       moves the waypoint under way along +x -x of the base",
    "a d       along +y -y",
    "r f       along +z -z; it keeps its distance along the path",
    "+ -       larger or smaller steps, by a factor of two",
    "Enter     adds the waypoint there; some 20 to 40 mm apart do",
    "u         takes back the waypoint added last",
    "x         puts the waypoint under way back on the path",
    "e         corrects the path by the waypoints added, and ends",
    "q         ends without correcting",
    "",
    "Waypoints are on disk at once; waypoints=FILE takes the file.",
    "The way there and back is found; the rest of the path stays.",
    "",
    "Any key goes back.",
)

Corrected = TypeVar("Corrected")


@dataclass(frozen=True)
class Shown:
    """What the screen shows.

    Attributes:
        showing: what the person shows.
        task: name of the task.
        folder: the new run's folder, for people.
        status: the lines at the bottom.
        help: whether to show the help instead.
    """

    showing: Showing
    task: str
    folder: str
    status: str = ""
    help: bool = False


def compose(content: Shown, width: int, height: int) -> list[Text]:
    """Return the screen's ``height`` lines, each at most ``width`` characters."""
    showing = content.showing
    status = status_lines(content.status, width)
    keys = [] if content.help else key_lines(KEYS, width, height)
    across, down = width - _TEXT_WIDTH - GAP, height - 1 - len(keys) - len(status)
    if across < _LEAST_PICTURE[0] or down < 2 * _LEAST_PICTURE[1]:
        across = 0
    if content.help:
        body = help_body(HELP, width, down)
    else:
        left = _pictures(showing, across, down) if across else []
        body = beside(left, _right(content, _TEXT_WIDTH if across else width), across)
    moves = "playing" if showing.playing else "stopped"
    head = f" koopdqn  {content.task}   {showing.place:.3f} of {showing.length:.3f} m   {moves}"
    return framed(head, body, keys, status, width, height)


def _pictures(showing: Showing, across: int, down: int) -> list[Text]:
    """Return the path from two sides, one picture above the other, and the legend."""
    tool, bent, added = showing.here[pose.POSITION], showing.under_way, showing.waypoints
    tracks = [(showing.path, _LEARNED), *([] if bent is None else [(bent, _SHOWN)])]
    frame = np.concatenate([track for track, _ in tracks] + [added, showing.waypoint[None]])
    frame = np.concatenate([frame - _MARGIN_M, frame + _MARGIN_M])
    marks: list[tuple[str, Array, Style]] = [("s", showing.path[0], START), ("g", showing.goal[pose.POSITION], GOAL)]
    marks += [(str((number + 1) % 10), point, _SHOWN) for number, point in enumerate(added)]
    marks += [("t", tool, _TOOL), *([("w", showing.waypoint, _SHOWN)] if showing.loose else [])]
    extent = showing.path.max(axis=0) - showing.path.min(axis=0)
    lines = []
    for title, right, up in _VIEWS[int(extent[1] > extent[0])]:
        plane = np.stack([right, up], axis=1)
        picture = Picture(
            frame @ plane,
            [Track(track @ plane, style) for track, style in tracks],
            [(mark, point @ plane, style) for mark, point, style in marks],
        )
        lines += [Text(title, style=DIM), *picture.lines(across, (down - 1) // 2 - 1)]
    legend = [("learned", _LEARNED), ("as shown", _SHOWN), ("t tool", _TOOL), ("w to add", _SHOWN)]
    return [*lines, Text("  ").join(Text(*item) for item in legend)]


def _right(content: Shown, width: int) -> list[Text]:
    showing = content.showing
    here, goal, bent, standing = showing.here, showing.goal, showing.under_way, showing.standing()
    left = pose.multiply(pose.conjugate(here[pose.QUATERNION]), goal[pose.QUATERNION])
    lines = [
        Text("              x       y       z", style=DIM),
        row("tool", here[pose.POSITION] * 1e3, "mm"),
        row("to go", (goal - here)[pose.POSITION] * 1e3, "mm", signed=True),
        row("turn", np.degrees(pose.to_rotation_vector(left)), "° tool", signed=True),
        row("aside", showing.offset * 1e3, "mm", signed=True),
        row("w", showing.waypoint * 1e3, "mm"),
        *wrapped(f"arm    {standing}", width, _TOOL if standing.startswith(REFUSED) else Style()),
        Text(""),
        pair("step", f"{showing.step * 1e3:.4g} mm"),
        pair("added", counted(len(showing.added), "waypoint")),
    ]
    moved = np.zeros(1) if bent is None else pose.norm(bent - showing.path)
    if moved.any():
        reach = showing.arc[moved > 0.0]
        lines.append(pair("moved", f"{1e3 * moved.max():.0f} mm, {reach[0]:.3f} to {reach[-1]:.3f} m"))
    return [*lines, *wrapped(f"into   {content.folder}", width, DIM)]


_WAIT_SECONDS: Final = 0.1
"""How often the size of the screen is looked at."""
_FRAME_SECONDS: Final = 0.05
"""How often a path that is played is drawn."""
_MOST_FRAME_SECONDS: Final = 0.2
"""A path goes on from where it was, however long the process was stopped."""


class CorrectingScreen(Generic[Corrected]):
    """Plays a path on the terminal and takes the keys that show a better way, until the person corrects it or quits."""

    def __init__(self, showing: Showing, task: str, folder: str, correct: Callable[[Array], Corrected]) -> None:
        """Prepare; ``correct`` corrects the path by waypoints (W, 3) [m], and ``folder`` is where it goes, for people.

        What ``correct`` refuses is told on the screen, which stays.
        """
        self._correct = correct
        self._window: Window[Never] = Window("none", self._repaint)
        self._shown = Shown(
            showing, task, folder, "Space stops the path where you would go otherwise; ? lists the keys"
        )

    def run(self) -> Corrected:
        """Return what the correction gave; whatever happens, the terminal is restored.

        Raises:
            PauseRequested: the person quits.
        """
        window, showing = self._window, self._shown.showing
        try:
            window.open()
            self._repaint()
            then = monotonic()
            while True:
                playing = showing.playing and not self._shown.help
                keys = window.device.keys(_FRAME_SECONDS if playing else _WAIT_SECONDS)
                now = monotonic()
                if playing:
                    showing.play(min(now - then, _MOST_FRAME_SECONDS))
                then = now
                for key in keys:
                    made = self._take(key)
                    if made is not None:
                        return made
                if keys or playing or window.resized():
                    self._repaint()
        finally:
            window.close()

    def _take(self, key: str) -> Corrected | None:
        """Do what a key says; return what the correction gave, if it was made."""
        showing = self._shown.showing
        if self._shown.help or key == "?":
            self._shown = replace(self._shown, help=not self._shown.help)
        elif key == "q":
            raise PauseRequested("left without correcting")
        elif key == "e":
            return self._finished()
        else:
            self._shown = replace(self._shown, status=showing.press(key).text)
        return None

    def _finished(self) -> Corrected | None:
        showing = self._shown.showing
        if showing.loose:
            self._say(NOT_ADDED)
            return None
        if not showing.added:
            self._say("No waypoint is added yet: stop the path, move w to the better way, and Enter adds it")
            return None
        self._say("Correcting ...")
        self._repaint()
        try:
            return self._correct(showing.waypoints)
        except KoopdqnError as error:
            self._say(f"Not corrected: {error}; u takes waypoints back")
            return None

    def _say(self, status: str) -> None:
        self._shown = replace(self._shown, status=status)

    def _repaint(self) -> None:
        def lines(_: list[Text], width: int, height: int) -> list[Text]:
            return compose(self._shown, width, height)

        self._window.paint(lines, None)
