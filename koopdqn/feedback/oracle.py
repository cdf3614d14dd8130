"""The oracle: who says right or wrong where the intent model is not trusted (getHumanFeedback in Algorithm 1)."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from koopdqn.config.settings import Name, Settings
from koopdqn.pose import Array

if TYPE_CHECKING:
    from koopdqn.tasks.task import Task


@dataclass(frozen=True)
class Question:
    """A question: was this action right?

    Attributes:
        episode: number of the episode.
        step: step within it.
        pose: before the action (7,).
        action: index of the action in Table 1, from 0.
        reached: pose after it (7,).
        predicted: where the intent model would have gone (7,).
        reason: why it is asked, for people.
    """

    episode: int
    step: int
    pose: Array
    action: int
    reached: Array
    predicted: Array
    reason: str


@dataclass(frozen=True)
class Answer:
    """An answer.

    Attributes:
        right: whether the action was right; None if the question was skipped, which is not a no.
        source: who answered.
        seconds: how long the answer took [s]; it is recorded and shapes nothing.
    """

    right: bool | None
    source: str
    seconds: float = 0.0


@runtime_checkable
class Oracle(Protocol):
    """Whoever answers questions: a script, a person, a file, another program."""

    def answer(self, question: Question) -> Answer:
        """Return the answer to a question."""

    def close(self) -> None:
        """Release what the oracle holds (a terminal, a file)."""


class OracleSettings(Settings, ABC):
    """Settings of an oracle; a new kind of oracle is a subclass and a YAML file."""

    name: Name

    @abstractmethod
    def open(self, task: "Task", seed: int) -> Oracle:
        """Return the oracle for a task, its chance (if any) fixed by the seed."""
