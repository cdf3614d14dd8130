import base64
import io
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from koopdqn.errors import BadInputError
from koopdqn.oracles.terminal.device import check_graphics, choose_graphics
from koopdqn.oracles.terminal.picture import block_lines, kitty, lettered, png, sixel

PLAIN = {"TERM": "xterm-256color"}
TMUX = {"TERM": "tmux-256color", "TMUX": "/tmp/tmux-0/default,1,0"}


def picture(seed: int, height: int, width: int, colours: int = 256) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    palette = rng.integers(0, 256, (colours, 3), dtype=np.uint8)
    return palette[rng.integers(0, colours, (height, width))]


class Terminal:
    """Answers queries as a terminal of some kind does."""

    def __init__(self, answer: str) -> None:
        self.answer = answer
        self.asked = ""

    def ask(self, query: str, end: str, seconds: float) -> str:
        self.asked += query
        return self.answer


@pytest.mark.parametrize(
    ("answer", "environment", "drawn"),
    [
        ("\x1b_Gi=31;OK\x1b\\\x1b[?62;c", PLAIN, "kitty"),
        ("\x1b[?62;4;22c", PLAIN, "sixel"),
        ("\x1b[?1;2c", PLAIN, "blocks"),
        ("\x1b[?64;14;24c", PLAIN, "blocks"),
        ("", PLAIN, "blocks"),
        ("\x1b[?1;2;4c", TMUX, "sixel"),
        ("\x1b[?1;2c", TMUX, "blocks"),
    ],
)
def test_auto_takes_what_the_terminal_says_it_knows(answer: str, environment: dict[str, str], drawn: str) -> None:
    terminal = Terminal(answer)
    assert choose_graphics("auto", terminal, environment) == drawn  # type: ignore[arg-type]  # a stand-in
    assert ("_G" in terminal.asked) == (environment is PLAIN), "tmux would take it for a title"


def test_a_choice_is_kept_without_asking() -> None:
    for wanted in ("blocks", "kitty", "sixel", "none"):
        terminal = Terminal("\x1b[?62;4c")
        assert choose_graphics(wanted, terminal, PLAIN) == wanted  # type: ignore[arg-type]
        assert not terminal.asked


def test_kitty_is_refused_where_it_cannot_be_right() -> None:
    with pytest.raises(BadInputError, match="inside tmux"):
        check_graphics("kitty", "oracle.graphics", TMUX)
    check_graphics("kitty", "oracle.graphics", PLAIN)
    check_graphics("sixel", "oracle.graphics", TMUX)


@settings(max_examples=15)
@given(seed=st.integers(0, 99), height=st.integers(1, 60), width=st.integers(1, 60))
def test_kitty_carries_the_picture_unchanged(seed: int, height: int, width: int) -> None:
    image = picture(seed, height, width)
    parts = re.findall(r"\x1b_G([^;]*);([^\x1b]*)\x1b\\", kitty(image, 10, 5))
    assert all(len(data) <= 4096 for _, data in parts)
    assert [("m=1" in control) for control, _ in parts] == [True] * (len(parts) - 1) + [False]
    data = base64.standard_b64decode("".join(data for _, data in parts))
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(data))), image)
    assert data == png(image)


def decoded(text: str) -> NDArray[np.uint8]:
    """Return the picture that a sequence of sixels draws."""
    body = text.removesuffix("\x1b\\").partition("q")[2]
    width, height = (int(size) for size in re.match(r'"1;1;(\d+);(\d+)', body).groups())  # type: ignore[union-attr]
    image = np.zeros((height + 6, width, 3), dtype=np.uint8)
    palette: dict[int, NDArray[np.float64]] = {}
    colour = x = top = 0
    for token in re.findall(r"#\d+;2;\d+;\d+;\d+|#\d+|!\d+[?-~]|[?-~]|\$|-", body.partition(str(height))[2]):
        if token.startswith("#"):
            numbers = [int(number) for number in token[1:].split(";")]
            colour = numbers[0]
            if len(numbers) > 1:
                palette[colour] = np.rint(np.array(numbers[2:]) * 2.55)
        elif token == "$":
            x = 0
        elif token == "-":
            x, top = 0, top + 6
        else:
            count, bits = (int(token[1:-1]), ord(token[-1]) - 63) if token[0] == "!" else (1, ord(token) - 63)
            for bit in range(6):
                if bits >> bit & 1:
                    image[top + bit, x : x + count] = palette[colour]
            x += count
    return image[:height]


@settings(max_examples=15)
@given(seed=st.integers(0, 99), height=st.integers(1, 20), width=st.integers(1, 30))
def test_sixels_draw_the_picture_to_the_nearest_percent(seed: int, height: int, width: int) -> None:
    image = picture(seed, height, width, colours=8)
    assert np.abs(decoded(sixel(image)).astype(int) - image).max() <= 3


def test_letters_stand_beside_what_they_mark_and_nowhere_else() -> None:
    image = np.full((180, 240, 3), 90, dtype=np.uint8)
    drawn = lettered(image, {"b": (0.25, 0.5), "x": (1.2, 0.5)})
    changed = np.argwhere((drawn != image).any(axis=2))
    assert len(changed) > 20
    assert np.abs(changed - [90, 60]).max() <= 20
    assert np.abs(lettered(image, {}, "b before").astype(int) - image)[150:].any()
    np.testing.assert_array_equal(lettered(image, {}), image)


def test_half_blocks_hold_two_pixels_each() -> None:
    image = picture(0, 8, 6) // 8 * 8
    lines = block_lines(image, 6, 4, {"g": (0.5, 0.5)}, colour=True)
    for row, line in enumerate(lines):
        assert len(line) == 6
        for span in line.spans:
            column = span.start
            if line.plain[column] != "▀":
                assert (row, column) == (2, 3)
                continue
            style = span.style
            assert tuple(style.color.triplet) == tuple(image[2 * row, column])  # type: ignore[union-attr, arg-type]  # every half block has both
            assert tuple(style.bgcolor.triplet) == tuple(image[2 * row + 1, column])  # type: ignore[union-attr, arg-type]  # every half block has both


def test_marks_at_one_place_stand_beside_one_another() -> None:
    at = dict.fromkeys("mbr", (0.3, 0.5))
    image = np.full((200, 300, 3), 128, np.uint8)
    first = block_lines(image, 10, 1, at, colour=False)[0].plain
    assert first == "   mbr    "
    drawn = {mark: lettered(image, {mark: at[mark]}) != image for mark in at}
    both = lettered(image, at) != image
    assert both.any(axis=2).sum() > 0.95 * sum(one.any(axis=2).sum() for one in drawn.values())


def test_shades_grow_with_the_light_and_need_no_colour() -> None:
    ramp = np.repeat(np.linspace(0, 255, 10).astype(np.uint8)[None, :, None], 2, axis=0).repeat(3, axis=2)
    (line,) = block_lines(ramp, 10, 1, {}, colour=False)
    assert line.plain == " .:-=+*#%@"
    assert not line.spans
    flat = np.full((4, 4, 3), 7, dtype=np.uint8)
    assert [line.plain for line in block_lines(flat, 4, 2, {}, colour=False)] == ["    "] * 2
