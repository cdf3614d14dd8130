"""The painter: puts the screen's lines and its picture on the terminal, in the colours that it has."""

import io
from dataclasses import replace
from typing import Final

from rich.console import Console
from rich.text import Text

from koopdqn import console
from koopdqn.errors import WorkFailedError
from koopdqn.feedback.oracle import Question
from koopdqn.feedback.situation import Situation, SituationCamera
from koopdqn.feedback.terminal.blocks import block_lines, resized
from koopdqn.feedback.terminal.device import Device
from koopdqn.feedback.terminal.graphics import Drawn
from koopdqn.feedback.terminal.pixels import KITTY_CLEAR, kitty, sixel
from koopdqn.feedback.terminal.screen import Region, Shown, compose, region, status_line
from koopdqn.workcell import Workcell

_SIZE: Final = {"blocks": (240, 180), "kitty": (480, 360), "sixel": (480, 360)}
"""Width and height of the pictures before they are fitted to the screen [pixels]."""
# A terminal that knows it shows a screen whole: no one sees it half drawn.
_BEGIN: Final = "\x1b[?2026h"
_END: Final = "\x1b[?2026l"


class Painter:
    """Paints screens on a terminal. Close it."""

    def __init__(self, device: Device, workcell: Workcell, graphics: Drawn) -> None:
        """Prepare for questions about a workcell; where pictures cannot be drawn, text stands alone and says why."""
        self._device = device
        self._graphics = graphics
        self._camera: SituationCamera | None = None
        self.remark = ""
        if graphics != "none":
            try:
                self._camera = SituationCamera(workcell, _SIZE[graphics])
            except WorkFailedError as error:
                self.remark = f"No picture: {error}"

    @property
    def pictures(self) -> bool:
        """Whether the screen keeps room for a picture."""
        return self._graphics != "none"

    def situation(self, question: Question, share: float = 1.0) -> Situation | None:
        """Return the picture of a question, the arm having gone ``share`` of its motion; None without pictures."""
        return None if self._camera is None else self._camera.picture(question, share)

    def paint(self, shown: Shown, situation: Situation | None) -> None:
        """Put a whole screen on the terminal."""
        width, height = self._device.size()
        place = region(width, height, pictures=self.pictures)
        fits = situation is not None and place.width > 0 and not shown.help
        lines: list[Text] = []
        if situation is not None and fits and self._graphics == "blocks":
            lines = self._blocks(situation, place)
        times = situation.times if situation is not None and fits else 0.0
        content = replace(shown, picture=lines, times=times, remark=self.remark)
        text = self._encoded(compose(content, width, height, pictures=self.pictures), width)
        if situation is not None and fits:
            text += self._pixels(situation, place)
        clear = KITTY_CLEAR if self._graphics == "kitty" else ""
        self._device.write(f"{_BEGIN}{clear}{text}{_END}")

    def paint_status(self, status: str) -> None:
        """Put only the line at the bottom on the terminal."""
        width, height = self._device.size()
        line = self._encoded([status_line(status, width)], width, top=height)
        self._device.write(line)

    def close(self) -> None:
        """Free the camera and take pictures off the screen."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        if self._graphics == "kitty" and self._device.entered:
            self._device.write(KITTY_CLEAR)

    def _blocks(self, situation: Situation, place: Region) -> list[Text]:
        colours = console.err()
        plain = colours.no_color or colours.color_system is None or not colours.encoding.startswith("utf")
        return block_lines(situation.image, place.width, place.rows, situation.marks, colour=not plain)

    def _pixels(self, situation: Situation, place: Region) -> str:
        at = f"\x1b[{place.top + 1};{place.left + 1}H"
        if self._graphics == "kitty":
            return at + kitty(situation.image, place.width, place.rows)
        if self._graphics == "sixel":
            across, down = self._device.cell()
            return at + sixel(resized(situation.image, place.width * across, place.rows * down))
        return ""

    def _encoded(self, lines: list[Text], width: int, top: int = 1) -> str:
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
