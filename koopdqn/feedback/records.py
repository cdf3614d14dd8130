"""What the lines of a journal mean together: every answer with what was done to it later."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from koopdqn.errors import BadInputError
from koopdqn.feedback.oracle import Answer, Earlier, Question
from koopdqn.feedback.schema import AnswerLine, DropLine, EditLine, Line, OpinionLine, UndoLine

_LINE: TypeAdapter[Line] = TypeAdapter(Line)


@dataclass(frozen=True)
class Opinion:
    """What another teacher says to an answered question.

    Attributes:
        source: who says it.
        right: the answer; None if skipped.
        better: index of the action that would have been right, or None.
    """

    source: str
    right: bool | None
    better: int | None


@dataclass(frozen=True)
class Record:
    """An answer and what became of it.

    Attributes:
        line: the answer's own line, with the latest edit in it.
        undo: how many earlier answers were withdrawn before it stood.
        withdrawn: whether it was withdrawn later.
        edited: whether it was changed later.
        learned: whether the run had learned from it before it was changed.
        opinions: of other teachers.
    """

    line: AnswerLine
    undo: int = 0
    withdrawn: bool = False
    edited: bool = False
    learned: bool = False
    opinions: tuple[Opinion, ...] = ()

    @property
    def answer(self) -> Answer:
        """The answer as it was given, or as it was changed."""
        return Answer(self.line.right, self.line.source, self.line.seconds, self.line.better, self.undo)

    @property
    def earlier(self) -> Earlier:
        """The answer as later questions show it."""
        line = self.line
        return Earlier(line.number, line.episode, line.step, line.action, line.right)

    def fits(self, question: Question) -> bool:
        """Return whether it answers this question."""
        line = self.line
        same = (line.episode, line.step, line.action) == (question.episode, question.step, question.action)
        return same and np.array_equal(line.pose, question.pose)


@dataclass(frozen=True)
class Records:
    """The content of a journal.

    Attributes:
        items: the answers in order; an answer's number is its place.
        pending: how many answers were withdrawn after the last answer, for the next one to count.
    """

    items: tuple[Record, ...] = ()
    pending: int = 0

    @property
    def standing(self) -> list[Record]:
        """The answers that were not withdrawn."""
        return [item for item in self.items if not item.withdrawn]

    @property
    def withdrawable(self) -> list[Record]:
        """The answers that an undo may withdraw: a skipped question taught nothing, so there is nothing to undo."""
        return [item for item in self.standing if item.line.right is not None]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a journal as JSON objects; a last line cut off by a crash is left out.

    Raises:
        BadInputError: the file cannot be read, or a line before the last is no JSON object.
    """
    try:
        # What follows the last line's end was torn off, even where it reads as JSON.
        *lines, _ = path.read_bytes().split(b"\n")
    except OSError as error:
        raise BadInputError(f"journal {path}: must be a readable file, the system says: {error.strerror}") from error
    found = []
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            item = json.loads(line)
            if not isinstance(item, dict):
                raise ValueError("no JSON object")
        except ValueError as error:
            raise BadInputError(f"journal {path}: line {number} must be a JSON object, found: {error}") from error
        found.append(item)
    return found


def read_records(path: Path) -> Records:
    """Return the content of a journal; lines of kinds that koopdqn does not know are passed over.

    Raises:
        BadInputError: the file cannot be read, or a line is damaged, out of order or of no answer.
    """
    records = Records()
    lines: list[Line] = []
    for number, item in enumerate(read_lines(path), start=1):
        if item.get("kind") not in _KINDS:
            continue
        try:
            line = _LINE.validate_python(item)
            lines = _without_dropped(lines, line) if isinstance(line, DropLine) else [*lines, line]
            # A dropped answer's own doings, such as what it withdrew, are best forgotten by starting over.
            records = _together(lines) if isinstance(line, DropLine) else _APPLY[line.kind](records, line)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            key = ".".join(str(part) for part in first["loc"][1:])
            raise BadInputError(f"journal {path}: line {number}: {key}: {first['msg']}") from error
        except ValueError as error:
            raise BadInputError(f"journal {path}: line {number}: {error}") from error
    return records


def _together(lines: list[Line]) -> Records:
    records = Records()
    for line in lines:
        records = _APPLY[line.kind](records, line)
    return records


def _without_dropped(lines: list[Line], drop: DropLine) -> list[Line]:
    """Return the lines up to an answer, and what later ones say about it or earlier ones."""
    places = [place for place, line in enumerate(lines) if isinstance(line, AnswerLine)]
    if drop.number >= len(places):
        raise ValueError(f"number must be that of an answer before it, 0 to {len(places) - 1}, found {drop.number}")
    end = places[drop.number] + 1
    later = (line for line in lines[end:] if isinstance(line, EditLine | OpinionLine) and line.number <= drop.number)
    return [*lines[:end], *later]


def _answered(records: Records, line: AnswerLine) -> Records:
    if line.number != len(records.items):
        raise ValueError(f"answers must be numbered in order, so {len(records.items)} here, found {line.number}")
    return Records((*records.items, Record(line, records.pending)))


def _undone(records: Records, line: UndoLine) -> Records:
    latest = records.withdrawable[-1].line.number if records.withdrawable else None
    if line.number != latest:
        raise ValueError(f"an undo must withdraw the latest answer that stands, {latest}, found {line.number}")
    changed = _changed(records, line.number, withdrawn=True)
    return replace(changed, pending=records.pending + 1)


def _edited(records: Records, line: EditLine) -> Records:
    before = _at(records, line.number)
    answer = before.line.model_copy(update={"right": line.right, "better": line.better, "source": line.source})
    return _changed(records, line.number, line=answer, edited=True, learned=before.learned or line.learned)


def _opined(records: Records, line: OpinionLine) -> Records:
    opinion = Opinion(line.source, line.right, line.better)
    return _changed(records, line.number, opinions=(*_at(records, line.number).opinions, opinion))


def _at(records: Records, number: int) -> Record:
    if number >= len(records.items):
        raise ValueError(f"number must be that of an answer before it, 0 to {len(records.items) - 1}, found {number}")
    return records.items[number]


def _changed(records: Records, number: int, **fields: Any) -> Records:
    item = replace(_at(records, number), **fields)
    return replace(records, items=(*records.items[:number], item, *records.items[number + 1 :]))


_APPLY: dict[str, Callable[[Records, Any], Records]] = {
    "answer": _answered,
    "undo": _undone,
    "edit": _edited,
    "opinion": _opined,
}
_KINDS = (*_APPLY, "drop")
