"""The intent of orientations: a Koopman model K_o of them in three coordinates (Eq. 18)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.intent.edmd import KoopmanModel, snapshot_pairs
from koopdqn.intent.observables import RotationObservables
from koopdqn.pose import Array
from koopdqn.tasks.task import Task, angles_in, quaternions_in


class RotationSettings(Settings):
    """How the model of orientations is fitted, K_o of Eq. 18."""

    observables: RotationObservables
    coordinates: Literal["vector", "angles"] = Field(
        description="rotation vector from the goal, or roll, pitch and yaw in the task's frame (the paper)"
    )
    ridge: float = Field(ge=0, description="as for positions")


@dataclass(frozen=True)
class RotationModel:
    """A Koopman model of orientations in coordinates (N, 3).

    Attributes:
        koopman: the model of the coordinates, K_o.
        frame: (2, 4) left and right quaternions that the coordinates are relative to.
        coordinates: rotation vectors, or roll, pitch and yaw.
    """

    koopman: KoopmanModel
    frame: Array
    coordinates: Literal["vector", "angles"]

    @classmethod
    def fit(cls, quaternions: list[Array], task: Task, settings: RotationSettings) -> "RotationModel":
        """Return the model fitted to trajectories of quaternions (N, 4)."""
        at_goal = np.array([task.goal[pose.QUATERNION], pose.IDENTITY[pose.QUATERNION]])
        frame = task.frame if settings.coordinates == "angles" else at_goal
        rows = [_to_coordinates(trajectory, frame, settings.coordinates) for trajectory in quaternions]
        before, after = snapshot_pairs(rows)
        koopman = KoopmanModel.fit(settings.observables, before, after, np.zeros(3), 1.0, settings.ridge)
        return cls(koopman, frame, settings.coordinates)

    def predict(self, quaternions: Array) -> Array:
        """Return the predicted next quaternions (N, 4) of quaternions (N, 4)."""
        rows = self.koopman.predict(_to_coordinates(quaternions, self.frame, self.coordinates))
        if self.coordinates == "angles":
            return quaternions_in(self.frame, rows)
        left, right = self.frame
        return pose.multiply(left, pose.multiply(pose.from_rotation_vector(rows), pose.conjugate(right)))


def _to_coordinates(quaternions: Array, frame: Array, kind: Literal["vector", "angles"]) -> Array:
    if kind == "angles":
        return angles_in(frame, quaternions)
    left, right = frame
    return pose.to_rotation_vector(pose.multiply(pose.conjugate(left), pose.multiply(quaternions, right)))
