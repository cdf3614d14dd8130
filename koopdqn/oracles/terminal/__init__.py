"""A person at a terminal teaches the arm: the settings here, and beside them the screen, its picture, the keys."""

from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from koopdqn.oracles.base import Oracle, OracleSettings
from koopdqn.oracles.journal import copy_answers, read_records
from koopdqn.oracles.terminal.device import Graphics, check_graphics, require_terminal
from koopdqn.run_folder import JOURNAL
from koopdqn.settings import Name, PathText

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Workcell


class TerminalOracleSettings(OracleSettings):
    """Settings of a person at the terminal."""

    shows_progress: ClassVar[bool] = True

    teacher: Name = Field(description="who answers; written to the journal")
    graphics: Graphics = Field(description="how the picture is drawn")
    journal: PathText | None = Field(description="answers to begin with, of an earlier run")

    def check(self) -> None:
        """Raise BadInputError if nobody can be asked here, or the journal to begin with cannot be read."""
        require_terminal("oracle=terminal", "use oracle=scripted, oracle=file, or oracle=replay journal=FILE")
        check_graphics(self.graphics, "oracle.graphics")
        if self.journal is not None:
            read_records(self.journal)

    def open(self, workcell: "Workcell", seed: int, folder: Path) -> Oracle:
        """Return the oracle; a new run's journal begins with a copy of the given one."""
        from koopdqn.oracles.terminal.oracle import TerminalOracle

        if self.journal is not None and not (folder / JOURNAL).exists():
            copy_answers(self.journal, folder / JOURNAL)
        return TerminalOracle(workcell, self.teacher, self.graphics, folder)
