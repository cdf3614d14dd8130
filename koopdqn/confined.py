"""Reading in a process of its own, bounded in time and memory: for formats whose library may hang or grow."""

import json
import os
import resource
import signal
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from koopdqn.errors import BadInputError

SECONDS: Final = 25.0
"""How many seconds of computing reading may take, in twice as many of the clock."""
MOST_BYTES: Final = 2**28
"""How many bytes of numbers may be read."""

# For what the library needs besides.
_OWN_BYTES: Final = 2**30
# The largest file that a library may unpack.
_UNPACKED_BYTES: Final = 2**32
_LONGEST_ABOUT: Final = 2**24

Content = tuple[Any, list[np.ndarray]]
"""What is read: JSON values, and arrays of float64."""


def confined(read: Callable[[], Content], seconds: float = SECONDS) -> Content:
    """Return what a function reads, having run it in a process of its own.

    Args:
        read: reads a file; it must not use more than it needs, since whatever threads ran before are not there.
        seconds: of computing that it may take, in twice as many of the clock.

    Raises:
        BadInputError: what it raised as such, or that it failed, took too long or too much memory, or was killed.
    """
    # What a library unpacks goes with the folder, even if the process is killed.
    with TemporaryDirectory(prefix="koopdqn-") as folder:
        ours, theirs = Pipe(duplex=False)
        with warnings.catch_warnings():
            # The child only reads a file and ends at once, which is safe beside threads.
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            ours.close()
            tempfile.tempdir = folder
            _serve(read, theirs, seconds)
        theirs.close()
        try:
            return _received(ours, 2.0 * seconds)
        except BaseException:
            with suppress(OSError):
                os.kill(child, signal.SIGKILL)
            raise
        finally:
            ours.close()
            os.waitpid(child, 0)


def _serve(read: Callable[[], Content], pipe: Connection, seconds: float) -> None:
    """Read, write what came of it to a pipe, and end this process without running anything of the parent's."""
    try:
        # What the library prints of a damaged file says nothing to anyone.
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_DFL)
        most = _virtual_bytes() + _OWN_BYTES + 2 * MOST_BYTES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 1))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (_UNPACKED_BYTES, _UNPACKED_BYTES))
        arrays: list[np.ndarray] = []
        try:
            about, arrays = read()
            total = sum(8 * values.size for values in arrays)
            if total > MOST_BYTES:
                raise BadInputError(f"must hold at most {MOST_BYTES} bytes of numbers, found {total}")
            head = {"about": about, "shapes": [values.shape for values in arrays]}
        except BadInputError as error:
            # What a library says may take several lines.
            head = {"refused": " ".join(filter(None, map(str.strip, str(error).splitlines())))}
        except MemoryError:
            head = {"refused": "reading it must not take more memory than its numbers, found that it does"}
        # a library may raise anything for a damaged file
        except Exception as error:
            head = {"failed": " ".join(str(error).split()) or type(error).__name__}
        pipe.send_bytes(json.dumps(head).encode())
        for values in arrays if "about" in head else []:
            pipe.send_bytes(np.ascontiguousarray(values, dtype="<f8").tobytes())
    finally:
        os._exit(0)


def _virtual_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _received(pipe: Connection, seconds: float) -> Content:
    until = time.monotonic() + seconds

    def message(most: int) -> bytes:
        if not pipe.poll(max(until - time.monotonic(), 0.0)):
            raise BadInputError(
                f"reading it must take at most {seconds:.3g} s, found that it takes longer: it is damaged"
            )
        return pipe.recv_bytes(most)

    try:
        head = json.loads(message(_LONGEST_ABOUT))
        if "about" not in head:
            raise BadInputError(head["refused"] if "refused" in head else f"reading it failed: {head['failed'][:300]}")
        arrays = [np.frombuffer(message(MOST_BYTES), dtype="<f8").reshape(shape).copy() for shape in head["shapes"]]
    # The pipe has ended, or a message is longer than it may be.
    except (EOFError, OSError) as error:
        raise BadInputError(
            "reading it failed: the library gave up on it or took too long, so that it is damaged or too large"
        ) from error
    return head["about"], arrays
