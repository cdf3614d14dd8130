"""What a report page consists of: sections of text, figures, tables and notes of what is missing."""

from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Panel:
    """One picture of a figure.

    Attributes:
        file: the PNG.
        alt: what it shows, for those who cannot see it.
    """

    file: Path
    alt: str


@dataclass(frozen=True)
class Figure:
    """A figure with its caption.

    Attributes:
        number: as the paper counts.
        title: in a few words.
        caption: what is seen, with the numbers that matter.
        panels: its pictures.
        sources: the files that it was drawn from.
        beside: figures that follow each other with the same text here stand side by side where there is room.
        wide: whether it takes most of the page's width although it is one picture.
    """

    number: str
    title: str
    caption: str
    panels: tuple[Panel, ...]
    sources: tuple[Path, ...] = ()
    beside: str = ""
    wide: bool = False


@dataclass(frozen=True)
class Missing:
    """A figure or table that could not be drawn.

    Attributes:
        what: its name.
        reason: what it needs, and what was found.
        command: what makes it; empty where a command would not.
    """

    what: str
    reason: str
    command: str = ""


@dataclass(frozen=True)
class Cell:
    """A cell of a table.

    Attributes:
        text: what it says.
        sources: the files that it came from; one is linked from the text, of several each gets a mark.
    """

    text: str
    sources: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Table:
    """A table with its caption.

    Attributes:
        title: above it.
        caption: below it.
        header: the columns' names.
        rows: the cells; the first of a row is its name.
    """

    title: str
    caption: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


Block = Figure | Missing | Table


@dataclass(frozen=True)
class Section:
    """A part of the page.

    Attributes:
        heading: its name, which the table of contents lists.
        paragraphs: plain texts before its blocks.
        blocks: figures, tables and notes, in order.
    """

    heading: str
    paragraphs: tuple[str, ...] = ()
    blocks: tuple[Block, ...] = field(default_factory=tuple)
