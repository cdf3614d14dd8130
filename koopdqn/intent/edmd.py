"""Extended dynamic mode decomposition: the Koopman matrix from pairs of states (Eqs. 5–12)."""

from dataclasses import dataclass

import numpy as np

from koopdqn.intent.observables import Observables
from koopdqn.pose import Array


def snapshot_pairs(trajectories: list[Array]) -> tuple[Array, Array]:
    """Return states (M, d) and their successors (M, d), paired within each trajectory (N, d) and never across two."""
    before = np.concatenate([trajectory[:-1] for trajectory in trajectories])
    after = np.concatenate([trajectory[1:] for trajectory in trajectories])
    return before, after


def koopman_matrix(before: Array, after: Array, ridge: float = 0.0) -> Array:
    """Return the Koopman matrix K (D, D) of lifted pairs (M, D) → (M, D), Eqs. 9–12.

    With ``ridge`` 0 it is the paper's K = A G†. It is computed as Y X† from the data itself, which is the
    same matrix (A = YXᵀ/M, G = XXᵀ/M) without squaring the condition number. With ``ridge`` λ > 0 it is
    K = I + (A − G)(G + λI)⁻¹, the least-squares solution drawn toward standing still rather than
    toward the origin, so that regularisation shortens no position.
    """
    if ridge == 0.0:
        solution, *_ = np.linalg.lstsq(before, after, rcond=None)
        return np.asarray(solution.T)
    count, size = before.shape
    gram = before.T @ before / count
    cross = after.T @ before / count
    return np.asarray(np.eye(size) + np.linalg.solve(gram + ridge * np.eye(size), (cross - gram).T).T)


@dataclass(frozen=True)
class KoopmanModel:
    """A linear model of the next state in lifted space: g(x') = K g(x), Eqs. 13, 14.

    States are shifted by ``center`` and divided by ``scale`` before they are lifted.

    Attributes:
        observables: the lift g.
        center: (d,) the state taken as origin.
        scale: the unit of the shifted state.
        matrix: K (D, D).
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
    ) -> "KoopmanModel":
        """Return the model fitted to states (M, d) and their successors (M, d)."""
        lifted, then = (observables.lift((states - center) / scale) for states in (before, after))
        return cls(observables, center, scale, koopman_matrix(lifted, then, ridge))

    def lift(self, states: Array) -> Array:
        """Return the lifted states (N, D) of states (N, d)."""
        return self.observables.lift((states - self.center) / self.scale)

    def project(self, lifted: Array) -> Array:
        """Return the states (N, d) of lifted states (N, D)."""
        return self.center + self.scale * self.observables.project(lifted, len(self.center))

    def predict(self, states: Array) -> Array:
        """Return the predicted next states (N, d) of states (N, d)."""
        # Only the state's own rows of K matter for one step.
        rows = self.matrix[: len(self.center)]
        return np.asarray(self.center + self.scale * (self.lift(states) @ rows.T))

    def spectral_radius(self) -> float:
        """Return the largest absolute eigenvalue of K: over 1, repeated linear steps diverge."""
        return float(np.abs(np.linalg.eigvals(self.matrix)).max())
