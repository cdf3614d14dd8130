"""Scripted oracles: the task's demonstrator answers, always right (§1), or wrong and silent by chance."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydantic import Field

from koopdqn.oracles.base import Answer, Oracle, OracleSettings, Question
from koopdqn.settings import Fraction
from koopdqn.tasks.actions import within_tolerance
from koopdqn.tasks.task import Task, demonstrator_next_poses

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Workcell


class ScriptedOracleSettings(OracleSettings):
    """Settings of the scripted oracle: none of its own."""

    simulated: ClassVar[bool] = True

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle that answers from the task's demonstrator; it has no chance and keeps nothing."""
        return ScriptedOracle(workcell.task, self.name)


@dataclass(frozen=True)
class ScriptedOracle(Oracle):
    """Says right if the reached pose is within tolerance of where the task's demonstrator would be."""

    task: Task
    name: str = "scripted"

    def answer(self, question: Question) -> Answer:
        """Return the demonstrator's answer."""
        wished = demonstrator_next_poses(self.task, question.pose[None], question.start[None])
        return Answer(bool(within_tolerance(question.reached[None], wished, self.task)[0]), self.name)


_STREAM = 4
"""Keeps the oracle's chance apart from that of training, which is seeded alike."""


class ImperfectOracleSettings(OracleSettings):
    """Settings of a scripted oracle that errs or says nothing."""

    simulated: ClassVar[bool] = True

    wrong: Fraction = Field(description="share of the answers that are turned over")
    silent: Fraction = Field(description="share of the questions that are skipped")

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle; what it does with a question depends on the seed and the question's number alone."""
        return ImperfectOracle(ScriptedOracle(workcell.task, self.name), self.wrong, self.silent, seed)


@dataclass(frozen=True)
class ImperfectOracle(Oracle):
    """Passes on another oracle's answers: some are turned over, others skipped, each with its own probability."""

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
