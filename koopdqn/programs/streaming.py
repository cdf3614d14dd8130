"""A program sent to a UR's controller sample by sample while the arm moves, over RTDE by the library ur_rtde."""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from pydantic import Field

from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.programs.settings import GAIN, LOOKAHEAD_S
from koopdqn.programs.timing import Motion
from koopdqn.settings import Name, Settings

AT_START_RAD: Final = 0.01
"""Most that a joint may be off the program's first sample when it begins [rad]."""
OFF_RAD: Final = 0.5
"""Most that a joint may be off what it was sent: servoj follows about 0.1 s behind [rad]."""
LATE_S: Final = 0.1
"""Most that a sample may be sent late [s]."""
_STOP_RAD_S2: Final = 10.0
_RUNNING: Final = 7
"""The controller's robot mode when the arm is powered and its brakes are released."""
_FIELDS: Final = ["timestamp", "actual_q", "robot_mode", "safety_status_bits", "runtime_state"]


class StreamSettings(Settings):
    """Where a program is streamed to, and whether the arm moves."""

    host: Name | None = Field(description="address of the controller; null: none, the program is made and checked")
    move: bool = Field(description="whether anything is sent; else the arm's state is read and nothing more")


@dataclass(frozen=True)
class Streamed:
    """What became of a program that was streamed.

    Attributes:
        sent: number of samples sent.
        stopped: why it ended before its last sample, or an empty string.
        late_s: most that a sample was sent late [s].
        off_rad: most that a joint was off the sample sent before [rad].
    """

    sent: int
    stopped: str
    late_s: float
    off_rad: float


def read_state(host: str, motion: Motion, *, moves: bool) -> None:
    """Check that the arm stands where a motion starts, and if it ``moves``, that it is ready; nothing is sent.

    Raises:
        BadInputError: the extra is not installed.
        WorkFailedError: no controller answers, the arm stands elsewhere than the program starts, or it is not ready.
    """
    with _connected(host, "rtde_receive", "RTDEReceiveInterface", -1.0, _FIELDS) as state:
        joints = np.array(state.getActualQ())
        apart = np.abs(joints - motion.joints[0])
        if apart.max() > AT_START_RAD:
            stands = ",".join(f"{angle:.4f}" for angle in joints)
            raise WorkFailedError(
                f"the arm must stand within {AT_START_RAD:g} rad of the program's start, found joint"
                f" {int(apart.argmax()) + 1} {apart.max():.3f} rad off; 'start=[{stands}]' starts where it stands"
            )
        if moves and (problem := _problem(state)):
            raise WorkFailedError(f"the arm must be ready to move, found {problem}")


def stream(host: str, motion: Motion, stop: Callable[[], bool]) -> Streamed:
    """Send the samples of a motion in its own time, and stop the arm at the end, whatever ends it.

    The arm stands at its start (:func:`read_state`). ``stop`` is asked before every sample whether to stop.

    Raises:
        BadInputError: the extra is not installed.
        WorkFailedError: no controller answers, or it takes no commands.
    """
    hertz = 1.0 / motion.period
    with (
        _connected(host, "rtde_receive", "RTDEReceiveInterface", -1.0, _FIELDS) as state,
        _connected(host, "rtde_control", "RTDEControlInterface", hertz) as control,
    ):
        try:
            return _send(motion, state, control, stop)
        finally:
            control.servoStop(_STOP_RAD_S2)
            control.stopScript()


def _send(motion: Motion, state: Any, control: Any, stop: Callable[[], bool]) -> Streamed:
    late = off = 0.0
    begun = time.monotonic()
    for index, joints in enumerate(motion.joints[1:]):
        due = begun + index * motion.period
        time.sleep(max(due - time.monotonic(), 0.0))
        late = max(late, time.monotonic() - due)
        off = max(off, float(np.abs(np.array(state.getActualQ()) - motion.joints[index]).max()))
        why = _why_stop(stop, state, late, off)
        if not why and not control.servoJ(joints.tolist(), 0.0, 0.0, motion.period, LOOKAHEAD_S, GAIN):
            why = _problem(state) or "the controller took no more samples"
        if why:
            return Streamed(index, why, late, off)
    # The last sample is followed, too, before the arm is stopped.
    time.sleep(motion.period + LOOKAHEAD_S)
    return Streamed(len(motion.joints) - 1, "", late, off)


def _why_stop(stop: Callable[[], bool], state: Any, late: float, off: float) -> str:
    if stop():
        return "a key was pressed"
    if problem := _problem(state):
        return problem
    if off > OFF_RAD:
        return f"a joint was {off:.3f} rad off what it was sent, at most {OFF_RAD:g} rad allowed"
    return f"a sample was {late:.3f} s late, at most {LATE_S:g} s allowed" if late > LATE_S else ""


def _problem(state: Any) -> str:
    """Return what keeps the arm from moving, or an empty string."""
    if not state.isConnected():
        return "the connection lost"
    if state.isEmergencyStopped():
        return "an emergency stop"
    if state.isProtectiveStopped():
        return "a protective stop"
    mode = int(state.getRobotMode())
    return "" if mode == _RUNNING else f"robot mode {mode}, not {_RUNNING} (running)"


@contextlib.contextmanager
def _connected(host: str, module: str, interface: str, *arguments: Any) -> Iterator[Any]:
    """Yield one of ur_rtde's interfaces to a controller, and close it."""
    import importlib

    try:
        library = importlib.import_module(module)
    except ImportError as error:
        raise BadInputError(
            "stream.host: streaming needs ur_rtde, found it not installed: pip install 'koopdqn[rtde]'"
        ) from error
    try:
        connection = getattr(library, interface)(host, *arguments)
    except (RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise WorkFailedError(f"a UR's controller must answer at {host}, found none that does: {reason}") from error
    try:
        yield connection
    finally:
        connection.disconnect()
