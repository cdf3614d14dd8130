"""Recordings in text: any delimiter, any header or none, as many loggers and spreadsheets write them."""

import csv
import re
from dataclasses import dataclass
from functools import cached_property
from io import StringIO
from pathlib import Path
from typing import Final

import numpy as np

from koopdqn.demonstrations.recordings.columns import recordings_of, unnamed
from koopdqn.demonstrations.recordings.recording import ArrayColumns, ImportSettings, Recording
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.settings import shown

LARGEST_BYTES: Final = 1 << 28
"""The largest text file that is read."""
# A comma last: where another separates, it is a decimal one.
_DELIMITERS: Final = (";", "\t", "|", ",")
_COMMENTS: Final = ("#", "%", "//")
_NUMERAL: Final = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?|nan|[+-]?inf", re.ASCII | re.IGNORECASE)
HEAD: Final = 1 << 16
"""How many of its first bytes tell what a file is."""
_WESTERN: Final = "cp1252"
_NO_TEXT: Final = re.compile(rb"[\x00-\x08\x0e-\x1f\x7f]")


def is_text(head: bytes) -> bool:
    """Return whether a file is text, by its first bytes, of which there are :data:`HEAD` if it is longer."""
    return bool(head) and _decoded(head, whole=len(head) < HEAD) is not None


def read(path: Path, declared: ImportSettings) -> list[Recording]:
    """Return the recordings of a text file.

    Raises:
        BadInputError: the file is too large, holds no rows of numbers, or its columns are not recognised.
    """
    table = _table(path)
    if table.header is not None:
        return recordings_of(table, declared, Recording(str(path), reasons=(table.why,)))
    values = table.numbers(tuple(range(table.width)))
    names, reasons = unnamed(str(path), values, declared)
    columns = ArrayColumns(str(path), names, values, table.lines)
    return recordings_of(columns, declared, Recording(str(path), reasons=(table.why, *reasons)))


def header_of(head: bytes) -> tuple[str, ...]:
    """Return the names in a text file's header, in lower case, by its first bytes; empty if it has none."""
    found = _decoded(head, whole=len(head) < HEAD)
    every, kept, rows = _lines(found[0] if found else "")
    names = _header(every, kept, rows)[1] if rows else None
    return tuple(name.lower() for name in names or ())


@dataclass(frozen=True)
class TextColumns:
    """A table of text.

    Attributes:
        where: the file.
        header: the columns' names, or None.
        width: how many columns there are.
        rows: the lines below the header that say something.
        lines: (N,) the number of each, from 1.
        delimiter: what stands between cells; None is blanks.
        why: how it was recognised.
    """

    where: str
    header: tuple[str, ...] | None
    width: int
    rows: list[str]
    lines: np.ndarray
    delimiter: str | None
    why: str

    @property
    def names(self) -> tuple[str, ...]:
        """The columns' names, or their places."""
        return self.header or tuple(str(index) for index in range(self.width))

    @cached_property
    def _text(self) -> list[str]:
        # Where no comma separates, one in a number is the decimal one.
        return self.rows if self.delimiter == "," else [row.replace(",", ".") for row in self.rows]

    def numbers(self, columns: tuple[int, ...]) -> Array:
        """Return columns as numbers (N, k); BadInputError names line and column of a cell that is none."""
        try:
            values = np.loadtxt(
                self._text, delimiter=self.delimiter, usecols=columns, quotechar='"', comments=None, ndmin=2
            )
        except ValueError:
            values = None
        if values is None or not np.isfinite(values).all():
            raise self._odd_cell(columns)
        return np.asarray(values, dtype=float)

    def texts(self, column: int) -> list[str]:
        """Return the texts of a column."""
        # In one expression: there may be a million rows, and the cells behind this one need not be looked at.
        sign, stop = self.delimiter, column + 1
        cells = [
            found[column].strip()
            if len(found := _split(row, sign) if '"' in row else row.split(sign, stop)) > column
            else None
            for row in self.rows
        ]
        if None in cells:
            line = self.lines[cells.index(None)]
            raise BadInputError(f"demos {self.where}: line {line}: must have a cell {self.names[column]}, found none")
        return [cell for cell in cells if cell is not None]

    def _odd_cell(self, columns: tuple[int, ...]) -> BadInputError:
        """Return the error that names the first cell that is no finite number."""
        for line, row in zip(self.lines.tolist(), self._text, strict=True):
            cells = _split(row, self.delimiter)
            for column in columns:
                cell = cells[column] if column < len(cells) else ""
                if not _NUMERAL.fullmatch(cell) or "," in cell or not np.isfinite(float(cell)):
                    return BadInputError(
                        f"demos {self.where}: line {line}: {self.names[column]} must be a finite number,"
                        f" found {shown(cell)}"
                    )
        return BadInputError(f"demos {self.where}: must hold rows of numbers, found none")


