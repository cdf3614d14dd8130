"""Screens on a terminal: lines of text, and a picture in characters, in kitty's protocol or in sixels."""

import base64
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Generic, TypeVar

import numpy as np
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont
from rich.color import Color
from rich.style import Style
from rich.text import Text

from koopdqn import console
from koopdqn.errors import WorkFailedError
from koopdqn.oracles.terminal.device import Device, Drawn, Graphics, choose_graphics
from koopdqn.oracles.terminal.picture import WorkcellCamera
from koopdqn.oracles.terminal.screen import Region, region
from koopdqn.robot.render import Image

_UPPER_HALF: Final = "▀"
_SHADES: Final = " .:-=+*#%@"
_LUMINANCE: Final = (0.2126, 0.7152, 0.0722)
# Fewer colours, so that a picture holds fewer different characters; the eye does not see it at this size.
_COLOUR_STEP: Final = 8
_LETTERS: Final = 20
"""Letters one above the other in the height of a picture."""
_LETTER_COLOURS: Final = {"r": (255, 220, 60), "m": (90, 230, 255), "g": (80, 240, 130)}
_WHITE: Final = (255, 255, 255)
_MARK_COLOURS: Final = {"r": "bright_yellow", "m": "bright_cyan", "g": "bright_green"}


def resized(image: Image, width: int, height: int) -> Image:
    """Return a picture (height, width, 3) whose every pixel is the mean of those it stands for."""
    return np.asarray(Pictures.fromarray(image).resize((width, height), Pictures.Resampling.BOX))


def lettered(image: Image, marks: Mapping[str, tuple[float, float]], caption: str = "") -> Image:
    """Return a picture (height, width, 3) with marks on it, each at its share (0…1) of width and height.

    A caption stands in its lower left corner.
    """
    height, width, _ = image.shape
    drawn = Pictures.fromarray(image)
    pen = ImageDraw.Draw(drawn)
    size = height / _LETTERS
    font = ImageFont.load_default(size)
    edge = {"font": font, "stroke_width": max(1, round(size / 10)), "stroke_fill": (0, 0, 0)}
    for mark, (x, y) in marks.items():
        if 0 <= x < 1 and 0 <= y < 1:
            # Beside the dot, which it would hide.
            pen.text((x * width + 0.5 * size, y * height), mark, _LETTER_COLOURS.get(mark, _WHITE), anchor="lm", **edge)
    small = {**edge, "font": ImageFont.load_default(0.6 * size)}
    pen.text((0.5 * size, height - 0.5 * size), caption, _WHITE, anchor="lb", **small)
    return np.asarray(drawn)


def block_lines(
    image: Image, width: int, rows: int, marks: Mapping[str, tuple[float, float]], *, colour: bool
) -> list[Text]:
    """Return a picture (height, width, 3) as ``rows`` lines of ``width`` characters.

    Half blocks in colour, or else shades of brightness; over them marks, each at its share (0…1) of width and height.
    """
    small = resized(image, width, 2 * rows)
    lines = _in_colour(small) if colour else _in_shades(small)
    places = {(int(y * rows), int(x * width)): mark for mark, (x, y) in marks.items() if 0 <= x < 1 and 0 <= y < 1}
    for (row, column), mark in places.items():
        line = lines[row]
        style = Style(bold=True, color=_MARK_COLOURS.get(mark, "bright_white"), bgcolor="black")
        lines[row] = Text.assemble(line[:column], (mark, style), line[column + 1 :])
    return lines


