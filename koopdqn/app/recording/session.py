"""A recording on disk: every key that counted, before the next, so that a killed session goes on."""

from pathlib import Path
from typing import Annotated, Final, Literal, cast

from pydantic import Field, TypeAdapter, ValidationError

from koopdqn.app.recording import DemoSettings
from koopdqn.app.recording.recorder import Recorder, Reply
from koopdqn.artifact import described
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.files import digest
from koopdqn.oracles.journal import JournalFile, numbered_lines
from koopdqn.settings import Name, NonNegative, NonNegativeInt, Positive, ReportModel, Settings, Sha256, shown
from koopdqn.tasks.workcell import Workcell


class SessionLine(ReportModel):
    """The settings of a recording: the same keys under the same settings make the same demonstrations."""

    kind: Literal["session"] = Field(description="what the line is")
    task: Name = Field(description="the task")
    workcell: Sha256 = Field(description="SHA-256 of the settings of task and robot")
    seed: NonNegativeInt = Field(description="of the draws of starts")
    step_m: Positive = Field(description="what a key moves to begin with [m]")
    turn_rad: Positive = Field(description="what a key turns to begin with [rad]")
    rounding_m: NonNegative = Field(description="over how much of the path corners are rounded off [m]")
    speed_m_s: Positive = Field(description="with which the path is played [m/s]")
    sample_seconds: Positive = Field(description="between two samples [s]")


class KeyLine(ReportModel):
    """A key that changed something; what was refused is not written."""

    kind: Literal["key"] = Field(description="what the line is")
    key: Annotated[str, Field(min_length=1, max_length=1)] = Field(description="the key")


LOG: Final = "keys.jsonl"
"""Name of the log in a run folder."""


_LINE: TypeAdapter[SessionLine | KeyLine] = TypeAdapter(Annotated[SessionLine | KeyLine, Field(discriminator="kind")])


def session_line(workcell: Workcell, settings: DemoSettings, seed: int) -> SessionLine:
    """Return the first line of a recording's log."""
    keyboard = settings.keyboard
    return SessionLine(
        kind="session",
        task=workcell.task.name,
        workcell=digest({"task": described(workcell.task), "robot": described(cast(Settings, workcell.arm))}),
        seed=seed,
        step_m=keyboard.step_m,
        turn_rad=keyboard.turn_rad,
        rounding_m=keyboard.rounding_m,
        speed_m_s=settings.speed_m_s,
        sample_seconds=settings.sample_seconds,
    )


def read_keys(path: Path, session: SessionLine) -> str:
    """Return the keys of a recording's log; none where there is no log. A last line cut off by a crash is left out.

    Raises:
        BadInputError: the log is damaged, or is of a recording for something else.
    """
    keys = []
    for number, line in numbered_lines(path) if path.exists() else ():
        try:
            read = _LINE.validate_python(line)
        except ValidationError as error:
            raise BadInputError(f"{path}, line {number}: must be a line of a recording, found {shown(line)}") from error
        if isinstance(read, SessionLine) != (number == 1):
            raise BadInputError(
                f"{path}, line {number}: the first line and no other must be a session's, found {read.kind}"
            )
        if isinstance(read, SessionLine):
            _check_same(path, read, session)
        else:
            keys.append(read.key)
    return "".join(keys)


def _check_same(path: Path, logged: SessionLine, session: SessionLine) -> None:
    before, now = logged.model_dump(), session.model_dump()
    for key, value in before.items():
        if value != now[key]:
            raise BadInputError(f"run: {key} must be as the recording began with ({value}, {path}), found {now[key]}")


class Recording:
    """A recorder whose every key and every demonstration is on disk before the next key. Close it.

    Attributes:
        recorder: what is recorded.
    """

    def __init__(self, workcell: Workcell, settings: DemoSettings, seed: int, folder: Path, name: str) -> None:
        """Begin in a run folder, or go on with the recording that it holds.

        Args:
            workcell: task, arm and scene.
            settings: how keys move the arm and how paths are played.
            seed: of the draws of starts.
            folder: the run folder.
            name: of the file of demonstrations in it.

        Raises:
            BadInputError: what the folder holds is damaged, or is of another recording.
        """
        self.recorder = Recorder(workcell, settings, seed)
        self._workcell = workcell
        self._path = folder / name
        session = session_line(workcell, settings, seed)
        log = folder / LOG
        keys = read_keys(log, session)
        before = self.demonstrations()
        for number, key in enumerate(keys, start=2):
            before = self.demonstrations()
            reply = self.recorder.press(key, sure=True)
            if not reply.changed:
                raise BadInputError(f"{log}, line {number}: {shown(key)} must do what it did then, found: {reply.text}")
        self._check_file(before)
        begun = log.exists() and b"\n" in log.read_bytes()
        self._log = JournalFile(log)
        if not begun:
            self._log.append(session)
        self._written = -1
        self._write()

    def demonstrations(self) -> Demonstrations | None:
        """Return what is kept so far, or None if nothing is."""
        kept = self.recorder.state.kept
        return Demonstrations(self._workcell.task.name, self._workcell.arm.name, kept) if kept else None

    def press(self, key: str) -> Reply:
        """Do what a key says; what it changed is on disk when this returns."""
        reply = self.recorder.press(key)
        if reply.changed:
            self._log.append(KeyLine(kind="key", key=key))
            self._write()
        return reply

    def close(self) -> None:
        """Close the log."""
        self._log.close()

    def _write(self) -> None:
        count = len(self.recorder.state.kept)
        if count == self._written:
            return
        kept = self.demonstrations()
        if kept is not None:
            write_hdf5(self._path, kept)
        else:
            # Its one demonstration was taken back; the log holds it.
            self._path.unlink(missing_ok=True)
        self._written = count

    def _check_file(self, before: Demonstrations | None) -> None:
        """Raise unless the file of demonstrations is that of the log, or of the log ``before`` its last key."""
        if not self._path.exists():
            return
        found, kept = read_hdf5(self._path), self.demonstrations()
        if found.digest() not in [item.digest() for item in (kept, before) if item is not None]:
            recorded = len(self.recorder.state.kept)
            raise BadInputError(
                f"run: {self._path} must hold the {recorded} demonstrations that {LOG} beside it records,"
                f" found {len(found)} that differ"
            )
