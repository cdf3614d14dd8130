"""The journal of answers: append-only JSON lines, each on disk before the next question."""

import json
import os
from dataclasses import replace
from pathlib import Path

from koopdqn.errors import BadInputError
from koopdqn.feedback.oracle import Answer, Earlier, Oracle, Question
from koopdqn.feedback.records import Record, Records, read_records
from koopdqn.feedback.schema import AnswerLine, UndoLine
from koopdqn.schema import ReportModel

JOURNAL = "feedback.jsonl"
"""Name of the journal in a run folder."""


def answer_line(number: int, question: Question, answer: Answer) -> AnswerLine:
    """Return an answer as its journal line."""
    return AnswerLine(
        kind="answer",
        number=number,
        episode=question.episode,
        step=question.step,
        pose=question.pose.tolist(),
        start=question.start.tolist(),
        action=question.action,
        reached=question.reached.tolist(),
        predicted=question.predicted.tolist(),
        reason=question.reason,
        right=answer.right,
        better=answer.better,
        source=answer.source,
        seconds=answer.seconds,
    )


class JournalFile:
    """A journal, of answers or of keys, open for appending. Close it."""

    def __init__(self, path: Path) -> None:
        """Open a journal, or begin one; a last line cut off by a crash goes.

        Raises:
            BadInputError: the journal cannot be written.
        """
        try:
            _cut_torn_line(path)
            self._file = path.open("a", encoding="utf-8")
        except OSError as error:
            raise BadInputError(f"journal {path} must be writable, the system says: {error.strerror}") from error

    def append(self, line: ReportModel) -> None:
        """Append a line; it is on disk when this returns."""
        self._file.write(json.dumps(line.model_dump(mode="json"), sort_keys=True, allow_nan=False) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class JournalledOracle(Oracle):
    """An oracle whose every answer is written down, and that gives written answers again instead of asking.

    A run that is continued asks, from its checkpoint on, the very questions it asked before; those already
    answered are taken from the journal in order, so that no one is asked twice.

    Attributes:
        questions: number of questions answered so far, from the journal or by asking.
    """

    def __init__(self, oracle: Oracle, path: Path, position: int) -> None:
        """Open the journal at ``path`` for an oracle; the first ``position`` answers are in the checkpoint already.

        Raises:
            BadInputError: the journal cannot be written, is damaged, is shorter than the checkpoint says, or
                was changed where the run has learned from it.
        """
        self.questions = position
        self._oracle = oracle
        self._path = path
        self._progress = ""
        records = read_records(path) if path.exists() else Records()
        _check(path, records, position)
        self._written = records.items
        # Kept up to date rather than counted anew: a run may ask tens of thousands of questions.
        self._earlier = [item.earlier for item in records.withdrawable]
        self._pending = records.pending
        self._file = JournalFile(path)

    def answer(self, question: Question) -> Answer:
        """Return the written answer, or ask, write the answer down and return it.

        Raises:
            BadInputError: the journal does not fit the run, or the oracle's answer is none.
            PauseRequested: who answers wants to go on another time.
        """
        if self.questions < len(self._written):
            answer = written_answer(self._written[self.questions], question, self._path)
        else:
            progress = question.progress or self._progress
            answer = self._asked(replace(question, number=self.questions, progress=progress))
        self.questions += 1
        return answer

    def learning(self, progress: str) -> None:
        """Pass on how the learning goes, and keep it for the next question."""
        self._progress = progress
        self._oracle.learning(progress)

    def close(self) -> None:
        """Close the journal and the oracle."""
        self._file.close()
        self._oracle.close()

    def _asked(self, question: Question) -> Answer:
        while True:
            answer = self._oracle.answer(replace(question, earlier=tuple(self._earlier)))
            _check_answer(answer, len(self._earlier), question)
            for _ in range(answer.undo):
                self._file.append(_undo_line(self._earlier.pop(), question))
            self._pending += answer.undo
            if not answer.again:
                break
        line = answer_line(question.number, question, answer)
        self._file.append(line)
        record = Record(line, self._pending)
        self._pending = 0
        if line.right is not None:
            self._earlier.append(record.earlier)
        return record.answer


def written_answer(record: Record, question: Question, path: Path) -> Answer:
    """Return a written answer again.

    Raises:
        BadInputError: it is the answer to another question.
    """
    if not record.fits(question):
        line = record.line
        raise BadInputError(
            f"journal {path}: answer {line.number} must be to the question the run asks (episode {question.episode},"
            f" step {question.step}, action {question.action}), found episode {line.episode}, step {line.step}, action"
            f" {line.action}; config, seed and every earlier answer must be those of the journal"
        )
    return record.answer


def _check(path: Path, records: Records, position: int) -> None:
    if len(records.items) < position:
        raise BadInputError(f"journal {path}: must hold the {position} answers of the run, found {len(records.items)}")
    late = [item.line.number for item in records.items[:position] if item.learned]
    if late:
        raise BadInputError(
            f"journal {path}: answer {late[0]} must be the one the run has learned from, found it edited afterwards;"
            " train anew with oracle=replay and this journal"
        )


def _check_answer(answer: Answer, withdrawable: int, question: Question) -> None:
    if not 0 <= answer.undo <= withdrawable:
        raise BadInputError(f"undo: must be 0 to {withdrawable}, the answers that stand, found {answer.undo}")
    if answer.better is not None and (answer.right is not True) == (answer.better == question.action):
        raise BadInputError(
            f"right: must be true exactly if the better action is the one asked about ({question.action}), found"
            f" {answer.right} with better action {answer.better}"
        )


def _undo_line(item: Earlier, question: Question) -> UndoLine:
    return UndoLine(
        kind="undo", number=item.number, before=question.number, episode=question.episode, step=question.step
    )


def _cut_torn_line(path: Path) -> None:
    if not path.exists():
        return
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("rb+") as file:
            file.truncate(whole)
