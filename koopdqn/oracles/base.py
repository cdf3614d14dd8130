"""The oracle: who says right or wrong where the intent model is not trusted (getHumanFeedback in Algorithm 1)."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from koopdqn.errors import BadInputError, KoopdqnError
from koopdqn.pose import Array
from koopdqn.settings import Count, Name, Settings, shown

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Workcell


class PauseRequested(KoopdqnError):  # noqa: N818 (a wish of the person's, no fault)
    """Whoever answers wants to go on another time: what is answered is kept, and the command ends with status 130."""

    exit_status = 130


@dataclass(frozen=True)
class Earlier:
    """An answer given before, which may still be withdrawn.

    Attributes:
        number: of the answer, from 0.
        episode: number of its episode.
        step: step within it.
        action: index of the action that was asked about.
        right: the answer.
    """

    number: int
    episode: int
    step: int
    action: int
    right: bool | None


@dataclass(frozen=True)
class Place:
    """Where a question stands among those put off in an episode and asked at its end.

    Attributes:
        number: of the question, from 1.
        expected: how many there are if every answer is yes; a no ends them.
    """

    number: int
    expected: int


@dataclass(frozen=True)
class Question:
    """A question: was this action right?

    Attributes:
        episode: number of the episode.
        step: step within it.
        pose: before the action (7,).
        start: where the episode began (7,).
        action: index of the action (:data:`koopdqn.tasks.actions.NAMES`), from 0.
        reached: pose after it (7,).
        predicted: where the intent model would have gone (7,).
        reason: why it is asked, for people.
        number: questions answered before this one.
        left: questions that the budget leaves, this one included; None without a budget.
        candidates: the poses (A, 7) that Table 1's actions reach and, where actions are continuous, the model's
            suggestion; None if unknown.
        choosable: which of these (A,) may be named as better: what the task allows and what does something; None if
            unknown.
        progress: one line about how the learning goes, for people.
        earlier: the answers that may be withdrawn, oldest first.
        place: among the questions of its episode; None if it is asked at once.
    """

    episode: int
    step: int
    pose: Array
    start: Array
    action: int
    reached: Array
    predicted: Array
    reason: str
    number: int = 0
    left: int | None = None
    candidates: Array | None = None
    choosable: np.ndarray | None = None
    progress: str = ""
    earlier: Sequence[Earlier] = ()
    place: Place | None = None


@dataclass(frozen=True)
class Answer:
    """An answer. NumPy's own booleans and numbers become Python's.

    Attributes:
        right: whether the action was right; None if the question was skipped, which is not a no.
        source: who answered.
        seconds: how long the answer took [s]; it is recorded and shapes nothing.
        better: index of the action that would have been right; None if nothing was said. Unless it is the
            action asked about, ``right`` is false with it.
        undo: how many earlier answers, the latest first, are withdrawn before this one stands; skipped questions
            are none.
        again: nothing is answered yet but the undo is to be written down; the same question is asked again.
    """

    right: bool | None
    source: str
    seconds: float = 0.0
    better: int | None = None
    undo: int = 0
    again: bool = False

    def __post_init__(self) -> None:
        """Raise BadInputError if a value is none that it may be."""
        for name, (rule, holds) in _RULES.items():
            value = getattr(self, name)
            if isinstance(value, np.generic):
                value = value.item()
                object.__setattr__(self, name, value)
            if not holds(value):
                raise BadInputError(f"{name}: must be {rule}, found {shown(value)}")


# An oracle of one's own may return anything, and what is not False would count as a yes.
_RULES: Final[dict[str, tuple[str, Callable[[Any], bool]]]] = {
    "right": ("True, False or None", lambda value: value is None or isinstance(value, bool)),
    "source": ("a text that is not empty", lambda value: isinstance(value, str) and value != ""),
    "seconds": ("a finite number, 0 or above", lambda value: isinstance(value, int | float) and 0 <= value < math.inf),
    "better": ("a whole number or None", lambda value: value is None or type(value) is int),
    "undo": ("a whole number", lambda value: type(value) is int),
    "again": ("True or False", lambda value: isinstance(value, bool)),
}


class Oracle(ABC):
    """Whoever answers questions: a script, a person, a file, another program."""

    @abstractmethod
    def answer(self, question: Question) -> Answer:
        """Return the answer to a question.

        Raises:
            PauseRequested: who answers wants to go on another time.
        """

    def learning(self, progress: str) -> None:
        """Hear how the learning goes, in one line; called between two rounds, so often that it must be quick.

        Raises:
            PauseRequested: who answers wants to go on another time.
        """
        return

    def close(self) -> None:
        """Release what the oracle holds (a terminal, a file)."""
        return


class Asking(Settings):
    """When questions are asked, how many at most, and what follows then."""

    budget: Count | None = Field(default=None, description="most questions asked; null for no limit")
    when_spent: Literal["stop", "distrust", "scripted"] = Field(
        default="stop",
        description="when the budget is spent: stop training, give no reward outside the trust domain, or ask the"
        " scripted oracle",
    )
    ask: Literal["at_once", "episode"] = Field(
        default="at_once",
        description="when to ask: where a question arises, or all of an episode together when it has ended",
    )
    gather_most: Count = Field(
        default=10, description="with ask=episode: questions put off in an episode, which ends at so many"
    )


class OracleSettings(Asking, ABC):
    """Settings of an oracle; a new kind of oracle is a subclass and a YAML file."""

    shows_progress: ClassVar[bool] = False
    """Whether the oracle itself shows on the terminal how the learning goes."""

    simulated: ClassVar[bool] = False
    """Whether it stands in for a person, and sees nothing of the scene."""

    name: Name

    def check(self) -> None:
        """Say before any work whether the oracle can work here.

        Raises:
            BadInputError: it cannot; the message names the alternatives.
        """

    @abstractmethod
    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle.

        Args:
            workcell: task, arm and scene that the questions are about.
            seed: fixes the oracle's chance, if it has any.
            folder: the run folder, for what the oracle keeps.
        """


class CustomOracle(OracleSettings, Oracle):
    """Base of an oracle of one's own: settings and oracle in one class. Subclass it and write ``answer``.

    Fields of the class are keys of ``conf/oracle/`` and of the command line, checked as all others are.

    Attributes:
        workcell: task, arm and scene, there from ``prepare`` on.
        seed: of the run, for whatever chance the oracle has.
        folder: the run folder, for whatever it keeps.
    """

    _workcell: "Workcell | None" = PrivateAttr(None)
    _seed: int = PrivateAttr(0)
    _folder: Path = PrivateAttr(Path())

    @property
    def workcell(self) -> "Workcell":
        """Task, arm and scene that the questions are about."""
        assert self._workcell is not None, "there from prepare on"
        return self._workcell

    @property
    def seed(self) -> int:
        """The run's seed."""
        return self._seed

    @property
    def folder(self) -> Path:
        """The run folder."""
        return self._folder

    def prepare(self) -> None:
        """Open what answering needs; called once, before the first question."""

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return itself, prepared."""
        self._workcell, self._seed, self._folder = workcell, seed, folder
        self.prepare()
        return self
