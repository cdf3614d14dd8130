"""Threads of the numerical libraries, set for a whole command: sums in another order end in other bits."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from koopdqn.errors import BadInputError

_VARIABLES: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let BLAS, OpenMP and torch use a number of threads in the block, whatever the environment asks for.

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
