"""Reading in a process of its own, bounded in time and memory: for formats whose library may hang or grow."""

import json
import os
import resource
import select
import signal
import struct
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
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
_HEAD: Final = struct.Struct("<Q")
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
        ours, theirs = os.pipe()
        with warnings.catch_warnings():
            # The child only reads a file and ends at once, which is safe beside threads.
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            os.close(ours)
            tempfile.tempdir = folder
            _serve(read, theirs, seconds)
        os.close(theirs)
        try:
            return _received(ours, 2.0 * seconds)
        except BaseException:
            with suppress(OSError):
                os.kill(child, signal.SIGKILL)
            raise
        finally:
            os.close(ours)
            os.waitpid(child, 0)


def _serve(read: Callable[[], Content], pipe: int, seconds: float) -> None:
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
        text = json.dumps(head).encode()
        with os.fdopen(pipe, "wb") as file:
            file.write(_HEAD.pack(len(text)) + text)
            for values in arrays if "about" in head else []:
                file.write(np.ascontiguousarray(values, dtype="<f8").tobytes())
    finally:
        os._exit(0)


def _virtual_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


def _received(pipe: int, seconds: float) -> Content:
    until = time.monotonic() + seconds
    (length,) = _HEAD.unpack(_exactly(pipe, _HEAD.size, until, seconds))
    if length > _LONGEST_ABOUT:
        raise BadInputError(f"it must not say more than {_LONGEST_ABOUT} bytes about itself, found {length}")
    head = json.loads(_exactly(pipe, length, until, seconds))
    if "about" not in head:
        raise BadInputError(head["refused"] if "refused" in head else f"reading it failed: {head['failed'][:300]}")
    shapes = [tuple(shape) for shape in head["shapes"]]
    sizes = [8 * int(np.prod(shape, dtype=np.int64)) for shape in shapes]
    arrays = [
        np.frombuffer(_exactly(pipe, size, until, seconds), dtype="<f8").reshape(shape)
        for shape, size in zip(shapes, sizes, strict=True)
    ]
    return head["about"], arrays


def _exactly(pipe: int, count: int, until: float, seconds: float) -> bytearray:
    found = bytearray()
    while len(found) < count:
        left = until - time.monotonic()
        if left <= 0 or not select.select([pipe], [], [], left)[0]:
            raise BadInputError(
                f"reading it must take at most {seconds:.3g} s, found that it takes longer: it is damaged"
            )
        part = os.read(pipe, min(count - len(found), 2**20))
        if not part:
            raise BadInputError(
                "reading it failed: the library gave up on it or took too long, so that it is damaged or too large"
            )
        found += part
    return found
