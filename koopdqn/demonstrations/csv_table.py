"""A CSV file as named columns of numbers, whatever its separator, line ends and byte order mark."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from koopdqn.config.messages import shown
from koopdqn.errors import BadInputError
from koopdqn.pose import Array

_SEPARATORS = (",", ";", "\t")
_COMMENT = "#"


@dataclass(frozen=True)
class Table:
    """The content of a CSV file.

    Attributes:
        path: the file.
        cells: texts of each column, by its name in lower case.
        lines: (N,) line of each row in the file, from 1.
    """

    path: Path
    cells: dict[str, list[str]]
    lines: np.ndarray

    def __len__(self) -> int:
        """Return the number of rows below the header."""
        return len(self.lines)

    def numbers(self, name: str) -> Array:
        """Return a column as numbers (N,).

        Raises:
            BadInputError: a cell is no finite number.
        """
        column = self.cells[name]
        try:
            values = np.array([float(cell) for cell in column])
        except ValueError:
            values = np.array([_number(cell) for cell in column])
        wrong = np.flatnonzero(~np.isfinite(values))
        if len(wrong):
            row = int(wrong[0])
            raise BadInputError(
                f"demonstrations {self.path}: line {self.lines[row]}: {name} must be a finite number,"
                f" found {shown(column[row])}"
            )
        return values


def read_table(path: Path) -> Table:
    """Read a CSV file: one header line of column names, then one row a line.

    Cells are separated by commas, semicolons, tabs or blanks, whichever the header line has, in that order. Blank
    around names and cells, the case of names, blank lines and lines that begin with # count for nothing. Where
    semicolons, tabs or blanks separate, a decimal comma is read as a point.

    Raises:
        BadInputError: the file is missing, is no text, has no header, a name occurs twice, or a row has another
            number of cells than the header.
    """
    rows = _rows(path)
    if not rows:
        raise BadInputError(f"demonstrations {path}: must hold a header line and samples, found an empty file")
    (_, header), *body = rows
    separator = next((each for each in _SEPARATORS if each in header), None)
    names = [name.lower() for name in _split(header, separator)]
    twice = sorted({name for name in names if name and names.count(name) > 1})
    if twice:
        raise BadInputError(f"demonstrations {path}: every column must have its own name, found two named {twice[0]}")
    columns: list[list[str]] = [[] for _ in names]
    for line, text in body:
        cells = _split(text, separator)
        # Some loggers end every row with a separator.
        if len(cells) == len(names) + 1 and not cells[-1]:
            cells = cells[:-1]
        if len(cells) != len(names):
            raise BadInputError(
                f"demonstrations {path}: line {line} must have {len(names)} cells as the header, found {len(cells)}"
            )
        for column, cell in zip(columns, cells, strict=True):
            column.append(cell if separator == "," else cell.replace(",", "."))
    return Table(path, dict(zip(names, columns, strict=True)), np.array([line for line, _ in body], dtype=int))


def _rows(path: Path) -> list[tuple[int, str]]:
    """Return the lines that say something, each with its number from 1."""
    if not path.is_file():
        found = "a folder" if path.is_dir() else "nothing"
        raise BadInputError(f"demonstrations must be a file, found {found} at {path}")
    content = path.read_bytes()
    # Spreadsheets write UTF-16 with a byte order mark.
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise BadInputError(f"demonstrations {path}: must be CSV text in UTF-8, found another encoding") from error
    if "\0" in text:
        raise BadInputError(f"demonstrations {path}: must be CSV text in UTF-8, found binary content")
    numbered = enumerate(text.replace("\r\n", "\n").replace("\r", "\n").split("\n"), start=1)
    return [
        (number, line) for number, line in numbered if line.strip(" \t,;") and not line.lstrip().startswith(_COMMENT)
    ]


def _split(line: str, separator: str | None) -> list[str]:
    if separator is None:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
