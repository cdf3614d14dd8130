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
"""Exit status of a command ended by Ctrl-C or SIGTERM."""


def guard(work: Callable[[], int], *, debug: bool) -> int:
    """Run ``work`` and return its exit status; an error becomes one line on standard error and its status.

    Args:
        work: returns an exit status.
        debug: whether to print the traceback of an error first.
    """
    received: list[int] = []
    try:
        with _interruptible(received):
            return work()
    except (_Interruption, KeyboardInterrupt):
        return _interrupted()
    except BrokenPipeError:
        # the reader went away (`koopdqn ... | head`); the interpreter flushes stdout once more when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return WorkFailedError.exit_status
    except Exception as error:
        # a module in C that is interrupted while it is imported turns the interruption into an error of its own
        return _interrupted() if received else _report(error, debug=debug)


class _Interruption(BaseException):
    """Ctrl-C or SIGTERM.

    No KeyboardInterrupt: where one passes through code that an extension module runs, Python kills itself with
    SIGINT in the end, even though the exception was caught.
    """


def _interrupted() -> int:
    console.note("koopdqn: interrupted; everything so far is kept")
    return INTERRUPTED


def _report(error: Exception, *, debug: bool) -> int:
    from koopdqn.app.hydra.compose import explain

    if debug:
        import traceback

        traceback.print_exception(error)
    known = error if isinstance(error, KoopdqnError) else explain(error)
    if known is not None and known.exit_status == INTERRUPTED:
        console.note(f"koopdqn: {known}; everything so far is kept")
        return INTERRUPTED
    if known is not None:
        console.fail(str(known))
        return known.exit_status
    again = "" if debug else "; run again with --debug"
    console.fail(f"internal error: {type(error).__name__}: {error}{again}")
    return WorkFailedError.exit_status


@contextlib.contextmanager
def _interruptible(received: list[int]) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the work, and note them. Only the main thread may set handlers."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(number)
        raise _Interruption

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
