"""The screen on which a person shows a better way: its lines, and the loop that plays the path and takes keys."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from time import monotonic
from typing import Final, TypeVar

import numpy as np
from rich.style import Style
from rich.text import Text

from koopdqn import pose
from koopdqn.app.recording.screen import START, pair, row
from koopdqn.app.recording.showing import NOT_ADDED, REFUSED, Showing
from koopdqn.console import counted
from koopdqn.errors import KoopdqnError
from koopdqn.oracles.base import PauseRequested
from koopdqn.oracles.terminal.window import DIM, GAP, GOAL, Window, beside, framed, status_lines, wrapped
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

    def body(room: int) -> list[Text]:
        across = width - _TEXT_WIDTH - GAP
        if across < _LEAST_PICTURE[0] or room < 2 * _LEAST_PICTURE[1]:
            return _right(content, width)
        return beside(_pictures(showing, across, room), _right(content, _TEXT_WIDTH), across)

    moves = "playing" if showing.playing else "stopped"
    head = f" koopdqn  {content.task}   {showing.place:.3f} of {showing.length:.3f} m   {moves}"
    helps = HELP if content.help else ()
    return framed(head, body, KEYS, helps, status_lines(content.status, width), width, height)


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


_FRAME_SECONDS: Final = 0.05
"""How often a path that is played is drawn."""
_MOST_FRAME_SECONDS: Final = 0.2
"""A path goes on from where it was, however long the process was stopped."""


def correct_by_keys(showing: Showing, task: str, folder: str, correct: Callable[[Array], Corrected]) -> Corrected:
    """Play a path on the terminal and take the keys that show a better way; return what the correction gave.

    What ``correct`` refuses is told on the screen, which stays. Whatever happens, the terminal is restored.

    Args:
        showing: what the person shows.
        task: name of the task.
        folder: where the correction goes, for people.
        correct: corrects the path by waypoints (W, 3) [m].

    Raises:
        PauseRequested: the person quits.
    """

    def lines(_: list[Text], width: int, height: int) -> list[Text]:
        return compose(Shown(showing, task, folder, window.status, window.help), width, height)

    window = Window("none", lines, "Space stops the path where you would go otherwise; ? lists the keys")
    with closing(window):
        window.open()
        then = monotonic()
        while True:
            playing = showing.playing and not window.help
            keys = window.keys(_FRAME_SECONDS) if playing else window.keys()
            now = monotonic()
            if playing:
                showing.play(min(now - then, _MOST_FRAME_SECONDS))
            then = now
            for key in keys:
                if window.helps(key):
                    continue
                if key == "q":
                    raise PauseRequested("left without correcting")
                if key != "e":
                    window.status = showing.press(key).text
                    continue
                made = _corrected(window, showing, correct)
                if made is not None:
                    return made
            if keys or playing:
                window.paint()


def _corrected(window: Window, showing: Showing, correct: Callable[[Array], Corrected]) -> Corrected | None:
    """Return what the correction gave, or say why there is none."""
    if showing.loose:
        window.status = NOT_ADDED
    elif not showing.added:
        window.status = "No waypoint is added yet: stop the path, move w to the better way, and Enter adds it"
    else:
        window.status = "Correcting ..."
        window.paint()
        try:
            return correct(showing.waypoints)
        except KoopdqnError as error:
            window.status = f"Not corrected: {error}; u takes waypoints back"
    return None
