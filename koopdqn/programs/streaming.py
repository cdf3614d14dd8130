"""A program sent to a UR's controller sample by sample while the arm moves, over RTDE by the library ur_rtde.

Where the connection is lost ur_rtde tries to come back without end, and neither a key nor Ctrl-C gets through to
Python. So a process of its own talks to the controller, and this one watches the keys, and ends it if it falls silent.
"""

import contextlib
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, Final, cast

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
SILENT_S: Final = 1.0
"""How long nothing may come of a sample before the connection counts as lost [s]."""
_CONNECTING_S: Final = 30.0
# What the process that talks to the controller says: before a sample, at the end, or instead of one.
_ASKED, _ENDED, _FAILED = "asked", "ended", "failed"
# To stop the arm, before the process that talks to it is killed.
_ENDING_S: Final = 5.0
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
    processes = get_context("spawn")
    ours, theirs = processes.Pipe()
    courier = processes.Process(target=_deliver, args=(host, motion.period, motion.joints, theirs), daemon=True)
    courier.start()
    theirs.close()
    try:
        return _watched(ours, host, stop)
    finally:
        # Of whoever waits for an answer this is the end: the arm is stopped.
        ours.close()
        courier.join(_ENDING_S)
        courier.kill()
        courier.join()


def _watched(link: Connection, host: str, stop: Callable[[], bool]) -> Streamed:
    """Return what became of the program as the process that streams it says, which asks before a sample whether to."""
    if not link.poll(_CONNECTING_S):
        raise WorkFailedError(
            f"a UR's controller must answer at {host} within {_CONNECTING_S:g} s, found none that does"
        )
    made = Streamed(0, "", 0.0, 0.0)
    # Where it died there is nobody to hear or to tell.
    with contextlib.suppress(EOFError, ConnectionError):
        while link.poll(SILENT_S):
            said, told = link.recv()
            if said == _FAILED:
                raise told
            made = cast(Streamed, told)
            if said == _ENDED:
                return made
            link.send(stop())
    return replace(made, stopped=f"the connection lost: nothing came of a sample within {SILENT_S:g} s")


def _deliver(host: str, period: float, joints: np.ndarray, link: Connection) -> None:
    """Send samples (N, 6) [rad] in their own time, asking before each whether to stop, and say what came of it."""
    # Keys and signals are the other process's to see.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    # A link that ends says that the other process did.
    with contextlib.suppress(EOFError, ConnectionError):
        try:
            with (
                _connected(host, "rtde_receive", "RTDEReceiveInterface", -1.0, _FIELDS) as state,
                _connected(host, "rtde_control", "RTDEControlInterface", 1.0 / period) as control,
            ):
                try:
                    link.send((_ENDED, _send(period, joints, state, control, link)))
                finally:
                    control.servoStop(_STOP_RAD_S2)
                    control.stopScript()
        except (BadInputError, WorkFailedError) as error:
            link.send((_FAILED, error))


def _send(period: float, samples: np.ndarray, state: Any, control: Any, link: Connection) -> Streamed:
    late = off = 0.0
    begun = time.monotonic()
    for index, joints in enumerate(samples[1:]):
        due = begun + index * period
        time.sleep(max(due - time.monotonic(), 0.0))
        late = max(late, time.monotonic() - due)
        off = max(off, float(np.abs(np.array(state.getActualQ()) - samples[index]).max()))
        link.send((_ASKED, Streamed(index, "", late, off)))
        why = "a key was pressed" if link.recv() else _why_stop(state, late, off)
        if not why and not control.servoJ(joints.tolist(), 0.0, 0.0, period, LOOKAHEAD_S, GAIN):
            why = _problem(state) or "the controller took no more samples"
        if why:
            return Streamed(index, why, late, off)
    # The last sample is followed, too, before the arm is stopped.
    time.sleep(period + LOOKAHEAD_S)
    return Streamed(len(samples) - 1, "", late, off)


def _why_stop(state: Any, late: float, off: float) -> str:
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
