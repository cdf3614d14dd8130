"""Corrections: an intent model that a handful of answers move where they were given, and nowhere else."""

from dataclasses import dataclass, field

import numpy as np

from koopdqn import pose
from koopdqn.intent.edmd import KoopmanModel
from koopdqn.intent.model import IntentModel
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import StartFrame

# Of a correction's reach: where it has died out. At the reach itself a tenth of it is left.
_SUPPORT = 1.7
# A pair corrects the orientations within this angle of its own [rad].
_SUPPORT_RAD = 0.35
# Of a lone pair's weight: pairs that contradict each other at one place are averaged.
_RIDGE = 0.01


@dataclass(frozen=True)
class CorrectedIntent(IntentModel):
    """An intent model with additional observables around the poses of additional pairs.

    Every pair adds one observable, a bump of compact support (Wendland's C² function) around its pose. Their rows of K
    are fitted to what the base model leaves of the pairs, so that the prediction goes through them, stays as it was
    beyond the bumps' reach, and the goal stays where it was.

    Attributes:
        base: the model as it was fitted.
        poses: (M, 7) the pairs' poses.
        following: (M, 7) where a person would go from them.
    """

    base: IntentModel
    poses: Array
    following: Array
    _weights: Array = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Fit the bumps' weights (M, 6) [m, rad] to the residuals."""
        residual = _difference(self.following, self.base.predict(self.poses))
        bumps = self._bumps(self.poses)
        gram = bumps.T @ bumps + _RIDGE * np.eye(len(self.poses))
        object.__setattr__(self, "_weights", np.linalg.solve(gram, bumps.T @ residual))

    @property
    def goal(self) -> Array:  # type: ignore[override]  # what a model holds as a field this one takes from its base
        """The goal pose (7,)."""
        return self.base.goal

    @property
    def reach(self) -> float:  # type: ignore[override]
        """How far a correction reaches [m]."""
        return self.base.reach

    @property
    def start_frame(self) -> StartFrame:  # type: ignore[override]
        """The base's frame."""
        return self.base.start_frame

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7)."""
        predicted = self.base.predict(poses)
        change = self._bumps(poses) @ self._weights
        turned = pose.multiply(predicted[:, pose.QUATERNION], pose.from_rotation_vector(change[:, 3:]))
        # A quaternion that is not turned keeps its bits.
        turned = np.where(np.any(change[:, 3:] != 0.0, axis=1, keepdims=True), turned, predicted[:, pose.QUATERNION])
        return pose.make(predicted[:, pose.POSITION] + change[:, :3], turned)

    def to_step(self, poses: Array, predicted: Array, step: float) -> Array:
        """Return predictions (N, 7) as motions of one step, as the base scales them."""
        return self.base.to_step(poses, predicted, step)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """The Koopman models of the base."""
        return self.base.matrices

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the base's arrays and the pairs."""
        return {**self.base.arrays(), "pairs_before": self.poses, "pairs_after": self.following}

    def extended(self, poses: Array, following: Array) -> IntentModel:
        """Return the model with further pairs of poses (M, 7) and next poses (M, 7)."""
        together = np.concatenate([self.poses, poses]), np.concatenate([self.following, following])
        return CorrectedIntent(self.base, *together)

    def _bumps(self, poses: Array) -> Array:
        position = poses[:, pose.POSITION]
        far = _distances(position, self.poses[:, pose.POSITION]) / (_SUPPORT * self.reach)
        cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T), 0.0, 1.0)
        turned = 2.0 * np.arccos(cosine) / _SUPPORT_RAD
        left = _distances(position, self.goal[None, pose.POSITION]) / self.reach
        return _wendland(far) * _wendland(turned) * (1.0 - _wendland(left))


def _wendland(radius: Array) -> Array:
    return np.asarray(np.maximum(1.0 - radius, 0.0) ** 4 * (4.0 * radius + 1.0))


def _distances(a: Array, b: Array) -> Array:
    return np.asarray(np.linalg.norm(a[:, None] - b[None], axis=2))


def _difference(poses: Array, others: Array) -> Array:
    """Return x, y, z [m] and the rotation vector [rad] (N, 6) from other poses (N, 7) to poses (N, 7)."""
    turn = pose.multiply(pose.conjugate(others[:, pose.QUATERNION]), poses[:, pose.QUATERNION])
    moved = poses[:, pose.POSITION] - others[:, pose.POSITION]
    return np.concatenate([moved, pose.to_rotation_vector(turn)], axis=1)
