"""A user's own oracle: one class, whose fields are its options in YAML."""

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import PrivateAttr

from koopdqn.oracles.base import Oracle, OracleSettings

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Workcell


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
