"""A full screen of a terminal: what stands where on it, and the window that paints it, takes its keys and closes it."""

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from rich.console import Console
from rich.style import Style
from rich.text import Text

from koopdqn import console
from koopdqn.errors import WorkFailedError
from koopdqn.oracles.terminal.device import Device, Drawn, Graphics, choose_graphics

if TYPE_CHECKING:
    from koopdqn.oracles.terminal.picture import Picture, WorkcellCamera

_ASPECT: Final = (4, 3)
"""Width to height of the picture."""
GAP: Final = 2
TEXT_WIDTH: Final = 38
_LEAST_PICTURE: Final = (26, 6)
_FRAME_ROWS: Final = 5
"""Rows beside a picture's: the line at the top, the legend, two lines of keys and the line at the bottom."""
_MOST_STATUS: Final = 3
"""Lines at the bottom that tell what a key did."""

DIM: Final = Style(dim=True)
BOLD: Final = Style(bold=True)
GOAL: Final = Style(color="green", bold=True)
_HEAD: Final = Style(reverse=True, bold=True)


@dataclass(frozen=True)
class Region:
    """Where the picture goes.

    Attributes:
        width: in characters; 0 where there is no room.
        rows: in characters.
    """

    width: int
    rows: int


def region(width: int, height: int, *, pictures: bool) -> Region:
    """Return where the picture goes on a screen, beside the text; its sides are as 4 to 3 in pixels."""
    room, rows = width - TEXT_WIDTH - GAP, height - _FRAME_ROWS
    # A character is about twice as high as wide.
    across = min(room, rows * 2 * _ASPECT[0] // _ASPECT[1])
    down = across * _ASPECT[1] // (2 * _ASPECT[0])
    if not pictures or across < _LEAST_PICTURE[0] or down < _LEAST_PICTURE[1]:
        return Region(0, 0)
    return Region(across, down)


def framed(
    head: str,
    body: Callable[[int], list[Text]],
    keys: Sequence[str],
    help_lines: Sequence[str],
    status: list[Text],
    width: int,
    height: int,
) -> list[Text]:
    """Return a screen's ``height`` lines: a bar with the head, the body, what the keys do, and the status.

    ``body`` gives its lines for a number of rows, which they may exceed. Help, if there is any, stands in its place and
    that of the keys.
    """
    keys = [] if help_lines else _key_lines(keys, width, height)
    room = height - 1 - len(keys) - len(status)
    inside = _help_body(help_lines, width, room) if help_lines else body(room)
    inside = (inside + [Text("")] * room)[:room]
    lines = [Text(head[:width].ljust(width), style=_HEAD), *inside, *(Text(line, style=DIM) for line in keys)]
    for line in lines:
        line.truncate(width, overflow="crop")
    return [*lines, *status]


def _key_lines(keys: Sequence[str], width: int, height: int) -> list[str]:
    """Return lines that tell of keys, broken between two of them where they are too long; half a screen at most."""
    if all(len(line) <= width for line in keys):
        return list(keys)
    lines: list[str] = []
    for key in (each for line in keys for each in re.split(" {2,}", line)):
        if lines and len(lines[-1]) + 2 + len(key) <= width:
            lines[-1] += f"  {key}"
        else:
            lines.append(key)
    return lines[: height // 2]


def _help_body(lines: Sequence[str], width: int, room: int) -> list[Text]:
    """Return the help as lines of at most ``width`` characters, without empty ones where there is no room for them."""
    body = [part for line in lines for part in (wrapped(line, width) if line else [Text("")])]
    return body if len(body) <= room else [line for line in body if line]


def picture_lines(picture: Sequence[Text], legend: Sequence[Text], remark: str, place: Region) -> list[Text]:
    """Return what stands where a picture goes: its lines or room for it, and the legend; or the remark instead."""
    if not place.width:
        return []
    if remark:
        return [Text(""), *wrapped(remark, place.width, DIM)]
    return [*(picture or [Text("")] * place.rows), *legend]


def beside(left: list[Text], right: list[Text], width: int) -> list[Text]:
    """Return lines beside others, which begin behind ``width`` characters and a gap; 0 leaves the left ones out."""
    if not width:
        return right
    count = max(len(left), len(right))
    lines = []
    for row in range(count):
        first = left[row].copy() if row < len(left) else Text("")
        first.truncate(width, overflow="crop")
        first.pad_right(width - first.cell_len + GAP)
        lines.append(first + right[row] if row < len(right) else first)
    return lines


def wrapped(text: str, width: int, style: Style | None = None) -> list[Text]:
    """Return a text as lines of at most ``width`` characters."""
    return list(Text(text, style=style or Style()).wrap(Console(width=max(width, 1)), max(width, 1)))


def status_line(status: str, width: int) -> Text:
    """Return the line at the bottom."""
    # One short of the width: a character in the corner makes some terminals scroll.
    line = Text(status, style=BOLD)
    line.truncate(width - 1, overflow="ellipsis")
    return line


def status_lines(status: str, width: int) -> list[Text]:
    """Return what a key did, as a few lines at the bottom."""
    lines = wrapped(status, width - 1, BOLD)[:_MOST_STATUS] or [Text("")]
    for line in lines:
        line.truncate(width - 1, overflow="crop")
    return lines


PICTURE_SIZE: Final = {"blocks": (240, 180), "kitty": (480, 360), "sixel": (480, 360)}
"""Width and height of the pictures before they are fitted to the screen [pixels]."""
# A terminal that knows it shows a screen whole: no one sees it half drawn.
_BEGIN: Final = "\x1b[?2026h"
_END: Final = "\x1b[?2026l"
_KITTY_CLEAR: Final = "\x1b_Ga=d,q=2\x1b\\"
"""Takes kitty's pictures off the screen, which outlast the text."""

Drawer = TypeVar("Drawer", bound="WorkcellCamera")


class Window:
    """A screen of its own on the terminal, with text, a picture, a line at the bottom and a page of help.

    Attributes:
        device: the terminal.
        status: what the line at the bottom says.
        help: whether the help is shown instead of the rest.
        picture: what is drawn beside the text, if anything.
        remark: why nothing can be drawn, where something went wrong; the text then stands alone.
    """

    def __init__(self, graphics: Graphics, lines: Callable[[list[Text], int, int], list[Text]], status: str) -> None:
        """Prepare; ``lines`` gives the whole text from the lines of a picture made of characters, width and height."""
        self.device = Device(self.paint)
        self.status = status
        self.help = False
        self.picture: Picture | None = None
        self.remark = ""
        self._lines = lines
        self._camera: WorkcellCamera | None = None
        self._wanted = graphics
        self._graphics: Drawn = "none"
        self._size = (0, 0)

    def open(self) -> None:
        """Show the screen and find out how pictures can be drawn on it."""
        self.device.enter()
        self._graphics = choose_graphics(self._wanted, self.device)
        self._size = self.device.size()
        self.paint()

    def start(self, camera: Callable[[tuple[int, int]], Drawer]) -> Drawer | None:
        """Return the camera, given what makes one for pictures of a size (width, height) [pixels]; None without any."""
        if self._graphics == "none":
            return None
        try:
            started = camera(PICTURE_SIZE[self._graphics])
        except WorkFailedError as error:
            self.remark = f"No picture: {error}"
            self.paint()
            return None
        self._camera = started
        return started

    def close(self) -> None:
        """Free the camera and restore the terminal."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        if self._graphics == "kitty" and self.device.entered:
            self.device.write(_KITTY_CLEAR)
        self.device.leave()

    @property
    def pictures(self) -> bool:
        """Whether there is room for a picture on the screen as large as it is now."""
        return self._place().width > 0

    def keys(self, seconds: float = 0.1) -> list[str]:
        """Return the keys pressed, waiting at most ``seconds`` for one; a screen of another size is painted anew."""
        keys = self.device.keys(seconds)
        before, self._size = self._size, self.device.size()
        if self._size != before:
            self.paint()
        return keys

    def helps(self, key: str) -> bool:
        """Return whether a key is the help's: ? shows it, and any key then goes back."""
        if self.help or key == "?":
            self.help = not self.help
            return True
        return False

    def say(self, status: str) -> None:
        """Put only the line at the bottom on the terminal."""
        self.status = status
        width, height = self.device.size()
        self.device.write(self._encoded([status_line(status, width)], width, top=height))

    def paint(self) -> None:
        """Put the whole screen on the terminal: a line a row, and over them the picture where it is made of pixels."""
        width, height = self.device.size()
        place = self._place()
        picture = self.picture if place.width and not self.help else None
        drawn, pixels = ([], "") if picture is None else self._drawn(picture, place)
        text = self._encoded(self._lines(drawn, width, height), width)
        clear = _KITTY_CLEAR if self._graphics == "kitty" else ""
        self.device.write(f"{_BEGIN}{clear}{text}{pixels}{_END}")

    def _place(self) -> Region:
        return region(*self.device.size(), pictures=self._graphics != "none")

    def _drawn(self, picture: "Picture", place: Region) -> tuple[list[Text], str]:
        """Return a picture as lines of characters, or else as what draws its pixels."""
        # Loads MuJoCo, which those that want words only do without.
        from koopdqn.oracles.terminal.picture import block_lines, kitty, lettered, resized, sixel

        if self._graphics == "blocks":
            colours = console.err()
            plain = colours.no_color or colours.color_system is None or not colours.encoding.startswith("utf")
            return block_lines(picture.image, place.width, place.rows, picture.marks, colour=not plain), ""
        at = "\x1b[2;1H"
        if self._graphics == "kitty":
            return [], at + kitty(lettered(picture.image, picture.marks), place.width, place.rows)
        across, down = self.device.cell()
        fitted = resized(picture.image, place.width * across, place.rows * down)
        return [], at + sixel(lettered(fitted, picture.marks))

    def _encoded(self, lines: Sequence[Text], width: int, top: int = 1) -> str:
        """Return lines as what the terminal reads, each at its row and the rest of the row empty."""
        real = console.err()
        buffer = io.StringIO()
        shown = console.LiteralConsole(
            file=buffer,
            force_terminal=True,
            color_system=real.color_system or "standard",
            no_color=real.no_color,
            width=width,
            legacy_windows=False,
        )
        for row, line in enumerate(lines, start=top):
            buffer.write(f"\x1b[{row};1H")
            shown.print(line, end="", no_wrap=True, crop=False, overflow="ignore")
            buffer.write("\x1b[0m\x1b[K")
        return buffer.getvalue()
