"""Separate models of position and orientation, K_p and K_o (Eqs. 17, 18), and the paper's joint lift and line fit."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from pydantic import AliasChoices, BeforeValidator, Field, model_validator

from koopdqn import pose
from koopdqn.artifact import below
from koopdqn.intent.augment import Augmentation, Pairs, augmented
from koopdqn.intent.koopman import KoopmanModel, snapshot_pairs, within_radius
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.observables import Affine, AnyObservables, RotationObservables
from koopdqn.intent.trust import components_of
from koopdqn.pose import Array
from koopdqn.settings import Floats, Settings
from koopdqn.tasks.task import Task, angles_in, quaternions_in

_LIFT = "lift_"
_ROTATION_LIFT = "rotation_lift_"


def _to_ridges(value: object) -> object:
    return (value,) if isinstance(value, int | float) and not isinstance(value, bool) else value


Ridges = Annotated[Floats, BeforeValidator(_to_ridges), Field(min_length=1)]


class RotationSettings(Settings):
    """How the model of orientations is fitted, K_o of Eq. 18."""

    observables: RotationObservables
    coordinates: Literal["vector", "angles"] = Field(
        description="rotation vector from the goal, or roll, pitch and yaw in the task's frame (the paper)"
    )
    ridge: float = Field(ge=0, description="λ of the regularised least squares")


@dataclass(frozen=True)
class RotationModel:
    """A Koopman model of orientations in coordinates (N, 3).

    Attributes:
        koopman: the model of the coordinates, K_o.
        frame: (2, 4) left and right quaternions of the coordinates' frame.
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


class SeparateIntentSettings(IntentSettings):
    """How K_p is fitted to positions and, where orientation is learned, K_o to orientations."""

    observables: AnyObservables
    goal_centered: bool = Field(description="take the goal as origin and the demonstrations' spread as unit")
    ridge: Ridges = Field(
        description="λ of the regularised least squares; of several, leaving one demonstration out chooses one, and a"
        " single demonstration takes the first; 0 is the paper's K = A G†"
    )
    spectral_limit: float | None = Field(gt=0, description="largest absolute eigenvalue of K; null for no limit")
    augmentation: Augmentation = Field(
        # Artifacts of earlier runs call it by its old name.
        validation_alias=AliasChoices("augmentation", "stabilisation")
    )
    rotation: RotationSettings

    @model_validator(mode="after")
    def _check_ridges(self) -> "SeparateIntentSettings":
        if min(self.ridge) < 0 or len(set(self.ridge)) < len(self.ridge):
            raise ValueError(f"ridge must be 0 or above, each once, found {list(self.ridge)}")
        return self

    @property
    def ridges(self) -> tuple[float, ...]:
        """The candidate ridges."""
        return self.ridge

    def with_ridge(self, ridge: float) -> IntentSettings:
        """Return the settings with one ridge only."""
        return self.model_copy(update={"ridge": (ridge,)})

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model fitted to pose trajectories (N, 7), with the first ridge."""
        pairs, center, scale = self._pairs(trajectories, task)
        data = self.observables, pairs.before, pairs.after, center, scale
        model = KoopmanModel.fit(*data, self.ridge[0], pairs.weight)
        if self.spectral_limit is not None:
            model = replace(model, matrix=within_radius(model.matrix, self.spectral_limit))
        return SeparateIntent(model, self._rotation(trajectories, task), task.goal)

    def alternatives(self, trajectories: list[Array], task: Task) -> dict[float, IntentModel]:
        """Return the models of all ridges, by ridge."""
        if self.spectral_limit is not None:
            return {ridge: self.with_ridge(ridge).fit(trajectories, task) for ridge in self.ridge}
        pairs, center, scale = self._pairs(trajectories, task)
        data = self.observables, pairs.before, pairs.after, center, scale
        rotation = self._rotation(trajectories, task)
        models = KoopmanModel.one_step(*data, self.ridge, pairs.weight)
        return {
            ridge: SeparateIntent(model, rotation, task.goal) for ridge, model in zip(self.ridge, models, strict=True)
        }

    def _pairs(self, trajectories: list[Array], task: Task) -> tuple[Pairs, Array, float]:
        """Return the pairs to fit, and the origin (3,) [m] and unit [m] of the coordinates."""
        positions = [trajectory[:, pose.POSITION] for trajectory in trajectories]
        everything = np.concatenate(positions)
        spread = float(np.sqrt(((everything - everything.mean(axis=0)) ** 2).sum(axis=1).mean()))
        pairs = augmented(positions, spread, self.augmentation)
        if self.goal_centered:
            return pairs, task.goal[pose.POSITION].copy(), spread
        return pairs, np.zeros(3), 1.0

    def _rotation(self, trajectories: list[Array], task: Task) -> RotationModel | None:
        if task.orientation != "learned":
            return None
        return RotationModel.fit([trajectory[:, pose.QUATERNION] for trajectory in trajectories], task, self.rotation)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model with these arrays."""
        lift = self.observables.restored(below(arrays, _LIFT))
        position = KoopmanModel(lift, arrays["center"], float(arrays["scale"]), arrays["matrix"])
        rotation = None
        if "rotation_matrix" in arrays:
            turn = self.rotation.observables.restored(below(arrays, _ROTATION_LIFT))
            koopman = KoopmanModel(turn, np.zeros(3), 1.0, arrays["rotation_matrix"])
            rotation = RotationModel(koopman, arrays["rotation_frame"], self.rotation.coordinates)
        return SeparateIntent(position, rotation, arrays["goal"])