def _table(path: Path) -> TextColumns:
    size = path.stat().st_size
    if size > LARGEST_BYTES:
        raise BadInputError(f"demos {path}: must be at most {LARGEST_BYTES >> 20} MiB of text, found {size >> 20} MiB")
    found = _decoded(path.read_bytes(), whole=True)
    if found is None:
        raise BadInputError(f"demos {path}: must be text in UTF-8, UTF-16 or Windows-1252, found something else")
    text, encoding = found
    every, kept, rows = _lines(text)
    if not rows:
        raise BadInputError(f"demos {path}: must hold rows of numbers, found none")
    try:
        return _rows(path, every, kept, rows, encoding)
    except csv.Error as error:
        raise BadInputError(f"demos {path}: must be rows of cells, found: {error}") from error


def _rows(path: Path, every: list[str], kept: list[int], rows: list[int], encoding: str) -> TextColumns:
    delimiter, header, first = _header(every, kept, rows)
    if rows[0] == first:
        rows = rows[1:]
    if not rows:
        raise BadInputError(f"demos {path}: must hold rows of numbers below its header, found none")
    width = len(header) if header is not None else len(_split(every[rows[0]], delimiter))
    why = f"text, cells between {_SHOWN[delimiter]}, {'a header' if header is not None else 'no header'}"
    if encoding == _WESTERN:
        why += ", in Windows-1252, as it is not UTF-8"
    counts = _counts([every[row] for row in rows], delimiter)
    # Where too little would be left, that the row is short is what must be said.
    if len(rows) > 2 and counts[-1] < width:
        why += f", line {rows[-1] + 1}, the last, cut off and left out"
        rows, counts = rows[:-1], counts[:-1]
    for index in np.flatnonzero(counts != width).tolist():
        cells = _split(every[rows[index]], delimiter)
        # Some loggers end every row with a delimiter.
        if len(_trimmed(cells)) != width and len(cells) != width:
            above = "the header" if header is not None else "the first"
            raise BadInputError(
                f"demos {path}: line {rows[index] + 1}: must have {width} cells as {above}, found {len(cells)}"
            )
    return TextColumns(str(path), header, width, [every[row] for row in rows], np.array(rows) + 1, delimiter, why)


_SHOWN: Final = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", None: "blanks"}


def _header(every: list[str], kept: list[int], rows: list[int]) -> tuple[str | None, tuple[str, ...] | None, int]:
    """Return the delimiter, the names or None, and the line that holds them."""
    first = every[rows[0]]
    delimiter = _delimiter_of(every[rows[min(1, len(rows) - 1)]])
    cells = _trimmed(_split(first, delimiter))
    if not any(_NUMERAL.fullmatch(cell) for cell in cells):
        return delimiter, tuple(cells), rows[0]
    if len(rows) > 1 and len(cells) > 2 and cells == [str(place) for place in range(len(cells))]:
        # Names that a data frame makes up.
        return delimiter, None, rows[0]
    # Some loggers write the names as a comment: rostopic's %time, MATLAB's and NumPy's headers.
    above = [number for number in kept if number < rows[0]]
    for number in reversed(above):
        names = _trimmed(_split(every[number].lstrip(" #%/"), delimiter))
        if len(names) == len(cells):
            return delimiter, tuple(names), number
    return delimiter, None, -1


def _delimiter_of(row: str) -> str | None:
    cells = row.split()
    # Commas may stand within numbers that blanks separate: 0,1 0,2 0,3.
    decimal = len(cells) > 1 and all(re.fullmatch(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?", cell) for cell in cells)
    return next((each for each in _DELIMITERS if each in row and not (each == "," and decimal)), None)


def _split(row: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return [cell.strip('"') for cell in row.split()]
    if '"' not in row:
        return [cell.strip() for cell in row.split(delimiter)]
    return [cell.strip() for cell in next(csv.reader(StringIO(row), delimiter=delimiter, skipinitialspace=True))]


def _counts(rows: list[str], delimiter: str | None) -> np.ndarray:
    """Return how many cells each row has, an empty one behind a last delimiter included."""
    quoted = any('"' in row for row in rows)
    if quoted or delimiter is None:
        return np.array([len(_split(row, delimiter)) for row in rows], dtype=int)
    return np.array([row.count(delimiter) for row in rows], dtype=int) + 1


def _trimmed(cells: list[str]) -> list[str]:
    """Return cells without the empty one that a delimiter at the end of the line makes."""
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _lines(text: str) -> tuple[list[str], list[int], list[int]]:
    """Return the lines of a text, the places of those that say something, and of these the ones that are no comment."""
    every = text.splitlines()
    kept = [place for place, line in enumerate(every) if line.strip(" \t,;|")]
    if not any(sign in text for sign in _COMMENTS):
        return every, kept, kept
    return every, kept, [place for place in kept if not every[place].lstrip().startswith(_COMMENTS)]


def _decoded(content: bytes, *, whole: bool) -> tuple[str, str] | None:
    """Return content as text and its encoding; None if it is none. A part may end within a character."""
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    for cut in range(1 if whole else 4):
        try:
            text = content[: len(content) - cut].decode(encoding)
        except UnicodeDecodeError:
            continue
        return None if "\0" in text else (text, encoding)
    # Older loggers write a degree sign or an umlaut in one byte; what is no text holds bytes that stand for nothing.
    if encoding == "utf-16" or _NO_TEXT.search(content):
        return None
    try:
        return content.decode(_WESTERN), _WESTERN
    except UnicodeDecodeError:
        return None
