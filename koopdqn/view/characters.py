"""Small pictures in characters: paths in Braille dots, and a curve and a row of bars in block elements."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from rich.console import Console, ConsoleOptions, RenderResult
from rich.style import Style
from rich.text import Text

from koopdqn.paths import SmoothPath
from koopdqn.pose import Array

_BRAILLE: Final = 0x2800
# The bit of each of a character's dots, four rows of two (Unicode, Braille Patterns).
_BITS: Final = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_DOTS: Final = (4, 2)
_BLOCKS: Final = " ▁▂▃▄▅▆▇█"


@dataclass(frozen=True)
class Track:
    """What is drawn in one style.

    Attributes:
        points: (N, 2) to the right and up, in any one unit.
        style: of its characters; a later track's goes before an earlier one's.
        joined: whether the points are joined to a line.
    """

    points: Array
    style: Style
    joined: bool = True


@dataclass(frozen=True)
class Picture:
    """Tracks at one scale in whatever room there is.

    Attributes:
        frame: (F, 2) points that are inside the picture; what is outside is left out.
        tracks: in the order in which they are drawn.
        marks: letters, where they stand (2,), and their styles.
    """

    frame: Array
    tracks: Sequence[Track]
    marks: Sequence[tuple[str, Array, Style]] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the lines that fill the room."""
        yield from self.lines(options.max_width, options.height or options.max_height)

    def lines(self, width: int, rows: int) -> list[Text]:
        """Return the picture as ``rows`` lines of ``width`` characters."""
        low, high = self.frame.min(axis=0), self.frame.max(axis=0)
        size = np.array([_DOTS[1] * width - 1, _DOTS[0] * rows - 1])
        # A dot is as high as wide, so that both directions have one scale.
        scale = float((size / np.maximum(high - low, 1e-9)).min())
        corner = (low + high) / 2 - size / scale / 2
        dots = np.zeros((_DOTS[0] * rows, _DOTS[1] * width), dtype=bool)
        styles = np.full((rows, width), -1)

        def at(points: Array) -> tuple[np.ndarray, np.ndarray]:
            places = np.rint((points - corner) * scale).astype(int)
            right, up = places[((places >= 0) & (places <= size)).all(axis=1)].T
            return size[1] - up, right

        for number, track in enumerate(self.tracks):
            row, column = at(SmoothPath.along(track.points, 0.7 / scale).points if track.joined else track.points)
            dots[row, column] = True
            styles[row // _DOTS[0], column // _DOTS[1]] = number
        cells = dots.reshape(rows, _DOTS[0], width, _DOTS[1])
        codes = _BRAILLE + np.einsum("aibj,ij->ab", cells, _BITS)
        # Not every font has the empty one.
        letters = np.array([[" " if code == _BRAILLE else chr(code) for code in line] for line in codes.tolist()])
        shown = [track.style for track in self.tracks]
        for letter, place, style in self.marks:
            row, column = at(place[None])
            letters[row // _DOTS[0], column // _DOTS[1]] = letter
            styles[row // _DOTS[0], column // _DOTS[1]] = len(shown)
            shown.append(style)
        return [_line(line, style, shown) for line, style in zip(letters.tolist(), styles, strict=True)]


@dataclass(frozen=True)
class Curve:
    """Values as a curve of bars from the least to the greatest, in whatever room there is.

    Attributes:
        values: (N,) in order; where there is no room for all, each bar is the mean of its share of them.
        style: of the bars.
    """

    values: Array
    style: Style

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the lines that fill the room, the greatest and the least value written beside."""
        rows = options.height or options.max_height
        if not len(self.values):
            yield Text("nothing yet", Style(dim=True))
            return
        labels = [f"{value:.4g}" for value in (self.values.max(), self.values.min())]
        margin = max(map(len, labels)) + 1
        names = [labels[0], *[""] * (rows - 2), *labels[1:]][:rows]
        for name, line in zip(names, bars(self.values, options.max_width - margin, rows), strict=True):
            yield Text.assemble((name.rjust(margin - 1) + " ", Style(dim=True)), (line, self.style))


def bars(values: Array, width: int, rows: int = 1) -> list[str]:
    """Return values (N,) as ``rows`` lines of at most ``width`` bars, the least as low as can be seen."""
    if not len(values) or width < 1:
        return [""] * rows
    parts = np.array_split(values, min(width, len(values)))
    means = np.array([part.mean() for part in parts])
    spread = values.max() - values.min()
    share = (means - values.min()) / spread if spread > 0 else np.full(len(means), 0.5)
    eighths = 1 + np.rint(share * (8 * rows - 1)).astype(int)
    levels = np.clip(eighths[None] - 8 * np.arange(rows - 1, -1, -1)[:, None], 0, 8)
    return ["".join(_BLOCKS[level] for level in line) for line in levels.tolist()]


def _line(letters: list[str], styles: np.ndarray, shown: Sequence[Style]) -> Text:
    """Return characters as a line, those of one style that stand together as one piece."""
    begins = np.flatnonzero(np.diff(styles, prepend=styles[0] - 1))
    line = Text()
    for begin, end in zip(begins.tolist(), [*begins[1:].tolist(), len(letters)], strict=True):
        number = int(styles[begin])
        line.append("".join(letters[begin:end]), None if number < 0 else shown[number])
    return line