@dataclass(frozen=True)
class SeparateIntent(IntentModel):
    """Independent models of positions and of orientations.

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
        """Return the model as arrays, without its settings."""
        held = {
            "matrix": self.position.matrix,
            "center": self.position.center,
            "scale": np.array(self.position.scale),
            "goal": self.goal,
        }
        held |= {_LIFT + name: values for name, values in self.position.observables.arrays().items()}
        if self.rotation is not None:
            turn = self.rotation.koopman.observables
            held |= {_ROTATION_LIFT + name: values for name, values in turn.arrays().items()}
            held |= {"rotation_matrix": self.rotation.koopman.matrix, "rotation_frame": self.rotation.frame}
        return held


class JointIntentSettings(IntentSettings):
    """How one K is fitted to x, y, z [m] and roll, pitch, yaw [rad] together."""

    observables: AnyObservables
    ridge: float = Field(ge=0, description="λ of the regularised least squares; 0 is K = A G†")

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model fitted to pose trajectories (N, 7)."""
        before, after = snapshot_pairs([components_of(trajectory, task.frame) for trajectory in trajectories])
        koopman = KoopmanModel.fit(self.observables, before, after, np.zeros(6), 1.0, self.ridge)
        return JointIntent(koopman, task.frame, task.orientation == "held", task.goal)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model with these arrays."""
        koopman = KoopmanModel(self.observables, np.zeros(6), 1.0, arrays["matrix"])
        return JointIntent(koopman, arrays["frame"], bool(arrays["held"]), arrays["goal"])


@dataclass(frozen=True)
class JointIntent(IntentModel):
    """A model of positions and angles together.

    Attributes:
        koopman: the model of states (N, 6).
        frame: (2, 4) of the angles, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
        held: whether orientation is held in place of the prediction.
        goal: the goal pose (7,).
    """

    koopman: KoopmanModel
    frame: Array
    held: bool
    goal: Array

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7)."""
        rows = self.koopman.predict(components_of(poses, self.frame))
        turned = poses[:, pose.QUATERNION] if self.held else quaternions_in(self.frame, rows[:, 3:])
        return pose.make(rows[:, :3], turned)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """The one K."""
        return {"K": self.koopman}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the model as arrays, without its settings."""
        return {"matrix": self.koopman.matrix, "frame": self.frame, "held": np.array(self.held), "goal": self.goal}


class LineIntentSettings(IntentSettings):
    """The line fit of Fig. 5, through one demonstration."""

    demonstration: int = Field(ge=0, description="index of the demonstration, from 0; the last one if there are fewer")

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model that predicts one step along the line from its point nearest to the pose."""
        chosen = trajectories[min(self.demonstration, len(trajectories) - 1)]
        rotation = None
        if task.orientation == "learned":
            rotation = RotationModel(_line_model(task.angles(chosen[:, pose.QUATERNION])), task.frame, "angles")
        return SeparateIntent(_line_model(chosen[:, pose.POSITION]), rotation, task.goal)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model with these arrays."""
        rotation = None
        if "rotation_matrix" in arrays:
            rotation = RotationModel(_model(arrays["rotation_matrix"]), arrays["rotation_frame"], "angles")
        return SeparateIntent(_model(arrays["matrix"]), rotation, arrays["goal"])


def line_through(states: Array) -> tuple[Array, Array]:
    """Return offset a (d,) and step b (d,) of the least-squares line a + b·t through states (N, d), t = 0, 1, 2 …."""
    steps = np.arange(len(states))
    step, offset = np.polynomial.polynomial.polyfit(steps, states, 1)[::-1]
    return offset, step


def _line_model(states: Array) -> KoopmanModel:
    # x' = a + b (bᵀ(x − a)/bᵀb + 1) is affine: a Koopman model with a constant observable.
    offset, step = line_through(states)
    length = float(step @ step)
    projector = np.outer(step, step) / length if length > 0 else np.zeros((len(step), len(step)))
    constant = offset - projector @ offset + step
    matrix = np.zeros((len(step) + 1, len(step) + 1))
    matrix[:-1, :-1], matrix[:-1, -1], matrix[-1, -1] = projector, constant, 1.0
    return _model(matrix)


def _model(matrix: Array) -> KoopmanModel:
    return KoopmanModel(Affine(), np.zeros(len(matrix) - 1), 1.0, matrix)
