"""Questions, and an oracle that undoes, for tests of journals."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.replay import JournalledOracle


def question(number: int) -> Question:
    rng = np.random.default_rng(number)
    before, start, reached, predicted = rng.normal(size=(4, 7))
    return Question(number // 3, number % 3, before, start, number % 10, reached, predicted, "far", candidates=None)


class Reader(Oracle):
    """Gives prepared answers in order and keeps what it was asked."""

    def __init__(self, answers: Iterable[Answer]) -> None:
        self.answers = list(answers)
        self.asked: list[Question] = []

    def answer(self, question: Question) -> Answer:
        self.asked.append(question)
        return self.answers[len(self.asked) - 1]


def written(path: Path, answers: Iterable[Answer]) -> list[Answer]:
    """Write a journal of answers to questions 0, 1, 2, ... and return what the run was told."""
    reader = Reader(answers)
    oracle = JournalledOracle(reader, path, 0)
    told: list[Answer] = []
    while len(reader.asked) < len(reader.answers):
        told.append(oracle.answer(question(len(told))))
    oracle.close()
    return told