def _in_colour(small: Image) -> list[Text]:
    coarse = (small // _COLOUR_STEP * _COLOUR_STEP).tolist()
    return [
        Text.assemble(*((_UPPER_HALF, _style(*top, *bottom)) for top, bottom in zip(upper, lower, strict=True)))
        for upper, lower in zip(coarse[::2], coarse[1::2], strict=True)
    ]


@lru_cache(maxsize=65536)
def _style(red: int, green: int, blue: int, red_below: int, green_below: int, blue_below: int) -> Style:
    return Style(color=Color.from_rgb(red, green, blue), bgcolor=Color.from_rgb(red_below, green_below, blue_below))


def _in_shades(small: Image) -> list[Text]:
    light = (small @ np.array(_LUMINANCE) / 255).reshape(-1, 2, small.shape[1]).mean(axis=1)
    # The whole range of shades for the range of light there is.
    low, high = light.min(), light.max()
    levels = np.zeros_like(light) if high == low else (light - low) / (high - low)
    shades = np.minimum((levels * len(_SHADES)).astype(int), len(_SHADES) - 1)
    return [Text("".join(_SHADES[level] for level in row)) for row in shades.tolist()]


_KITTY_CHUNK: Final = 4096
_SIXEL_COLOURS: Final = 128
_BAND: Final = 6
"""Rows of pixels in one line of sixels."""
KITTY_CLEAR: Final = "\x1b_Ga=d,q=2\x1b\\"
"""Takes kitty's pictures off the screen, which outlast the text."""


def png(image: Image) -> bytes:
    """Return a picture (height, width, 3) as a PNG file's bytes."""
    buffer = io.BytesIO()
    Pictures.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def kitty(image: Image, width: int, rows: int) -> str:
    """Return the sequence that draws a picture at the cursor in kitty's protocol, ``width`` by ``rows`` characters."""
    data = base64.standard_b64encode(png(image)).decode()
    chunks = [data[start : start + _KITTY_CHUNK] for start in range(0, len(data), _KITTY_CHUNK)]
    parts = []
    for number, chunk in enumerate(chunks):
        more = int(number + 1 < len(chunks))
        control = f"a=T,f=100,c={width},r={rows},C=1,q=2,m={more}" if number == 0 else f"q=2,m={more}"
        parts.append(f"\x1b_G{control};{chunk}\x1b\\")
    return "".join(parts)


def sixel(image: Image) -> str:
    """Return the sequence that draws a picture at the cursor in DEC's sixels (VT340 manual), a pixel a pixel."""
    height, width, _ = image.shape
    coded = Pictures.fromarray(image).quantize(_SIXEL_COLOURS)
    flat = np.array(coded.getpalette() or [], dtype=int).reshape(-1, 3)
    index = np.asarray(coded)
    used = np.unique(index)
    parts = [f'\x1bP0;1q"1;1;{width};{height}']
    parts += ["#{};2;{};{};{}".format(colour, *np.rint(flat[colour] / 2.55).astype(int)) for colour in used]
    for top in range(0, height, _BAND):
        band = index[top : top + _BAND]
        weights = (1 << np.arange(len(band)))[:, None]
        lines = []
        for colour in np.unique(band):
            bits = ((band == colour) * weights).sum(axis=0)
            lines.append(f"#{colour}{_run_lengths(bits)}")
        parts.append("$".join(lines) + "-")
    return "".join(parts) + "\x1b\\"


def _run_lengths(bits: np.ndarray) -> str:
    starts = np.flatnonzero(np.diff(bits, prepend=-1))
    lengths = np.diff(np.append(starts, len(bits)))
    text = ""
    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        character = chr(63 + int(bits[start]))
        text += character * length if length < 4 else f"!{length}{character}"
    return text


PICTURE_SIZE: Final = {"blocks": (240, 180), "kitty": (480, 360), "sixel": (480, 360)}
"""Width and height of the pictures before they are fitted to the screen [pixels]."""
# A terminal that knows it shows a screen whole: no one sees it half drawn.
_BEGIN: Final = "\x1b[?2026h"
_END: Final = "\x1b[?2026l"


@dataclass(frozen=True)
class Picture:
    """A picture (height, width, 3), characters to put on it at shares (0…1) of width and height, and its place."""

    image: Image
    marks: Mapping[str, tuple[float, float]]
    place: Region


Drawer = TypeVar("Drawer", bound=WorkcellCamera)


class Window(Generic[Drawer]):
    """A screen of its own on the terminal, with text and a picture.

    Attributes:
        device: the terminal.
        camera: draws the pictures, from `start` on; None where there are none.
        remark: why there are none, where something went wrong; the text then stands alone.
    """

    def __init__(self, graphics: Graphics, repaint: Callable[[], None]) -> None:
        """Prepare; ``repaint`` is called when the process comes back after Ctrl-Z."""
        self.device = Device(repaint)
        self.camera: Drawer | None = None
        self.remark = ""
        self._wanted = graphics
        self._graphics: Drawn = "none"
        self._size = (0, 0)

    def open(self) -> None:
        """Show the screen and find out how pictures can be drawn on it."""
        self.device.enter()
        self._graphics = choose_graphics(self._wanted, self.device)
        self._size = self.device.size()

    def start(self, camera: Callable[[tuple[int, int]], Drawer]) -> None:
        """Make the camera, given what makes one for pictures of a size (width, height) [pixels]."""
        if self._graphics != "none":
            try:
                self.camera = camera(PICTURE_SIZE[self._graphics])
            except WorkFailedError as error:
                self.remark = f"No picture: {error}"

    def resized(self) -> bool:
        """Return whether the screen has another size than when this was last asked."""
        before, self._size = self._size, self.device.size()
        return self._size != before

    @property
    def pictures(self) -> bool:
        """Whether the screen keeps room for a picture."""
        return self._graphics != "none"

    def place(self) -> Region:
        """Return where the picture goes on the screen as large as it is now."""
        return region(*self.device.size(), pictures=self.pictures)

    def paint(self, lines_with: Callable[[list[Text], int, int], list[Text]], picture: Picture | None) -> None:
        """Put a whole screen on the terminal: a line a row, and over them the picture where it is made of pixels.

        ``lines_with`` gives the lines from those of a picture made of characters, width and height. A picture for
        another place, as before a change of size, is left out.
        """
        width, height = self.device.size()
        if picture is not None and (not picture.place.width or picture.place != self.place()):
            picture = None
        text = self._encoded(lines_with(self._block_lines(picture), width, height), width)
        if picture is not None:
            text += self._pixels(picture)
        clear = KITTY_CLEAR if self._graphics == "kitty" else ""
        self.device.write(f"{_BEGIN}{clear}{text}{_END}")

    def paint_line(self, line: Text) -> None:
        """Put only the line at the bottom on the terminal."""
        width, height = self.device.size()
        self.device.write(self._encoded([line], width, top=height))

    def close(self) -> None:
        """Free the camera and restore the terminal."""
        if self.camera is not None:
            self.camera.close()
            self.camera = None
        if self._graphics == "kitty" and self.device.entered:
            self.device.write(KITTY_CLEAR)
        self.device.leave()

    def _block_lines(self, picture: Picture | None) -> list[Text]:
        if picture is None or self._graphics != "blocks":
            return []
        colours = console.err()
        plain = colours.no_color or colours.color_system is None or not colours.encoding.startswith("utf")
        place = picture.place
        return block_lines(picture.image, place.width, place.rows, picture.marks, colour=not plain)

    def _pixels(self, picture: Picture) -> str:
        place = picture.place
        at = f"\x1b[{place.top + 1};{place.left + 1}H"
        if self._graphics == "kitty":
            return at + kitty(lettered(picture.image, picture.marks), place.width, place.rows)
        if self._graphics == "sixel":
            across, down = self.device.cell()
            fitted = resized(picture.image, place.width * across, place.rows * down)
            return at + sixel(lettered(fitted, picture.marks))
        return ""

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
