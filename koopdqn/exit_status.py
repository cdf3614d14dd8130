"""How a command ends: an error becomes one line on standard error and an exit status."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator

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
    try:
        with _terminated_as_interrupted():
            return work()
    except KeyboardInterrupt:
        console.note("koopdqn: interrupted; everything so far is kept")
        return INTERRUPTED
    except BrokenPipeError:
        # the reader went away (`koopdqn ... | head`); the interpreter flushes stdout once more when it ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return WorkFailedError.exit_status
    except Exception as error:
        return _report(error, debug=debug)


def _report(error: Exception, *, debug: bool) -> int:
    from koopdqn.config.explain import explain

    if debug:
        import traceback

        traceback.print_exception(error)
    known = error if isinstance(error, KoopdqnError) else explain(error)
    if known is not None:
        console.fail(str(known))
        return known.exit_status
    again = "" if debug else "; run again with --debug"
    console.fail(f"internal error: {type(error).__name__}: {error}{again}")
    return WorkFailedError.exit_status


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM end the work as Ctrl-C does. Only the main thread may set handlers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
