"""The discrete Fréchet distance, for many pairs of curves at once."""

import numpy as np

from koopdqn.pose import Array

# Pairs handled together: 64 pairs of 200 points keep the table of distances under 25 MB.
_TOGETHER = 64


def discrete_frechet(first: Array, second: Array) -> Array:
    """Return the discrete Fréchet distances (E,) between curves (E, N, D) and (E, M, D), in their unit.

    It is the least leash with which two walkers can go along the two rows of points, neither ever
    going back (Eiter & Mannila 1994). The recursion c(i, j) = max(min(c(i−1, j), c(i−1, j−1), c(i, j−1)),
    d(i, j)) is run along anti-diagonals, whose entries do not depend on one another.

    Raises:
        ValueError: the curves have no points, or their shapes do not fit.
    """
    if first.ndim != 3 or second.ndim != 3 or first.shape[::2] != second.shape[::2] or 0 in first.shape + second.shape:
        raise ValueError(f"curves must have shapes (E, N, D) and (E, M, D), found {first.shape} and {second.shape}")
    parts = range(0, len(first), _TOGETHER)
    return np.concatenate([_frechet(first[i : i + _TOGETHER], second[i : i + _TOGETHER]) for i in parts])


def _frechet(first: Array, second: Array) -> Array:
    count, n, m = len(first), first.shape[1], second.shape[1]
    gap = np.linalg.norm(first[:, :, None] - second[:, None], axis=3)  # (E, N, M)
    # Column i + 1 of a diagonal holds row i of the table; column 0 stands for the row before the first.
    before = np.full((count, n + 1), np.inf)
    last = before.copy()
    for diagonal in range(n + m - 1):
        rows = np.arange(max(0, diagonal - m + 1), min(n, diagonal + 1))
        if diagonal:
            # from (i−1, j), (i, j−1) on the last diagonal and (i−1, j−1) on the one before
            least = np.minimum(np.minimum(last[:, rows], last[:, rows + 1]), before[:, rows])
        else:
            least = np.zeros((count, 1))
        before, last = last, np.full((count, n + 1), np.inf)
        last[:, rows + 1] = np.maximum(least, gap[:, rows, diagonal - rows])
    return last[:, n]
