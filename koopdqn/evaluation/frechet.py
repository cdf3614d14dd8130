"""The discrete Fréchet distance, for many pairs of curves at once."""

import numpy as np

from koopdqn.pose import Array


def discrete_frechet(gap: Array) -> Array:
    """Return the discrete Fréchet distances (E,) of curve pairs from the distances (E, N, M) between their points.

    It is the least leash with which two walkers can go along the two rows of points, neither ever
    going back (Eiter & Mannila 1994). The recursion c(i, j) = max(min(c(i−1, j), c(i−1, j−1), c(i, j−1)),
    d(i, j)) is run along anti-diagonals, whose entries do not depend on one another.

    Raises:
        ValueError: a curve has no points, or the shape is another.
    """
    if gap.ndim != 3 or 0 in gap.shape[1:]:
        raise ValueError(f"distances must have shape (E, N, M) with N, M >= 1, found {gap.shape}")
    count, n, m = gap.shape
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
    return np.asarray(last[:, n])
