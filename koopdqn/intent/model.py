"""The human intent model: from any pose, the pose a person would take next."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from koopdqn import pose
from koopdqn.config.settings import Name, Settings, load_settings
from koopdqn.intent.edmd import KoopmanModel, snapshot_pairs
from koopdqn.intent.observables import Observables
from koopdqn.intent.stabilise import Stabilisation, surrounded
from koopdqn.pose import Array
from koopdqn.tasks.task import Task, angles_in, quaternions_in


def _to_observables(value: Any) -> Any:
    return load_settings(value, Observables, "intent.observables") if isinstance(value, Mapping) else value


AnyObservables = Annotated[Observables, BeforeValidator(_to_observables)]


class RotationSettings(Settings):
    """How the model of orientations is fitted, K_o of Eq. 18."""

    observables: AnyObservables
    coordinates: Literal["vector", "angles"] = Field(
        description="rotation vector from the goal, or roll, pitch and yaw in the task's frame (the paper)"
    )
    ridge: float = Field(ge=0, description="as for positions")


class IntentSettings(Settings):
    """How the intent model is fitted: K_p from positions and, where orientation is learned, K_o from orientations."""

    name: Name
    observables: AnyObservables
    goal_centered: bool = Field(description="take the goal as origin and the demonstrations' spread as unit")
    ridge: float = Field(ge=0, description="λ of the regularised least squares; 0 is the paper's K = A G†")
    stabilisation: Stabilisation
    rotation: RotationSettings


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


@dataclass(frozen=True)
class IntentModel:
    """The prediction of a person's next pose.

    Attributes:
        position: the Koopman model of positions, K_p.
        rotation: the model of orientations, or None where orientation is held.
        goal: the goal pose (7,).
    """

    position: KoopmanModel
    rotation: RotationModel | None
    goal: Array

    @classmethod
    def fit(cls, trajectories: list[Array], task: Task, settings: IntentSettings) -> "IntentModel":
        """Return the model fitted to pose trajectories (N, 7), already sampled at the agent's step."""
        positions = [trajectory[:, pose.POSITION] for trajectory in trajectories]
        before, after = surrounded(*snapshot_pairs(positions), settings.stabilisation)
        center, scale = np.zeros(3), 1.0
        if settings.goal_centered:
            everything = np.concatenate(positions)
            center = task.goal[pose.POSITION].copy()
            scale = float(np.sqrt(((everything - everything.mean(axis=0)) ** 2).sum(axis=1).mean()))
        model = KoopmanModel.fit(settings.observables, before, after, center, scale, settings.ridge)
        rotation = None
        if task.orientation == "learned":
            quaternions = [trajectory[:, pose.QUATERNION] for trajectory in trajectories]
            rotation = RotationModel.fit(quaternions, task, settings.rotation)
        return cls(model, rotation, task.goal)

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7), Eqs. 13, 14, 17, 18."""
        return pose.make(self.position.predict(poses[:, pose.POSITION]), self._turned(poses))

    def preferred(self, poses: Array, step: float) -> Array:
        """Return the predictions (N, 7) rescaled to the agent's step [m], at most up to the goal.

        p + s·(p̂ − p)/‖p̂ − p‖: raw predictions shorten where demonstrations disagree, and then
        standing still would be the right action. Orientation is predicted as it is.
        """
        position = poses[:, pose.POSITION]
        motion = self.position.predict(position) - position
        length = np.linalg.norm(motion, axis=1, keepdims=True)
        distance = np.minimum(step, pose.position_distance(poses, self.goal))[:, None]
        direction = motion / np.where(length > 0, length, 1.0)
        return pose.make(position + distance * direction, self._turned(poses))

    def roll_out(self, starts: Array, steps: int, step: float | None = None) -> Array:
        """Return poses (steps + 1, N, 7) of repeated prediction from starts (N, 7), rescaled if ``step`` is given."""
        poses = [starts]
        for _ in range(steps):
            poses.append(self.predict(poses[-1]) if step is None else self.preferred(poses[-1], step))
        return np.array(poses)

    def _turned(self, poses: Array) -> Array:
        quaternions = poses[:, pose.QUATERNION]
        return quaternions if self.rotation is None else self.rotation.predict(quaternions)
