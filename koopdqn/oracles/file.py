"""The oracle of other programs: questions and answers as JSON lines over two pipes or files."""

import contextlib
import json
import os
import stat
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, ValidationError

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import Answer, Oracle, OracleSettings, PauseRequested, Question
from koopdqn.oracles.journal import Action
from koopdqn.settings import Name, NonNegativeInt, PathText, ReportModel, flaw

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Workcell

_POLL_SECONDS = 0.01
# So many answers that may be withdrawn are told with a question: all would make the file grow with their square.
_TOLD = 100


class FileAnswer(ReportModel):
    """One line of the answers' file."""

    number: NonNegativeInt = Field(description="number of the question that is answered")
    right: bool | None = Field(None, description="the answer; null for a skipped question, which is not a no")
    better: Action | None = Field(None, description="index of the action that would have been right; null if not said")
    undo: NonNegativeInt = Field(0, description="how many earlier answers, the latest first, are withdrawn before")
    source: Name | None = Field(None, description="who answers; null for the oracle's name")
    pause: bool = Field(False, description="whether to pause the run instead of answering")


class FileOracleSettings(OracleSettings):
    """Settings of the oracle that asks through files."""

    questions: PathText | None
    answers: PathText | None

    def check(self) -> None:
        """Raise BadInputError unless both files are named, differ and are no folders."""
        questions, answers = self._given()
        if questions == answers:
            raise BadInputError(f"oracle.answers: must be another file than oracle.questions, found {answers}")
        for key, path in (("questions", questions), ("answers", answers)):
            if path.is_dir() or not path.parent.is_dir():
                found = "a folder" if path.is_dir() else "no folder to hold it"
                raise BadInputError(f"oracle.{key}: must name a file or a pipe, found {found}: {path}")

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle; it has no chance and keeps nothing."""
        return FileOracle(*self._given(), self.name)

    def _given(self) -> tuple[Path, Path]:
        if self.questions is None or self.answers is None:
            key = "questions" if self.questions is None else "answers"
            raise BadInputError(f"oracle.{key}: must name a file or a pipe, found nothing")
        return self.questions, self.answers


class FileOracle(Oracle):
    """Appends questions to one file and reads their answers from another, each a line of JSON."""

    def __init__(self, questions: Path, answers: Path, name: str) -> None:
        """Open both files; what is no pipe is made where it is missing. Answers that name no source are of ``name``.

        Raises:
            BadInputError: a file cannot be opened.
        """
        self._name = name
        self._questions_path, self._answers_path = questions, answers
        self._asked = _asked_before(questions)
        self._questions = _opened(questions, os.O_WRONLY | os.O_APPEND)
        self._answers = _opened(answers, os.O_RDONLY)
        self._rest = b""
        # Of a file what is there already; a pipe has no size.
        self._old, self._passed = os.fstat(self._answers).st_size, 0

    def answer(self, question: Question) -> Answer:
        """Write the question and wait for the line that answers it.

        Raises:
            BadInputError: a line is no answer, or answers a question that was not asked yet, or of another run.
            PauseRequested: the other program asks for it.
        """
        began, told = time.monotonic(), question_object(question)
        os.write(self._questions, (json.dumps(told, sort_keys=True, allow_nan=False) + "\n").encode())
        last = next(reversed(self._asked), None)
        while True:
            found = self._parsed(self._line())
            if found.number > question.number:
                raise self._wrong(f"number: must be at most {question.number}, found {found.number}")
            old = self._passed <= self._old
            # It has paused the run at this question already, which is asked anew.
            if found.number == question.number and not (found.pause and old and question.number == last):
                break
        if old and self._asked.get(question.number, _about(told)) != _about(told):
            raise BadInputError(
                f"oracle.answers {self._answers_path}: must answer question {question.number} of this run, found the"
                f" answer to another one, in {self._questions_path}: name other files, or remove both"
            )
        if found.pause:
            raise PauseRequested("paused by the program that answers")
        right = found.better == question.action if found.right is None and found.better is not None else found.right
        source = found.source or self._name
        return Answer(right, source, time.monotonic() - began, found.better, found.undo)

    def close(self) -> None:
        """Close both files."""
        os.close(self._questions)
        os.close(self._answers)

    def _line(self) -> bytes:
        while b"\n" not in self._rest:
            new = os.read(self._answers, 65536)
            self._rest += new
            if not new:
                time.sleep(_POLL_SECONDS)
        line, _, self._rest = self._rest.partition(b"\n")
        self._passed += len(line) + 1
        return line

    def _parsed(self, line: bytes) -> FileAnswer:
        try:
            return FileAnswer.model_validate_json(line)
        except ValidationError as error:
            raise self._wrong(flaw(error)) from error

    def _wrong(self, message: str) -> BadInputError:
        return BadInputError(f"oracle.answers {self._answers_path}: a line must be an answer as JSON: {message}")


def question_object(question: Question) -> dict[str, Any]:
    """Return a question as the JSON object that other programs read."""
    fields = {"kind": "question", **asdict(replace(question, earlier=question.earlier[-_TOLD:]))}
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in fields.items()}


def _asked_before(questions: Path) -> dict[int, tuple[Any, ...]]:
    """Return what the questions in a file are about, by their numbers, the last one last; none of a pipe."""
    asked: dict[int, tuple[Any, ...]] = {}
    if not questions.is_file():
        return asked
    with questions.open("rb") as file:
        for line in file:
            with contextlib.suppress(ValueError, KeyError, TypeError):
                told = json.loads(line)
                number = int(told["number"])
                asked.pop(number, None)
                asked[number] = _about(told)
    return asked


def _about(told: dict[str, Any]) -> tuple[Any, ...]:
    return told["pose"], told["action"]


def _opened(path: Path, mode: int) -> int:
    try:
        # Both ends of a pipe at once: opening waits for no one, and who reads or writes it may come and go.
        if path.exists() and stat.S_ISFIFO(path.stat().st_mode):
            return os.open(path, os.O_RDWR)
        return os.open(path, mode | os.O_CREAT, 0o666)
    except OSError as error:
        raise BadInputError(f"oracle: {path} must be a file or a pipe to open, found: {error.strerror}") from error
