"""The journal of answers: append-only JSON lines, each on disk before the next question, and their reading."""

import json
import os
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from heapq import heappop, heappush
from pathlib import Path
from typing import IO, Annotated, Any, Final, Literal

from pydantic import Field, TypeAdapter, ValidationError

from koopdqn.errors import BadInputError
from koopdqn.files import parse_json, write_text
from koopdqn.oracles.base import Answer, Earlier
from koopdqn.run_folder import open_own
from koopdqn.settings import Name, NonNegative, NonNegativeInt, PoseList, ReportModel, flaw
from koopdqn.tasks.actions import NAMES

LARGEST_JOURNAL: Final = 2**30
"""The most bytes that a journal may hold: some million answers, more than the paper's own settings ask."""

Action = Annotated[int, Field(ge=0, lt=len(NAMES))]


class AnswerLine(ReportModel):
    """An answer of the oracle. Poses are of the flange in the base frame: x y z [m], qw qx qy qz."""

    kind: Literal["answer"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer, from 0")
    episode: NonNegativeInt = Field(description="number of the episode, from 0")
    step: NonNegativeInt = Field(description="step within it, from 0")
    pose: PoseList = Field(description="(7,) before the action [m, 1]")
    start: PoseList | None = Field(
        None, description="(7,) where the episode began, or its leg; null in journals that do not say [m, 1]"
    )
    action: Action = Field(description="index of the action in Table 1, from 0; 10 is the intent model's suggestion")
    reached: PoseList = Field(description="(7,) after the action [m, 1]")
    predicted: PoseList = Field(description="(7,) where the intent model would have gone [m, 1]")
    reason: str = Field(description="why it was asked, in words")
    right: bool | None = Field(description="the answer; null for a skipped question, which is not a no")
    better: Action | None = Field(None, description="index of the action that would have been right; null if not said")
    source: Name = Field(description="who answered")
    seconds: NonNegative = Field(description="how long the answer took; shapes nothing [s]")


class UndoLine(ReportModel):
    """The latest answer that stands is withdrawn, from the question on that stood then."""

    kind: Literal["undo"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer that is withdrawn")
    before: NonNegativeInt = Field(description="number of the question that stood then")
    episode: NonNegativeInt = Field(description="number of that question's episode")
    step: NonNegativeInt = Field(description="its step")


class EditLine(ReportModel):
    """An answer was changed afterwards, by ``koopdqn feedback edit`` or ``merge``."""

    kind: Literal["edit"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer that is changed")
    right: bool | None = Field(description="the answer from now on; null for a skipped question")
    better: Action | None = Field(description="index of the action that would have been right; null if not said")
    source: Name = Field(description="who changed it")
    learned: bool = Field(description="whether the run in the journal's folder had learned from the answer by then")


class DropLine(ReportModel):
    """All answers after one no longer count, and are asked anew, by ``koopdqn feedback edit --drop-later``."""

    kind: Literal["drop"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the last answer that still counts")


class OpinionLine(ReportModel):
    """What another teacher says to an answered question, by ``koopdqn feedback merge``."""

    kind: Literal["opinion"] = Field(description="what the line is")
    number: NonNegativeInt = Field(description="number of the answer")
    right: bool | None = Field(description="the other teacher's answer; null for a skipped question")
    better: Action | None = Field(description="index of the action that would have been right; null if not said")
    source: Name = Field(description="who says it")


Line = Annotated[AnswerLine | UndoLine | EditLine | DropLine | OpinionLine, Field(discriminator="kind")]
"""Any line of a journal."""


_LINE: TypeAdapter[Line] = TypeAdapter(Line)
_KINDS: Final = ("answer", "undo", "edit", "drop", "opinion")


@dataclass(frozen=True)
class Record:
    """An answer and what became of it.

    Attributes:
        line: the answer's own line, with the latest edit in it.
        undo: how many earlier answers were withdrawn before it stood.
        withdrawn: whether it was withdrawn later.
        edited: whether it was changed later.
        learned: right and better action as the run had learned them before they were changed; None if it had not.
        opinions: what other teachers say to its question.
    """

    line: AnswerLine
    undo: int = 0
    withdrawn: bool = False
    edited: bool = False
    learned: tuple[bool | None, int | None] | None = None
    opinions: tuple[OpinionLine, ...] = ()

    @property
    def answer(self) -> Answer:
        """The answer as it was given, or as it was changed."""
        return Answer(self.line.right, self.line.source, self.line.seconds, self.line.better, self.undo)

    @property
    def earlier(self) -> Earlier:
        """The answer as later questions show it."""
        line = self.line
        return Earlier(line.number, line.episode, line.step, line.action, line.right)


@dataclass
class Records:
    """The content of a journal.

    Attributes:
        items: the answers in order; an answer's number is its place.
        pending: how many answers were withdrawn after the last answer, for the next one to count.
    """

    items: list[Record] = field(default_factory=list)
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
        BadInputError: as of :func:`numbered_lines`.
    """
    return [item for _, item in numbered_lines(path)]


def numbered_lines(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the lines of a journal as JSON objects, each with its number from 1, which counts empty ones too.

    Raises:
        BadInputError: the file cannot be read, is too large, or a line before the last is no JSON object.
    """
    try:
        if path.stat().st_size > LARGEST_JOURNAL:
            raise BadInputError(
                f"journal {path}: must hold at most {LARGEST_JOURNAL} bytes, found {path.stat().st_size}"
            )
        with path.open("rb") as file:
            # What follows the last line's end was torn off, even where it reads as JSON.
            lines = [line.rstrip(b"\n") for line in file if line.endswith(b"\n")]
    except OSError as error:
        raise BadInputError(f"journal {path}: must be a readable file, the system says: {error.strerror}") from error
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            item = parse_json(line)
            if not isinstance(item, dict):
                raise ValueError("no JSON object")
        except ValueError as error:
            raise BadInputError(f"journal {path}: line {number} must be a JSON object, found: {error}") from error
        yield number, item


def copy_answers(path: Path, out: Path) -> None:
    """Write what a journal holds to a new file for another run, which has learned from none of it yet.

    Raises:
        BadInputError: as of :func:`read_lines`.
    """
    items = (item | ({"learned": False} if item.get("kind") == "edit" else {}) for item in read_lines(path))
    write_text(out, "".join(json.dumps(item, sort_keys=True) + "\n" for item in items))


def read_records(path: Path) -> Records:
    """Return the content of a journal; lines of kinds that koopdqn does not know are passed over.

    Raises:
        BadInputError: the file cannot be read, or a line is damaged, out of order or of no answer.
    """
    reader = _Reader()
    for number, item in numbered_lines(path):
        if item.get("kind") not in _KINDS:
            continue
        try:
            reader.read(_LINE.validate_python(item))
        except ValidationError as error:
            raise BadInputError(f"journal {path}: line {number}: {flaw(error, skip=1)}") from error
        except ValueError as error:
            raise BadInputError(f"journal {path}: line {number}: {error}") from error
    return reader.records()


# Lines read anew because of drops; nobody comes near it, and a made-up journal must not take hours.
_MOST_READ_ANEW = 2_000_000


class _Reader:
    """What a journal's lines come to, in time proportional to their number."""

    def __init__(self) -> None:
        self._lines: list[Line] = []
        self._read_anew = 0
        self._begin()

    def _begin(self) -> None:
        self._items: list[Record] = []
        self._opinions: defaultdict[int, list[OpinionLine]] = defaultdict(list)
        self._pending = 0
        # Numbers, negative, of answers that may be withdrawn, the latest first; some may have been since.
        self._latest: list[int] = []

    def records(self) -> Records:
        """Return the content so far."""
        items = list(self._items)
        for number, opinions in self._opinions.items():
            items[number] = replace(items[number], opinions=tuple(opinions))
        return Records(items, self._pending)

    def read(self, line: Line) -> None:
        """Take in a line.

        Raises:
            ValueError: it does not fit those before it.
        """
        if isinstance(line, DropLine):
            # A dropped answer's own doings, such as what it withdrew, are best forgotten by starting over.
            self._lines = _without_dropped(self._lines, line)
            self._read_anew += len(self._lines)
            if self._read_anew > _MOST_READ_ANEW:
                raise ValueError(f"drops must not make more than {_MOST_READ_ANEW} lines be read anew, found more")
            self._begin()
            for each in self._lines:
                self._apply(each)
        else:
            self._apply(line)
            self._lines.append(line)

    def _apply(self, line: Line) -> None:
        match line:
            case AnswerLine():
                if line.number != len(self._items):
                    raise ValueError(
                        f"answers must be numbered in order, so {len(self._items)} here, found {line.number}"
                    )
                self._items.append(Record(line, self._pending))
                self._pending = 0
                self._may_be_withdrawn(line)
            case UndoLine():
                latest = self._withdrawable()
                if line.number != latest:
                    raise ValueError(
                        f"an undo must withdraw the latest answer that stands, {latest}, found {line.number}"
                    )
                self._items[latest] = replace(self._items[latest], withdrawn=True)
                self._pending += 1
            case EditLine():
                before = self._at(line.number)
                changes = {"right": line.right, "better": line.better, "source": line.source}
                answer = before.line.model_copy(update=changes)
                learned = before.learned
                if learned is None and line.learned:
                    learned = before.line.right, before.line.better
                self._items[line.number] = replace(before, line=answer, edited=True, learned=learned)
                self._may_be_withdrawn(answer)
            case OpinionLine():
                self._at(line.number)
                self._opinions[line.number].append(line)

    def _at(self, number: int) -> Record:
        if number >= len(self._items):
            raise ValueError(f"number must be that of an answer before it, 0 to {len(self._items) - 1}, found {number}")
        return self._items[number]

    def _may_be_withdrawn(self, line: AnswerLine) -> None:
        if line.right is not None:
            heappush(self._latest, -line.number)

    def _withdrawable(self) -> int | None:
        """Return the number of the latest answer that an undo may withdraw, or None."""
        while self._latest:
            item = self._items[-self._latest[0]]
            if not item.withdrawn and item.line.right is not None:
                return item.line.number
            heappop(self._latest)
        return None


def _without_dropped(lines: list[Line], drop: DropLine) -> list[Line]:
    """Return the lines up to an answer, and what later ones say about it or earlier ones."""
    places = [place for place, line in enumerate(lines) if isinstance(line, AnswerLine)]
    if drop.number >= len(places):
        raise ValueError(f"number must be that of an answer before it, 0 to {len(places) - 1}, found {drop.number}")
    end = places[drop.number] + 1
    later = (line for line in lines[end:] if isinstance(line, EditLine | OpinionLine) and line.number <= drop.number)
    return [*lines[:end], *later]


class JournalFile:
    """A journal, of answers or of keys, open for appending. Close it."""

    def __init__(self, path: Path) -> None:
        """Open a journal for appending, or begin one; a last line cut off by a crash goes.

        Raises:
            BadInputError: the journal cannot be written, or is a link.
        """
        try:
            self._file = os.fdopen(open_own(path, os.O_RDWR | os.O_APPEND), "a+b", buffering=0)
            _cut_torn_line(self._file)
        except OSError as error:
            raise BadInputError(f"journal {path} must be writable, the system says: {error.strerror}") from error

    def append(self, *lines: ReportModel) -> None:
        """Append lines, all or, where the disk is full, none; they are on disk when this returns."""
        texts = (json.dumps(line.model_dump(mode="json"), sort_keys=True, allow_nan=False) + "\n" for line in lines)
        end, left = self._file.seek(0, os.SEEK_END), "".join(texts).encode()
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError:
            self._file.truncate(end)
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cut_torn_line(file: IO[bytes]) -> None:
    file.seek(0)
    content = file.read()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        file.truncate(whole)
