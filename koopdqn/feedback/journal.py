"""The journal of answers: append-only JSON lines, each on disk before the next question."""

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn.errors import BadInputError
from koopdqn.feedback.oracle import Answer, Oracle, Question


def entry(number: int, question: Question, answer: Answer) -> dict[str, Any]:
    """Return an answer as its journal line's JSON object."""
    return {
        "kind": "answer",
        "number": number,
        "episode": question.episode,
        "step": question.step,
        "pose": question.pose.tolist(),
        "action": question.action,
        "reached": question.reached.tolist(),
        "predicted": question.predicted.tolist(),
        "reason": question.reason,
        "right": answer.right,
        "source": answer.source,
        "seconds": answer.seconds,
    }


def read_journal(path: Path) -> list[dict[str, Any]]:
    """Return the entries of a journal; a last line cut off by a crash is left out.

    Raises:
        BadInputError: a line before the last is no JSON object, or an answer that lacks a field.
    """
    entries = []
    # What follows the last line's end was torn off, even where it reads as JSON.
    *lines, _ = path.read_bytes().split(b"\n")
    for number, line in enumerate(lines, start=1):
        if not line:
            continue
        try:
            item = json.loads(line)
            if not isinstance(item, dict):
                raise ValueError("no JSON object")
            if item.get("kind") == "answer" and not item.keys() >= {"right", "source", "seconds"}:
                raise ValueError("an answer without right, source or seconds")
        except ValueError as error:
            raise BadInputError(f"journal {path}: line {number} must be a JSON object, found: {error}") from error
        entries.append(item)
    return entries


@dataclass(frozen=True)
class _Recorded:
    number: int
    fields: dict[str, Any]

    def fits(self, question: Question) -> bool:
        same = all(self.fields.get(key) == getattr(question, key) for key in ("episode", "step", "action"))
        return same and np.array_equal(self.fields.get("pose", ()), question.pose)


class JournalledOracle:
    """An oracle whose every answer is written down, and that gives written answers again instead of asking.

    A run that is continued asks, from its checkpoint on, the very questions it asked before; those already
    answered are taken from the journal in order, so that no one is asked twice.

    Attributes:
        questions: number of questions answered so far, from the journal or by asking.
    """

    def __init__(self, oracle: Oracle, path: Path, position: int) -> None:
        """Open the journal at ``path`` for an oracle; the first ``position`` answers are in the checkpoint already.

        Raises:
            BadInputError: the journal cannot be written, is damaged, or is shorter than the checkpoint says.
        """
        self.questions = position
        self._oracle = oracle
        self._path = path
        written = [item for item in read_journal(path) if item.get("kind") == "answer"] if path.exists() else []
        if len(written) < position:
            raise BadInputError(f"journal {path}: must hold the {position} answers of the run, found {len(written)}")
        self._again: Iterator[_Recorded] = iter(
            [_Recorded(number, fields) for number, fields in enumerate(written) if number >= position]
        )
        try:
            _cut_torn_line(path)
            self._file = path.open("a", encoding="utf-8")
        except OSError as error:
            raise BadInputError(f"journal {path} must be writable, the system says: {error.strerror}") from error

    def answer(self, question: Question) -> Answer:
        """Return the written answer, or ask, write the answer down and return it.

        Raises:
            BadInputError: the journal does not fit the run.
        """
        recorded = next(self._again, None)
        if recorded is None:
            answer = self._oracle.answer(question)
            self._write(entry(self.questions, question, answer))
        elif recorded.fits(question):
            answer = Answer(recorded.fields["right"], recorded.fields["source"], recorded.fields["seconds"])
        else:
            raise BadInputError(
                f"journal {self._path}: answer {recorded.number} must be to the question the run asks (episode"
                f" {question.episode}, step {question.step}, action {question.action}), found episode"
                f" {recorded.fields.get('episode')}, step {recorded.fields.get('step')},"
                f" action {recorded.fields.get('action')}"
            )
        self.questions += 1
        return answer

    def close(self) -> None:
        """Close the journal and the oracle."""
        self._file.close()
        self._oracle.close()

    def _write(self, item: dict[str, Any]) -> None:
        self._file.write(json.dumps(item, sort_keys=True, allow_nan=False) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())


def _cut_torn_line(path: Path) -> None:
    if not path.exists():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("rb+") as file:
            file.truncate(whole)
