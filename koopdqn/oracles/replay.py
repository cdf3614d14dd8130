"""Written answers given again: by a run that goes on, which then asks and writes on, and by training from a journal."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import Answer, Earlier, Oracle, OracleSettings, Question
from koopdqn.oracles.journal import AnswerLine, JournalFile, Record, Records, UndoLine, read_records
from koopdqn.settings import PathText, shown
from koopdqn.tasks.actions import COUNT

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Workcell


class ReplayOracleSettings(OracleSettings):
    """Settings of the oracle that replays a journal."""

    journal: PathText | None

    def check(self) -> None:
        """Raise BadInputError unless a readable journal is given."""
        read_records(self._given())

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle; it has no chance and keeps nothing."""
        return ReplayOracle(self._given())

    def _given(self) -> Path:
        if self.journal is None:
            raise BadInputError("oracle.journal: must name the journal to replay (journal=FILE), found nothing")
        return self.journal


class ReplayOracle(Oracle):
    """Gives a journal's answers again, those that were withdrawn later included, and the withdrawals."""

    def __init__(self, path: Path) -> None:
        """Read the journal at ``path``; BadInputError if it is damaged."""
        self._path = path
        self._items = read_records(path).items

    def answer(self, question: Question) -> Answer:
        """Return the answer of the question's number; BadInputError if there is none or it answers another question."""
        if question.number >= len(self._items):
            raise BadInputError(
                f"journal {self._path}: must hold an answer to every question of the run, found {len(self._items)}"
                f" answers and one more question (episode {question.episode}, step {question.step}, action"
                f" {question.action})"
            )
        return recorded_answer(self._items[question.number], question, self._path)


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
        self._again = len(records.items)
        # Kept up to date rather than counted anew: a run may ask tens of thousands of questions.
        self._earlier = [item.earlier for item in records.withdrawable]
        self._pending = records.pending
        self._file = JournalFile(path)

    @property
    def caught_up(self) -> bool:
        """Whether every answer that was written before has been given again, and fitted the run."""
        return self.questions >= self._again

    def answer(self, question: Question) -> Answer:
        """Return the written answer, or ask, write the answer down and return it.

        Raises:
            BadInputError: the journal does not fit the run, or the oracle's answer is none.
            PauseRequested: who answers wants to go on another time.
        """
        if self.questions < len(self._written):
            answer = recorded_answer(self._written[self.questions], question, self._path)
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
            try:
                check_answer(answer, question)
                check_said(answer, len(self._earlier), question)
            except BadInputError as error:
                raise BadInputError(f"the answer to question {question.number}: {error}") from error
            undone = [_undo_line(self._earlier.pop(), question) for _ in range(answer.undo)]
            self._pending += answer.undo
            if not answer.again:
                break
            self._file.append(*undone)
        line = answer_line(question.number, question, answer)
        # Together: what answers through files gives them both again after a stop.
        self._file.append(*undone, line)
        record = Record(line, self._pending)
        self._pending = 0
        if line.right is not None:
            self._earlier.append(record.earlier)
        return record.answer


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


def recorded_answer(record: Record, question: Question, path: Path) -> Answer:
    """Return a written answer again; BadInputError if it is the answer to another question."""
    line = record.line
    same = (line.episode, line.step, line.action) == (question.episode, question.step, question.action)
    if not same or not np.array_equal(line.pose, question.pose):
        raise BadInputError(
            f"journal {path}: answer {line.number} must be to the question the run asks (episode {question.episode},"
            f" step {question.step}, action {question.action}), found episode {line.episode}, step {line.step}, action"
            f" {line.action}{' at another pose' if same else ''}; config, seed, oracle.ask and every earlier answer"
            " must be those of the journal (after an edit: koopdqn feedback edit --drop-later asks later ones anew)"
        )
    answer = record.answer
    try:
        check_answer(answer, question)
    except BadInputError as error:
        raise BadInputError(f"journal {path}: answer {line.number}: {error}") from error
    return answer


def _check(path: Path, records: Records, position: int) -> None:
    if len(records.items) < position:
        raise BadInputError(f"journal {path}: must hold the {position} answers of the run, found {len(records.items)}")
    items = (item for item in records.items[:position] if item.learned is not None)
    late = [item.line.number for item in items if item.learned != (item.line.right, item.line.better)]
    if late:
        raise BadInputError(
            f"journal {path}: answer {late[0]} must be the one the run has learned from, found it edited afterwards;"
            " train anew with oracle=replay and this journal"
        )


def check_said(answer: Answer, withdrawable: int, question: Question) -> None:
    """Raise BadInputError if it withdraws more answers than stand, or its better action belies whether it is right."""
    if not 0 <= answer.undo <= withdrawable:
        raise BadInputError(f"undo: must be 0 to {withdrawable}, the answers that stand, found {answer.undo}")
    if answer.better is not None and answer.right is not (answer.better == question.action):
        raise BadInputError(
            f"right: must be true exactly if the better action is the one asked about ({question.action}), found"
            f" {answer.right} with better action {answer.better}"
        )


def check_answer(answer: object, question: Question) -> None:
    """Raise BadInputError if it is no answer, or names as better what is no action or is never right there."""
    if not isinstance(answer, Answer):
        raise BadInputError(f"oracle: answer must return a koopdqn.oracles.base.Answer, found {shown(answer)}")
    named = COUNT if question.candidates is None else len(question.candidates)
    if answer.better is None:
        return
    if not 0 <= answer.better < named:
        raise BadInputError(f"better: must be an action from 0 to {named - 1}, found {answer.better}")
    if question.choosable is not None and not question.choosable[answer.better]:
        valid = ", ".join(map(str, np.flatnonzero(question.choosable)))
        raise BadInputError(f"better: must be an action that can be right there, {valid}, found {answer.better}")


def _undo_line(item: Earlier, question: Question) -> UndoLine:
    return UndoLine(
        kind="undo", number=item.number, before=question.number, episode=question.episode, step=question.step
    )
