"""Pictures in characters: where dots go, and how high bars are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.style import Style

from koopdqn.view.characters import Picture, Track, bars

PLAIN, OTHER = Style(), Style(bold=True)
SQUARE = np.array([[0.0, 0.0], [1.0, 1.0]])


def drawn(picture: Picture, width: int, rows: int) -> np.ndarray:
    """Return a picture's dots (4 rows, 2 width), the lowest first."""
    bits = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
    codes = [
        [0 if letter == " " else ord(letter) - 0x2800 for letter in line.plain] for line in picture.lines(width, rows)
    ]
    cells = (np.array(codes)[:, None, :, None] & bits[None, :, None, :]) > 0
    return np.asarray(cells.reshape(4 * rows, 2 * width)[::-1])


@given(place=st.tuples(st.floats(0, 1), st.floats(0, 1)))
def test_a_point_is_drawn_where_it_is(place: tuple[float, float]) -> None:
    picture = Picture(SQUARE, [Track(np.array([place]), PLAIN, joined=False)])
    dots = drawn(picture, 12, 6)
    assert dots.sum() == 1
    found = np.argwhere(dots)[0][::-1]
    assert np.abs(found - np.array(place) * 23).max() <= 0.5 + 1e-9


def test_both_directions_have_one_scale_and_the_frame_is_in_the_middle() -> None:
    picture = Picture(SQUARE, [Track(SQUARE, PLAIN)])
    dots = drawn(picture, 30, 6)
    places = np.argwhere(dots)
    assert np.ptp(places[:, 0]) == np.ptp(places[:, 1]) == 23
    assert places[:, 1].mean() == pytest.approx(29.5, abs=0.6)


def test_a_line_has_no_gap_and_what_is_outside_is_left_out() -> None:
    line = np.array([[-5.0, 0.5], [5.0, 0.5]])
    dots = drawn(Picture(SQUARE, [Track(line, PLAIN)]), 12, 6)
    assert dots.any(axis=1).sum() == 1
    assert dots.any(axis=0).all()


def test_the_later_track_and_the_mark_stand_before() -> None:
    tracks = [Track(SQUARE, PLAIN), Track(SQUARE[:1], OTHER, joined=False)]
    lines = Picture(SQUARE, tracks, [("g", SQUARE[1], OTHER)]).lines(4, 2)
    assert lines[0].plain[-1] == "g"
    assert next(span.style for span in lines[1].spans) == OTHER


@given(
    values=arrays(float, st.integers(1, 40), elements=st.floats(-1e6, 1e6)),
    width=st.integers(1, 30),
    rows=st.integers(1, 5),
)
def test_bars_are_as_high_as_their_values(values: np.ndarray, width: int, rows: int) -> None:
    lines = bars(values, width, rows)
    assert len(lines) == rows
    heights = np.sum([[" ▁▂▃▄▅▆▇█".index(letter) for letter in line] for line in lines], axis=0)
    assert len(heights) == min(width, len(values))
    assert heights.min() >= 1
    means = np.array([part.mean() for part in np.array_split(values, len(heights))])
    assert (np.diff(heights[np.argsort(means, kind="stable")]) >= 0).all()


def test_no_values_are_no_bars() -> None:
    assert bars(np.zeros(0), 10, 2) == ["", ""]
