"""Separate models of position and orientation, K_p and K_o (Eqs. 17, 18): the paper's way, and the default."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.edmd import KoopmanModel, snapshot_pairs
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.observables import AnyObservables
from koopdqn.intent.rotation import RotationModel, RotationSettings
from koopdqn.intent.stabilise import Stabilisation, surrounded
from koopdqn.pose import Array
from koopdqn.tasks.task import Task


class SeparateIntentSettings(IntentSettings):
    """How K_p is fitted to positions and, where orientation is learned, K_o to orientations."""

    observables: AnyObservables
    goal_centered: bool = Field(description="take the goal as origin and the demonstrations' spread as unit")
    ridge: float = Field(ge=0, description="λ of the regularised least squares; 0 is the paper's K = A G†")
    stabilisation: Stabilisation
    rotation: RotationSettings

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model fitted to pose trajectories (N, 7)."""
        positions = [trajectory[:, pose.POSITION] for trajectory in trajectories]
        before, after = surrounded(*snapshot_pairs(positions), self.stabilisation)
        center, scale = np.zeros(3), 1.0
        if self.goal_centered:
            everything = np.concatenate(positions)
            center = task.goal[pose.POSITION].copy()
            scale = float(np.sqrt(((everything - everything.mean(axis=0)) ** 2).sum(axis=1).mean()))
        model = KoopmanModel.fit(self.observables, before, after, center, scale, self.ridge)
        rotation = None
        if task.orientation == "learned":
            quaternions = [trajectory[:, pose.QUATERNION] for trajectory in trajectories]
            rotation = RotationModel.fit(quaternions, task, self.rotation)
        return SeparateIntent(model, rotation, task.goal)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model whose arrays these are."""
        position = KoopmanModel(self.observables, arrays["center"], float(arrays["scale"]), arrays["matrix"])
        rotation = None
        if "rotation_matrix" in arrays:
            koopman = KoopmanModel(self.rotation.observables, np.zeros(3), 1.0, arrays["rotation_matrix"])
            rotation = RotationModel(koopman, arrays["rotation_frame"], self.rotation.coordinates)
        return SeparateIntent(position, rotation, arrays["goal"])


@dataclass(frozen=True)
class SeparateIntent(IntentModel):
    """A model of positions and one of orientations, each knowing nothing of the other.

    Attributes:
        position: the Koopman model of positions, K_p.
        rotation: the model of orientations, or None where orientation is held.
        goal: the goal pose (7,).
    """

    position: KoopmanModel
    rotation: RotationModel | None
    goal: Array

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7), Eqs. 13, 14, 17, 18."""
        quaternions = poses[:, pose.QUATERNION]
        turned = quaternions if self.rotation is None else self.rotation.predict(quaternions)
        return pose.make(self.position.predict(poses[:, pose.POSITION]), turned)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """K, or K_p and K_o where orientation is learned."""
        if self.rotation is None:
            return {"K": self.position}
        return {"K_p": self.position, "K_o": self.rotation.koopman}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything but the settings, as arrays."""
        held = {
            "matrix": self.position.matrix,
            "center": self.position.center,
            "scale": np.array(self.position.scale),
            "goal": self.goal,
        }
        if self.rotation is not None:
            held |= {"rotation_matrix": self.rotation.koopman.matrix, "rotation_frame": self.rotation.frame}
        return held
