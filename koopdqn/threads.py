"""Threads of the numerical libraries, set for a whole command, and two halves of an update on a core each."""

import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from typing import Final

from koopdqn.errors import BadInputError

# Fewer rows are done in less time than it takes to hand them over.
_LEAST_ROWS: Final = 64
# Halves begin where the libraries' blocks of rows do.
_BLOCK: Final = 16
_VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let BLAS, OpenMP and torch use a number of threads in the block, whatever the environment asks for.

    Sums in another order end in other bits.

    Args:
        count: of each library; with the same count the same work gives the same bits.

    Raises:
        BadInputError: a library takes another number.
    """
    # Loaded first, since only what is loaded can be told; torch, if it comes later, reads the variables.
    import numpy as np  # noqa: F401
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_info, threadpool_limits

    before = {name: os.environ.get(name) for name in _VARIABLES}
    torch = sys.modules.get("torch")
    torch_before = torch.get_num_threads() if torch else None
    os.environ.update(dict.fromkeys(_VARIABLES, str(count)))
    try:
        with threadpool_limits(limits=count):
            for library in threadpool_info():
                if library["num_threads"] != count:
                    raise BadInputError(
                        f"train.threads: must be a number that every library takes, found {count}, of which"
                        f" {library['internal_api']} takes {library['num_threads']}"
                    )
            if torch:
                torch.set_num_threads(count)
            yield
    finally:
        if torch:
            torch.set_num_threads(torch_before)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def in_halves(count: int, work: Callable[[slice], None]) -> None:
    """Do work on the first and on the second half of rows, side by side.

    Args:
        count: of the rows.
        work: with the slice of a half; computes no gradients, and gains only where it lets go of the interpreter's
            lock, as torch does.
    """
    parts = halves(count)
    if len(parts) == 1:
        work(parts[0])
    else:
        side_by_side(lambda half: work(parts[half]))


def halves(count: int) -> list[slice]:
    """Return the slices of both halves of rows, or the one of all where that is faster.

    How rows are parted depends on their number alone, not on the machine, so that the same work gives the same bits.
    """
    if count < 2 * _LEAST_ROWS:
        return [slice(0, count)]
    middle = (count // 2 + _BLOCK - 1) // _BLOCK * _BLOCK
    return [slice(0, middle), slice(middle, count)]


def side_by_side(work: Callable[[int], None]) -> None:
    """Do work 0 and work 1 on a core each; as of :func:`in_halves`."""
    import torch

    threads = torch.get_num_threads()

    def second() -> None:
        # A thread has a number of its own.
        if torch.get_num_threads() != threads:
            torch.set_num_threads(threads)
        work(1)

    beside = _helper().submit(second)
    try:
        work(0)
    finally:
        beside.result()


@cache
def _helper() -> ThreadPoolExecutor:
    import torch

    return ThreadPoolExecutor(1, "halves", lambda: torch.set_grad_enabled(False))


# A forked process has none of its parent's threads.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helper.cache_clear)
