"""Corrections: answers change an intent model's predictions around the poses they were given for."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.model import IntentModel, ModelOver
from koopdqn.pose import Array

# A pair corrects no orientation farther than this from its own [rad].
_SUPPORT_RAD = 0.35
# Within this distance of the goal [m] corrections fade, so that the goal stays a fixed point.
_GOAL_M = 0.015
# Distances below this [m] count as equal.
_SAME_M = 1e-4


@dataclass(frozen=True)
class CorrectedIntent(ModelOver):
    """An intent model corrected by pairs of poses from a person's answers.

    Within half a pair's reach the prediction is the pair's own motion; several pairs are interpolated by inverse
    squared distances (Shepard 1968). From there to the reach it blends into the base model's prediction.

    Attributes:
        base: the model as it was fitted.
        poses: (M, 7) the pairs' poses.
        following: (M, 7) a person's next poses.
        reaches: (M,) [m] within which each pair corrects the prediction.
    """

    poses: Array
    following: Array
    reaches: Array

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7)."""
        return self.correct(poses, self.base.predict(poses))

    @property
    def fitted(self) -> IntentModel:
        """The base."""
        return self.base

    def correct(self, poses: Array, predicted: Array) -> Array:
        """Return the base's predictions (N, 7) at poses (N, 7), corrected by the pairs."""
        blend, weights = self._blend(poses)
        rows = np.flatnonzero(blend > 0.0)
        if not len(rows):
            return predicted
        share, weights = blend[rows, None], weights[rows]
        answered = weights @ pose.difference(self.following, self.poses)
        own = pose.difference(predicted[rows], poses[rows])
        # A long prediction far from the data must not outweigh an answer of one step.
        length = pose.norm(answered[:, :3]) / np.maximum(pose.norm(own[:, :3]), _SAME_M)
        own[:, :3] *= np.where(share < 1.0, np.minimum(length, 1.0)[:, None], 1.0)
        motion = share * answered + (1.0 - share) * own
        turned = pose.multiply(poses[rows, pose.QUATERNION], pose.from_rotation_vector(motion[:, 3:]))
        predicted = predicted.copy()
        predicted[rows] = pose.make(poses[rows, pose.POSITION] + motion[:, :3], turned)
        return predicted

    def _blend(self, poses: Array) -> tuple[Array, Array]:
        """Return the blend of the answers (N,) at poses (N, 7), and the weight of each (N, M), which sum to 1."""
        position = poses[:, pose.POSITION]
        moved = pose.norm(position[:, None] - self.poses[:, pose.POSITION])
        cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T), 0.0, 1.0)
        turned = 2.0 * np.arccos(cosine) / _SUPPORT_RAD
        near = _fading(2.0 * moved / self.reaches - 1.0) * _fading(turned)
        weights = near / np.maximum(moved, _SAME_M) ** 2
        total = weights.sum(axis=1, keepdims=True)
        left = pose.norm(position - self.goal[pose.POSITION])
        return near.max(axis=1) * (1.0 - _fading(left / _GOAL_M)), weights / np.where(total > 0.0, total, 1.0)


def _fading(share: Array) -> Array:
    """Return Wendland's C² function of shares (...): 1 at 0 and below, 0 at 1 and above."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray((1.0 - share) ** 4 * (4.0 * share + 1.0))
