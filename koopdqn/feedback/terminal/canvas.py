"""The canvas: puts lines of text and a picture on the terminal, in the colours and pixels that it has."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rich.console import Console
from rich.text import Text

from koopdqn import console
from koopdqn.feedback.terminal.blocks import block_lines, resized
from koopdqn.feedback.terminal.device import Device
from koopdqn.feedback.terminal.graphics import Drawn
from koopdqn.feedback.terminal.pixels import KITTY_CLEAR, kitty, sixel
from koopdqn.feedback.terminal.screen import Region
from koopdqn.robot.camera import Image

PICTURE_SIZE: Final = {"blocks": (240, 180), "kitty": (480, 360), "sixel": (480, 360)}
"""Width and height of the pictures before they are fitted to the screen [pixels]."""
# A terminal that knows it shows a screen whole: no one sees it half drawn.
_BEGIN: Final = "\x1b[?2026h"
_END: Final = "\x1b[?2026l"


@dataclass(frozen=True)
class Picture:
    """A picture and where it goes.

    Attributes:
        image: (height, width, 3).
        marks: characters put on it where it is made of characters, each at its share (0…1) of width and height.
        place: the region of the screen.
    """

    image: Image
    marks: Mapping[str, tuple[float, float]]
    place: Region


class Canvas:
    """A terminal's screen to draw on."""

    def __init__(self, device: Device, graphics: Drawn) -> None:
        """Draw on a device in the given way."""
        self._device = device
        self.graphics = graphics

    def block_lines(self, picture: Picture | None) -> list[Text]:
        """Return the picture's lines of characters; none without one, or where it is drawn in pixels."""
        if picture is None or self.graphics != "blocks":
            return []
        colours = console.err()
        plain = colours.no_color or colours.color_system is None or not colours.encoding.startswith("utf")
        place = picture.place
        return block_lines(picture.image, place.width, place.rows, dict(picture.marks), colour=not plain)

    def put(self, lines: Sequence[Text], picture: Picture | None) -> None:
        """Put a whole screen on the terminal: a line a row, and over them the picture where it is made of pixels."""
        width, _ = self._device.size()
        text = self._encoded(lines, width)
        if picture is not None:
            text += self._pixels(picture)
        clear = KITTY_CLEAR if self.graphics == "kitty" else ""
        self._device.write(f"{_BEGIN}{clear}{text}{_END}")

    def put_line(self, line: Text, row: int) -> None:
        """Put only one line, at a row counted from 1, on the terminal."""
        width, _ = self._device.size()
        self._device.write(self._encoded([line], width, top=row))

    def clear(self) -> None:
        """Take pictures off the screen."""
        if self.graphics == "kitty" and self._device.entered:
            self._device.write(KITTY_CLEAR)

    def _pixels(self, picture: Picture) -> str:
        place = picture.place
        at = f"\x1b[{place.top + 1};{place.left + 1}H"
        if self.graphics == "kitty":
            return at + kitty(picture.image, place.width, place.rows)
        if self.graphics == "sixel":
            across, down = self._device.cell()
            return at + sixel(resized(picture.image, place.width * across, place.rows * down))
        return ""

    def _encoded(self, lines: Sequence[Text], width: int, top: int = 1) -> str:
        """Return lines as what the terminal reads, each at its row and the rest of the row empty."""
        real = console.err()
        buffer = io.StringIO()
        shown = Console(
            file=buffer,
            force_terminal=True,
            color_system=real.color_system or "standard",  # type: ignore[arg-type]  # Rich names it by a plain str
            no_color=real.no_color,
            width=width,
            legacy_windows=False,
        )
        for row, line in enumerate(lines, start=top):
            buffer.write(f"\x1b[{row};1H")
            shown.print(line, end="", no_wrap=True, crop=False, overflow="ignore")
            buffer.write("\x1b[0m\x1b[K")
        return buffer.getvalue()
