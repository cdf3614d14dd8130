"""Corrections: an intent model that goes where answers say around the poses that they were given for."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.pose import Array
from koopdqn.tasks.start_frame import StartFrame

# Orientations farther than this from a pair's [rad] are not moved by it.
_SUPPORT_RAD = 0.35
# Nearer to the goal than this [m] corrections fade, so that it stays where it is.
_GOAL_M = 0.015
# Of two poses this near [m] none is nearer.
_SAME_M = 1e-4


@dataclass(frozen=True)
class CorrectedIntent(IntentModel):
    """An intent model that around some poses makes the motions that a person called right there.

    Within half a pair's reach the prediction is the pair's own motion, or that of several, the nearer the more it
    counts (Shepard 1968, inverse squared distances); it blends into the base model's up to the reach, and beyond
    it is the base model's.

    Attributes:
        base: the model as it was fitted.
        poses: (M, 7) the pairs' poses.
        following: (M, 7) where a person would go from them.
        reaches: (M,) [m] how far from its pose each pair moves the prediction.
    """

    base: IntentModel
    poses: Array
    following: Array
    reaches: Array

    @property
    def goal(self) -> Array:  # type: ignore[override]  # what a model holds as a field this one takes from its base
        """The goal pose (7,)."""
        return self.base.goal

    @property
    def start_frame(self) -> StartFrame:  # type: ignore[override]
        """The base's frame."""
        return self.base.start_frame

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7)."""
        return self.moved(poses, self.base.predict(poses))

    @property
    def fitted(self) -> IntentModel:
        """The base."""
        return self.base

    def moved(self, poses: Array, predicted: Array) -> Array:
        """Return what the pairs make of the base's predictions (N, 7) from poses (N, 7)."""
        blend, weights = self._blend(poses)
        rows = np.flatnonzero(blend > 0.0)
        if not len(rows):
            return predicted
        share, weights = blend[rows, None], weights[rows]
        answered = weights @ _difference(self.following, self.poses)
        own = _difference(predicted[rows], poses[rows])
        # A base model that leaps where it knows nothing must not outweigh an answer of one step.
        length = pose.norm(answered[:, :3]) / np.maximum(pose.norm(own[:, :3]), _SAME_M)
        own[:, :3] *= np.where(share < 1.0, np.minimum(length, 1.0)[:, None], 1.0)
        motion = share * answered + (1.0 - share) * own
        turned = pose.multiply(poses[rows, pose.QUATERNION], pose.from_rotation_vector(motion[:, 3:]))
        predicted = predicted.copy()
        predicted[rows] = pose.make(poses[rows, pose.POSITION] + motion[:, :3], turned)
        return predicted

    def to_step(self, poses: Array, predicted: Array, step: float) -> Array:
        """Return predictions (N, 7) as motions of one step, as the base scales them."""
        return self.base.to_step(poses, predicted, step)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """The Koopman models of the base."""
        return self.base.matrices

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the base's arrays and the pairs."""
        pairs = {"pairs_before": self.poses, "pairs_after": self.following, "pairs_reach": self.reaches}
        return {**self.base.arrays(), **pairs}

    def _blend(self, poses: Array) -> tuple[Array, Array]:
        """Return how much answers count at poses (N, 7), (N,), and how much each of them does, (N, M), in sum 1."""
        position = poses[:, pose.POSITION]
        moved = pose.norm(position[:, None] - self.poses[:, pose.POSITION])
        cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T), 0.0, 1.0)
        turned = 2.0 * np.arccos(cosine) / _SUPPORT_RAD
        near = _fading(2.0 * moved / self.reaches - 1.0) * _fading(turned)
        weights = near / np.maximum(moved, _SAME_M) ** 2
        total = weights.sum(axis=1, keepdims=True)
        left = pose.norm(position - self.goal[pose.POSITION])
        return near.max(axis=1) * (1.0 - _fading(left / _GOAL_M)), weights / np.where(total > 0.0, total, 1.0)


def corrected(model: IntentModel, poses: Array, following: Array, reaches: Array) -> IntentModel:
    """Return a model with additional pairs: from poses (M, 7) a person goes to ``following`` (M, 7).

    They move the prediction within ``reaches`` (M,) [m] of their poses and nowhere else, so that an answer counts as
    a fact about its surroundings. Equal pairs give the same model, and no pairs the model itself.
    """
    if not len(poses):
        return model
    if isinstance(model, CorrectedIntent):
        pairs = (model.poses, poses), (model.following, following), (model.reaches, reaches)
        return CorrectedIntent(model.base, *(np.concatenate(each) for each in pairs))
    return CorrectedIntent(model, np.array(poses), np.array(following), np.array(reaches))


def restored(arrays: Mapping[str, np.ndarray], settings: IntentSettings) -> IntentModel:
    """Return the model whose :meth:`IntentModel.arrays` these are, with the pairs that it was corrected by."""
    model = settings.restore(arrays)
    if "pairs_before" in arrays:
        return corrected(model, *(arrays[f"pairs_{name}"] for name in ("before", "after", "reach")))
    return model


def _fading(share: Array) -> Array:
    """Return Wendland's C² function of shares (...): 1 up to 0, 0 from 1 on."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray((1.0 - share) ** 4 * (4.0 * share + 1.0))


def _difference(poses: Array, others: Array) -> Array:
    """Return x, y, z [m] and the rotation vector [rad] (N, 6) from other poses (N, 7) to poses (N, 7)."""
    turn = pose.multiply(pose.conjugate(others[:, pose.QUATERNION]), poses[:, pose.QUATERNION])
    moved = poses[:, pose.POSITION] - others[:, pose.POSITION]
    return np.concatenate([moved, pose.to_rotation_vector(pose.canonical(turn))], axis=1)
