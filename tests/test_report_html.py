import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from koopdqn.report.blocks import Cell, Figure, Missing, Panel, Section, Table
from koopdqn.report.page import page

VOID = {"meta", "img"}


class Reader(HTMLParser):
    """Reads a page and checks that every element is closed where it should be."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.links: list[str] = []
        self.images: list[str] = []
        self.names: set[str] = set()
        self.text = ""
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.names.add(tag)
        if tag not in VOID:
            self.open.append(tag)
        for name, value in attributes:
            {"id": self.ids, "href": self.links, "src": self.images}.get(name, []).append(value or "")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1:] != ["style"]:
            self.text += data


def panel(folder: Path, name: str) -> Panel:
    path = folder / name
    Image.fromarray(np.zeros((2, 3, 3), dtype=np.uint8)).save(path)
    return Panel(path, "a <picture>")


def test_a_page_holds_everything_it_shows(tmp_path: Path) -> None:
    sources = (tmp_path / "runs" / "a b" / "train.json", tmp_path / "runs" / "c" / "train.json")
    for source in sources:
        source.parent.mkdir(parents=True)
        source.touch()
    figure = Figure("4, left", "Errors", "at most 2 mm", (panel(tmp_path, "a.png"),), sources[:1])
    table = Table("Numbers", "all of them", ("what", "value"), ((Cell("seeds"), Cell("3", sources)),))
    sections = [Section("First part", ("with `code`",), (figure, table)), Section("Second: part", (), (figure,))]
    reader = Reader(page("Title", ["opening"], sections, tmp_path))
    assert [link for link in reader.links if link.startswith("#")] == ["#first-part", "#second-part"]
    assert {link[1:] for link in reader.links if link.startswith("#")} <= set(reader.ids)
    files = [link for link in reader.links if not link.startswith("#")]
    assert files == ["runs/a%20b/train.json", "runs/a%20b/train.json", "runs/c/train.json", "runs/a%20b/train.json"]
    assert all(image.startswith("data:image/png;base64,") for image in reader.images)
    assert not reader.names & {"script", "link", "iframe"}


def test_a_page_reaches_for_nothing_outside(tmp_path: Path) -> None:
    text = page("Title", [], [Section("Part", (), (Figure("1", "t", "c", (panel(tmp_path, "a.png"),)),))], tmp_path)
    assert not re.search(r"https?://|@import|url\(", text)


def test_figures_that_belong_beside_each_other_share_a_row(tmp_path: Path) -> None:
    one = panel(tmp_path, "a.png")
    figures = [Figure(number, "t", "c", (one,), beside=row) for number, row in (("1", ""), ("4, left", "4"))]
    figures += [Figure(number, "t", "c", (one,), beside=row) for number, row in (("4, right", "4"), ("7", "7"))]
    text = page("Title", [], [Section("Part", (), tuple(figures))], tmp_path)
    assert text.count('<div class="pair">') == 1
    pair = text.split('<div class="pair">')[1].split("</div></div>")[0]
    assert "figure-4-left" in pair
    assert "figure-1" not in pair


def test_what_is_missing_says_what_makes_it(tmp_path: Path) -> None:
    blocks = (Missing("Figure 2", "It needs a run.", "koopdqn train task=shelf"), Missing("Figure 3", "It cannot be."))
    text = page("Title", [], [Section("Part", (), blocks)], tmp_path)
    assert "<code>koopdqn train task=shelf</code> makes it." in text
    assert text.count("makes it.") == 1


@given(st.text(st.characters(exclude_characters="`\r", exclude_categories=("Cs", "Cc")), min_size=1))
def test_any_text_is_shown_as_it_is(text: str) -> None:
    block = Missing(text, text, text)
    table = Table(text, text, (text,), ((Cell(text),),))
    reader = Reader(page(text, [text], [Section(text, (text,), (block, table))], Path()))
    words = Section("a", ("a",), (Missing("a", "a", "a"), Table("a", "a", ("a",), ((Cell("a"),),))))
    plain = Reader(page("a", ["a"], [words], Path()))
    # No element comes out of a text.
    assert reader.names == plain.names
    assert unescape(reader.text).count(text) >= 11


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_cell_links_to_each_of_its_sources(tmp_path: Path, count: int) -> None:
    sources = tuple(tmp_path / f"{index}.json" for index in range(count))
    table = Table("t", "c", ("a", "b"), ((Cell("row"), Cell("42", sources)),))
    reader = Reader(page("Title", [], [Section("Part", (), (table,))], tmp_path))
    assert [link for link in reader.links if link.endswith(".json")] == [source.name for source in sources]
