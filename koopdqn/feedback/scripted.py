"""The scripted oracle: the task's own demonstrator answers, as an expert who is always right (§1)."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from koopdqn.environment.compare import within_tolerance
from koopdqn.feedback.oracle import Answer, Oracle, OracleSettings, Question
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

if TYPE_CHECKING:
    from koopdqn.workcell import Workcell


class ScriptedOracleSettings(OracleSettings):
    """Settings of the scripted oracle: none of its own."""

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle that answers from the task's demonstrator; it has no chance and keeps nothing."""
        return ScriptedOracle(workcell.task, self.name)


@dataclass(frozen=True)
class ScriptedOracle(Oracle):
    """Says right if the reached pose is within tolerance of where the demonstrator would be.

    Attributes:
        task: whose demonstrator answers.
        name: written to the journal as the source.
    """

    task: Task
    name: str = "scripted"

    def answer(self, question: Question) -> Answer:
        """Return the demonstrator's answer."""
        right = demonstrator_agrees(self.task, question.pose[None], question.reached[None], question.start[None])[0]
        return Answer(bool(right), self.name)


def demonstrator_wishes(task: Task, poses: Array, starts: Array) -> Array:
    """Return where the demonstrator would be (N, 7) a step after poses (N, 7) of episodes from ``starts`` (N, 7)."""
    frame = task.person_frame
    return frame.unplaced(task.demonstrator.next_pose(frame.placed(poses, starts)), starts, poses)


def demonstrator_agrees(task: Task, poses: Array, reached: Array, starts: Array | None = None) -> np.ndarray:
    """Return whether the demonstrator finds each reached pose (N, 7) right from each pose (N, 7), as booleans (N,).

    Args:
        task: whose demonstrator.
        poses: before the actions.
        reached: after them.
        starts: (N, 7) where the episodes began; None where poses are told as from the nominal start.
    """
    if starts is None:
        return within_tolerance(reached, task.demonstrator.next_pose(poses), task)
    return within_tolerance(reached, demonstrator_wishes(task, poses, starts), task)
