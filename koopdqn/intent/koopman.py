"""Extended dynamic mode decomposition: the Koopman matrix from pairs of states (Eqs. 5–12)."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from koopdqn.intent.observables import Observables
from koopdqn.pose import Array

# From so many pairs on, they are lifted and summed block by block; a block fits the processor's cache.
_AT_ONCE: Final = 100_000
_BLOCK: Final = 4096


def snapshot_pairs(trajectories: list[Array]) -> tuple[Array, Array]:
    """Return states (M, d) and their successors (M, d) in trajectories (N, d); no pair spans two trajectories."""
    before = np.concatenate([trajectory[:-1] for trajectory in trajectories])
    after = np.concatenate([trajectory[1:] for trajectory in trajectories])
    return before, after


def koopman_rows(before: Array, after: Array, weight: Array, ridges: tuple[float, ...]) -> list[Array]:
    """Return the first R rows (R, D) of the Koopman matrix K for each ridge, Eqs. 9–12.

    With a ridge of 0 it is the paper's K = A G†, computed as Y X†: the same matrix (A = YXᵀ/M, G = XXᵀ/M) without
    squaring the condition number. With a ridge λ > 0 it is K = I + (A − G)(G + λI)⁻¹, which regularises toward the
    identity: drawing K to zero would shrink positions. The sums over the pairs are shared by all ridges.

    Args:
        before: lifted states (M, D).
        after: the first R entries (M, R) of their lifted successors; one-step prediction needs only the state's.
        weight: of the pairs (M,).
        ridges: λ of each.
    """
    size, rows = before.shape[1], after.shape[1]
    root = np.sqrt(weight)[:, None]
    moments: tuple[Array, Array] | None = None
    found = []
    for ridge in ridges:
        if ridge == 0.0:
            solution, *_ = np.linalg.lstsq(before * root, after * root, rcond=None)
            found.append(np.asarray(solution.T))
            continue
        if moments is None:
            weighted = before * (weight / weight.sum())[:, None]
            moments = weighted.T @ before, weighted.T @ (after - before[:, :rows])
        gram, change = moments
        found.append(np.eye(rows, size) + np.linalg.solve(gram + ridge * np.eye(size), change).T)
    return found


def koopman_of_blocks(blocks: Iterable[tuple[Array, Array, Array]], ridge: float = 0.0) -> Array:
    """Return K (D, D) of lifted pairs in blocks (M, D) → (M, D) with weights (M,), in memory for one block.

    It equals :func:`koopman_rows` up to rounding. With ``ridge`` 0 only the triangular factor of the pairs is kept
    (tall-skinny QR, Demmel et al. 2012), which does not square the condition number; otherwise the sums A and G.

    Raises:
        ValueError: there are no pairs.
    """
    count, total = 0, 0.0
    factor: Array | None = None
    sums: tuple[Array, Array] | None = None
    for before, after, weight in blocks:
        count, total = count + len(before), total + float(weight.sum())
        if ridge == 0.0:
            pairs = np.sqrt(weight)[:, None] * np.concatenate([before, after], axis=1)
            factor = np.asarray(np.linalg.qr(pairs if factor is None else np.concatenate([factor, pairs]), mode="r"))
        else:
            weighted = before * weight[:, None]
            found = weighted.T @ before, weighted.T @ (after - before)
            sums = found if sums is None else (sums[0] + found[0], sums[1] + found[1])
    if factor is not None:
        size = factor.shape[1] // 2
        cut = np.finfo(float).eps * max(count, size)
        return np.asarray(np.linalg.lstsq(factor[:, :size], factor[:, size:], rcond=cut)[0].T)
    if sums is None:
        raise ValueError("K must be fitted to at least one pair, found none")
    gram, change = sums[0] / total, sums[1] / total
    return np.asarray(np.eye(len(gram)) + np.linalg.solve(gram + ridge * np.eye(len(gram)), change).T)


def within_radius(matrix: Array, radius: float) -> Array:
    """Return K (D, D) with eigenvalues scaled to absolute values of at most ``radius``: the spectral constraint.

    With a radius of 1 repeated linear steps do not diverge, below 1 they converge to the center.
    """
    values, vectors = np.linalg.eig(matrix)
    size = np.abs(values)
    if size.max() <= radius:
        return matrix
    scaled = values * np.minimum(1.0, radius / np.maximum(size, 1e-12))
    return np.asarray(np.linalg.solve(vectors.T, (vectors * scaled).T).T.real)


@dataclass(frozen=True)
class KoopmanModel:
    """A linear model of the next state in lifted space: g(x') = K g(x), Eqs. 13, 14.

    States are shifted by ``center`` and divided by ``scale`` before they are lifted.

    Attributes:
        observables: the lift g.
        center: (d,) the state taken as origin.
        scale: the unit of the shifted state.
        matrix: K (D, D), or its first d rows.
    """

    observables: Observables
    center: Array
    scale: float
    matrix: Array

    @classmethod
    def fit(
        cls,
        observables: Observables,
        before: Array,
        after: Array,
        center: Array,
        scale: float,
        ridge: float = 0.0,
        weight: Array | None = None,
    ) -> "KoopmanModel":
        """Return the model fitted to states (M, d) and their successors (M, d) with weights (M,)."""
        fitted = observables.fitted_to((before[:: 1 + len(before) // _AT_ONCE] - center) / scale)
        weight = np.ones(len(before)) if weight is None else weight

        def lifted(rows: slice) -> tuple[Array, Array, Array]:
            now, then = (fitted.lift_to_fit((states[rows] - center) / scale) for states in (before, after))
            return now, then, weight[rows]

        if len(before) < _AT_ONCE:
            return cls(fitted, center, scale, koopman_rows(*lifted(slice(None)), (ridge,))[0])
        blocks = (lifted(slice(first, first + _BLOCK)) for first in range(0, len(before), _BLOCK))
        return cls(fitted, center, scale, koopman_of_blocks(blocks, ridge))

    @classmethod
    def one_step(
        cls,
        observables: Observables,
        before: Array,
        after: Array,
        center: Array,
        scale: float,
        ridges: tuple[float, ...],
        weight: Array,
    ) -> "list[KoopmanModel]":
        """Return the model of each ridge, with the state's rows (d, D) of K only: enough to predict."""
        fitted = observables.fitted_to((before - center) / scale)
        rows = koopman_rows(fitted.lift_to_fit((before - center) / scale), (after - center) / scale, weight, ridges)
        return [cls(fitted, center, scale, matrix) for matrix in rows]

    def lift(self, states: Array) -> Array:
        """Return the lifted states (N, D) of states (N, d)."""
        return self.observables.lift((states - self.center) / self.scale)

    def predict(self, states: Array) -> Array:
        """Return the predicted next states (N, d) of states (N, d)."""
        # One step needs only the state's rows of K.
        rows = self.matrix[: len(self.center)]
        return np.asarray(self.center + self.scale * (self.lift(states) @ rows.T))

    def spectral_radius(self) -> float:
        """Return the largest absolute eigenvalue of K; above 1 repeated linear steps diverge."""
        return float(np.abs(np.linalg.eigvals(self.matrix)).max())
