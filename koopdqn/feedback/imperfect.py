"""An imperfect teacher: the demonstrator's answers, some of them wrong, some never given; to try out what that does."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from koopdqn.config.settings import Fraction
from koopdqn.feedback.oracle import Answer, Oracle, OracleSettings, Question
from koopdqn.feedback.scripted import ScriptedOracle

if TYPE_CHECKING:
    from koopdqn.workcell import Workcell

_STREAM = 4
"""Keeps the oracle's chance apart from that of training, which is seeded alike."""


class ImperfectOracleSettings(OracleSettings):
    """Settings of a scripted oracle that errs or says nothing."""

    wrong: Fraction = Field(description="share of the answers that are turned over")
    silent: Fraction = Field(description="share of the questions that are skipped")

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle; what it does with a question depends on the seed and the question's number alone."""
        return ImperfectOracle(ScriptedOracle(workcell.task, self.name), self.wrong, self.silent, seed)


@dataclass(frozen=True)
class ImperfectOracle(Oracle):
    """Passes on another oracle's answers, some turned over, some kept back.

    Attributes:
        expert: whose answers these are.
        wrong: probability that a given answer is turned over.
        silent: probability that a question is skipped.
        seed: of the chance.
    """

    expert: Oracle
    wrong: float
    silent: float
    seed: int

    def answer(self, question: Question) -> Answer:
        """Return the expert's answer, its opposite, or none."""
        answer = self.expert.answer(question)
        # A generator for each question: a run that goes on does not ask again what was answered.
        errs, skips = np.random.default_rng([self.seed, _STREAM, question.number]).random(2)
        if answer.right is None or skips < self.silent:
            return replace(answer, right=None)
        return replace(answer, right=answer.right != bool(errs < self.wrong))
