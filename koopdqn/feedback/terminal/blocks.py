"""Pictures out of characters: two pixels in each, or shades where there is no colour."""

from functools import lru_cache
from typing import Final

import numpy as np
from rich.color import Color
from rich.style import Style
from rich.text import Text

from koopdqn.robot.camera import Image

_UPPER_HALF: Final = "▀"
_SHADES: Final = " .:-=+*#%@"
_LUMINANCE: Final = (0.2126, 0.7152, 0.0722)
# Fewer colours, so that a picture holds fewer different characters; the eye does not see it at this size.
_COLOUR_STEP: Final = 8
_MARK_COLOURS: Final = {"r": "bright_yellow", "m": "bright_cyan", "g": "bright_green"}


def resized(image: Image, width: int, height: int) -> Image:
    """Return a picture (height, width, 3) whose every pixel is the mean of those it stands for."""
    from PIL import Image as Pictures

    return np.asarray(Pictures.fromarray(image).resize((width, height), Pictures.Resampling.BOX))


def block_lines(
    image: Image, width: int, rows: int, marks: dict[str, tuple[float, float]], *, colour: bool
) -> list[Text]:
    """Return a picture as lines of characters.

    Args:
        image: (height, width, 3).
        width: characters in a line.
        rows: number of lines.
        marks: characters put on the picture, each at its share (0…1) of width and height.
        colour: half blocks in colour; else shades of brightness.
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
