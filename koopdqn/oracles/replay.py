"""Training from a journal: its answers are given again, in order, without anyone being asked."""

from pathlib import Path
from typing import TYPE_CHECKING

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import Answer, Oracle, OracleSettings, Question
from koopdqn.oracles.journal import read_records, written_answer
from koopdqn.settings import PathText

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
        """Read the journal at ``path``.

        Raises:
            BadInputError: the journal cannot be read or is damaged.
        """
        self._path = path
        self._items = read_records(path).items

    def answer(self, question: Question) -> Answer:
        """Return the answer that has the question's number.

        Raises:
            BadInputError: it is the answer to another question, or the journal has no more answers.
        """
        if question.number >= len(self._items):
            raise BadInputError(
                f"journal {self._path}: must hold an answer to every question of the run, found {len(self._items)}"
                f" answers and one more question (episode {question.episode}, step {question.step}, action"
                f" {question.action})"
            )
        return written_answer(self._items[question.number], question, self._path)
