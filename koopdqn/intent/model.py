"""The human intent model: predicts the next pose a person would take from any pose."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from koopdqn import pose
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.paths import mean_poses
from koopdqn.pose import Array
from koopdqn.settings import Name, Settings
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import Task

# Below this [m, or of a quaternion's entries] a roll-out has come to rest.
_AT_REST = 1e-9


class IntentSettings(Settings, ABC):
    """How an intent model is fitted; a new kind of model is a subclass and a YAML file."""

    name: Name
    unfolds: ClassVar[bool] = False
    """Whether it learns all passages of a path that passes itself; if not, the last one alone."""

    @abstractmethod
    def fit(self, trajectories: list[Array], task: Task) -> "IntentModel":
        """Return the model of the first ridge for trajectories (N, 7) in the start frame, at the agent's step."""

    def alternatives(self, trajectories: list[Array], task: Task) -> "dict[float, IntentModel]":
        """Return the models of all candidate ridges, by ridge; their K may hold only the rows needed to predict."""
        return {self.ridges[0]: self.fit(trajectories, task)}

    def start_frame(self, trajectories: list[Array], task: Task) -> StartFrame:
        """Return the start frame in which trajectories (N, 7) are fitted."""
        return STILL

    def mean(self, trajectories: list[Array], task: Task) -> Array:
        """Return the mean path (N, 7) that the model of trajectories (N, 7) in the start frame is to lead along."""
        return mean_poses(trajectories)

    @property
    def ridges(self) -> tuple[float, ...]:
        """The candidate ridges λ, at least one: that of the settings, if they have one."""
        return (getattr(self, "ridge", 0.0),)

    def with_ridge(self, ridge: float) -> "IntentSettings":
        """Return the settings with one ridge only."""
        return self

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray]) -> "IntentModel":
        """Return the model with these :meth:`IntentModel.arrays`, without corrections."""


class IntentModel(ABC):
    """A model that predicts a person's next pose.

    Attributes:
        goal: the goal pose (7,).
        start_frame: in which all methods but :meth:`intended` take and return poses.
    """

    goal: Array
    start_frame: StartFrame = STILL

    @abstractmethod
    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7), Eqs. 13, 14."""

    @property
    def fitted(self) -> "IntentModel":
        """The model as it was fitted, without corrections."""
        return self

    def correct(self, poses: Array, predicted: Array) -> Array:
        """Return the fitted model's predictions (N, 7) at poses (N, 7), corrected by answers."""
        return predicted

    @property
    def unbent(self) -> "IntentModel":
        """The model without regard to obstacles."""
        return self

    def placed(self, trajectories: list[Array]) -> list[Array]:
        """Return demonstrated trajectories (N, 7) as the model would have them, in the start frame."""
        return self.start_frame.each(trajectories)

    def intended(self, poses: Array, starts: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        return self.start_frame.from_frame(self.predict(self.start_frame.to_frame(poses, starts)), starts, poses)

    def intended_paths(self, starts: Array, limit: int, step: float) -> Array:
        """Return the poses (T, N, 7) of following the intent from starts (N, 7), a ``step`` [m] each.

        They end where all rest, or after ``limit`` steps.
        """
        poses = [starts]
        for _ in range(limit):
            starts = self.start_frame.onward(poses[-1], starts)
            poses.append(self.to_step(poses[-1], self.intended(poses[-1], starts), step, starts))
            if np.abs(poses[-1] - poses[-2]).max() < _AT_REST:
                break
        return np.array(poses)

    @property
    @abstractmethod
    def matrices(self) -> dict[str, KoopmanModel]:
        """The Koopman models it consists of, by their names in reports: K, or K_p and K_o."""

    def within(self, frame: StartFrame) -> "IntentModel":
        """Return the model with the frame in which it was fitted."""
        return self

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return the model as arrays, without its settings."""

    def predict_step(self, poses: Array, step: float) -> Array:
        """Return the fixed-step predictions (N, 7): one step [m] of the agent long, at most up to the goal.

        p + s·(p̂ − p)/‖p̂ − p‖: raw predictions shorten where demonstrations disagree, and then
        standing still would be the right action. Orientation is that of the raw prediction.
        """
        return self.to_step(poses, self.predict(poses), step)

    def to_step(self, poses: Array, predicted: Array, step: float, starts: Array | None = None) -> Array:
        """Return predictions (N, 7) from poses (N, 7) rescaled to one step [m], at most up to the goal.

        ``starts`` (N, 7) are those of their episodes; None if poses are in the start frame already.
        """
        position = poses[:, pose.POSITION]
        motion = predicted[:, pose.POSITION] - position
        length = pose.norm(motion, keepdims=True)
        distance = np.minimum(step, self._room(poses, starts))[:, None]
        direction = motion / np.where(length > 0, length, 1.0)
        return pose.make(position + distance * direction, predicted[:, pose.QUATERNION])

    def _room(self, poses: Array, starts: Array | None) -> Array:
        """Return the distances (N,) [m] of poses (N, 7) from the goal; infinite on legs that do not end there."""
        distance = np.asarray(pose.position_distance(poses, self.goal))
        if starts is None:
            return distance
        return np.where(self.start_frame.on_last_leg(starts), distance, np.inf)

    def roll_out(self, starts: Array, steps: int, step: float | None = None) -> Array:
        """Return poses (steps + 1, N, 7) of repeated prediction from starts (N, 7), of fixed ``step`` [m] if given."""
        poses = [starts]
        for done in range(steps):
            poses.append(self.predict(poses[-1]) if step is None else self.predict_step(poses[-1], step))
            if np.abs(poses[-1] - poses[-2]).max(initial=0.0) < _AT_REST:
                # A model without memory stays at rest.
                poses += [poses[-1]] * (steps - done - 1)
                break
        return np.array(poses)


@dataclass(frozen=True)
class ModelOver(IntentModel):
    """An intent model that changes what another one predicts.

    Attributes:
        base: the other one.
    """

    base: IntentModel

    @property
    def goal(self) -> Array:  # type: ignore[override]  # a field of other models, the base's here
        """The goal pose (7,)."""
        return self.base.goal

    @property
    def start_frame(self) -> StartFrame:  # type: ignore[override]
        """The base's frame."""
        return self.base.start_frame

    def to_step(self, poses: Array, predicted: Array, step: float, starts: Array | None = None) -> Array:
        """Return predictions (N, 7) rescaled to one step as the base does."""
        return self.base.to_step(poses, predicted, step, starts)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """The Koopman models of the base."""
        return self.base.matrices

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the base's arrays; what changes it is never stored."""
        return self.base.arrays()
