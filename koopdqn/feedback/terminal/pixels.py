"""Pictures out of pixels: the escape sequences of kitty's and of sixel graphics."""

import base64
import io
from typing import Final

import numpy as np

from koopdqn.robot.camera import Image

_KITTY_CHUNK: Final = 4096
_SIXEL_COLOURS: Final = 128
_BAND: Final = 6
"""Rows of pixels in one line of sixels."""
KITTY_CLEAR: Final = "\x1b_Ga=d,q=2\x1b\\"
"""Takes kitty's pictures off the screen, which outlast the text."""


def png(image: Image) -> bytes:
    """Return a picture (height, width, 3) as a PNG file's bytes."""
    from PIL import Image as Pictures

    buffer = io.BytesIO()
    Pictures.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def kitty(image: Image, width: int, rows: int) -> str:
    """Return the sequence that draws a picture at the cursor, scaled to ``width`` by ``rows`` characters.

    Source: the terminal graphics protocol of kitty; the terminal is asked to answer nothing (q=2).
    """
    data = base64.standard_b64encode(png(image)).decode()
    chunks = [data[start : start + _KITTY_CHUNK] for start in range(0, len(data), _KITTY_CHUNK)]
    parts = []
    for number, chunk in enumerate(chunks):
        more = int(number + 1 < len(chunks))
        control = f"a=T,f=100,c={width},r={rows},C=1,q=2,m={more}" if number == 0 else f"q=2,m={more}"
        parts.append(f"\x1b_G{control};{chunk}\x1b\\")
    return "".join(parts)


def sixel(image: Image) -> str:
    """Return the sequence that draws a picture at the cursor, a pixel a pixel.

    Source: DEC's sixel graphics, as the VT340 manual gives them.
    """
    from PIL import Image as Pictures

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
