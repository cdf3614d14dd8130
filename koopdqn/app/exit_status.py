"""How a command ends: an error becomes one line on standard error and an exit status."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType

from koopdqn import console
from koopdqn.errors import KoopdqnError, WorkFailedError

INTERRUPTED = 130
"""Exit status of a command ended by Ctrl-C, SIGTERM, or a terminal that was closed (SIGHUP)."""
KEPT = "everything so far is kept"


def open_missing_streams() -> set[str]:
    """Point standard streams that were closed before this process began at nothing, and return their names.

    Otherwise the next file that is opened takes the place of one, and gets what is printed.
    """
    missing = {name for name in ("stdin", "stdout", "stderr") if getattr(sys, name) is None}
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if name in missing:
            nothing = os.open(os.devnull, os.O_RDWR)
            if nothing != number:
                os.dup2(nothing, number)
                os.close(nothing)
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    return missing


def let_go_of_closed_streams() -> None:
    """Point standard output and error at nothing where their other end is gone.

    The interpreter flushes both once more when it ends, and would end with a status of its own.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError, AttributeError):
            with contextlib.suppress(OSError, ValueError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def guard(work: Callable[[], int], *, debug: bool) -> int:
    """Run ``work`` and return its exit status; an error becomes one line on standard error and its status.

    With ``debug`` the traceback of an error is printed first.
    """
    received: list[int] = []
    try:
        with _interruptible(received):
            return work()
    except (_Interruption, KeyboardInterrupt) as interruption:
        return _interrupted(interruption)
    except BrokenPipeError:
        # the reader went away (`koopdqn ... | head`); the interpreter flushes stdout once more when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return WorkFailedError.exit_status
    except Exception as error:
        # a module in C that is interrupted while it is imported turns the interruption into an error of its own
        return _interrupted(error) if received else _report(error, debug=debug)


class _Interruption(BaseException):
    """Ctrl-C, SIGTERM or SIGHUP.

    No KeyboardInterrupt: where one passes through code that an extension module runs, Python kills itself with
    SIGINT in the end, even though the exception was caught.
    """


def _interrupted(error: BaseException, what: str = "interrupted") -> int:
    # The terminal may be gone.
    with contextlib.suppress(OSError, ValueError):
        # The notes say what goes on with the work.
        console.note("; ".join([f"koopdqn: {what}", KEPT, *getattr(error, "__notes__", [])]))
    return INTERRUPTED


def _report(error: Exception, *, debug: bool) -> int:
    from koopdqn.app.hydra.compose import explain

    if debug:
        import traceback

        traceback.print_exception(error)
    known = error if isinstance(error, KoopdqnError) else explain(error)
    if known is not None and known.exit_status == INTERRUPTED:
        return _interrupted(known, str(known))
    if known is not None:
        console.fail(str(known))
        return known.exit_status
    again = "" if debug else "; run again with --debug"
    console.fail(f"internal error: {type(error).__name__}: {error}{again}")
    return WorkFailedError.exit_status


@contextlib.contextmanager
def _interruptible(received: list[int]) -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP end the work, and note them. Only the main thread may set handlers."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise _Interruption

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = [signal.SIGINT, signal.SIGTERM]
    # Under nohup a run outlives its terminal.
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
