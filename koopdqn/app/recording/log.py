"""The log of a recording: every key that counted, on disk before the next, so that a killed session goes on."""

from pathlib import Path
from typing import Annotated, Final, Literal, cast

from pydantic import Field, TypeAdapter, ValidationError

from koopdqn.app.recording.settings import DemoSettings
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.files import LARGEST_JSON, digest, parse_json
from koopdqn.schema import ReportModel, Sha256
from koopdqn.settings import Name, NonNegative, NonNegativeInt, Positive, Settings
from koopdqn.tasks.workcell import Workcell


class SessionLine(ReportModel):
    """What the keys were pressed for; the same keys for the same make the same demonstrations."""

    kind: Literal["session"] = Field(description="what the line is")
    task: Name = Field(description="the task")
    workcell: Sha256 = Field(description="SHA-256 of the settings of task and robot")
    seed: NonNegativeInt = Field(description="by which the starts are drawn")
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


def logged_keys(path: Path, session: SessionLine) -> str:
    """Return the keys of a recording's log; none where there is no log. A last line cut off by a crash is left out.

    Raises:
        BadInputError: the log is damaged, or is of a recording for something else.
    """
    if not path.exists():
        return ""
    try:
        if path.stat().st_size > LARGEST_JSON:
            raise ValueError(f"more than {LARGEST_JSON} bytes")
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise BadInputError(f"{path} must be a readable text file, found: {error}") from error
    keys = []
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            read = _LINE.validate_python(parse_json(line))
        except (ValueError, ValidationError) as error:
            raise BadInputError(f"{path}, line {number}: must be a line of a recording, found {line[:60]!r}") from error
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
