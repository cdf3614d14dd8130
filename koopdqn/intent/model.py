"""The human intent model: from any pose, the pose a person would take next."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np

from koopdqn import pose
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.pose import Array
from koopdqn.settings import Name, Settings
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import Task

# Below this [m, or of a quaternion's entries] a roll-out has come to rest.
_AT_REST = 1e-9


class IntentSettings(Settings, ABC):
    """How an intent model is fitted; a new kind of model is a subclass and a YAML file."""

    name: Name

    @abstractmethod
    def fit(self, trajectories: list[Array], task: Task) -> "IntentModel":
        """Return the model fitted to pose trajectories (N, 7), already sampled at the agent's step and placed.

        Where there is a choice of ridges it is that of the first.
        """

    def alternatives(self, trajectories: list[Array], task: Task) -> "dict[float, IntentModel]":
        """Return the models of all ridges that may be chosen among, by ridge; they predict, their K may be partial.

        The first is the one taken where nothing can choose.
        """
        return {self.ridges[0]: self.fit(trajectories, task)}

    def start_frame(self, trajectories: list[Array], task: Task) -> StartFrame:
        """Return the frame in which trajectories (N, 7) are to be told before they are fitted."""
        return STILL

    @property
    @abstractmethod
    def ridges(self) -> tuple[float, ...]:
        """The ridges λ that may be chosen among, at least one."""

    def with_ridge(self, ridge: float) -> "IntentSettings":
        """Return the settings with no choice but one ridge."""
        return self

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray]) -> "IntentModel":
        """Return the model whose :meth:`IntentModel.arrays` these are, without what it was extended with."""


class IntentModel(ABC):
    """The prediction of a person's next pose.

    Attributes:
        goal: the goal pose (7,).
        start_frame: in which it knows poses; all but :meth:`intended` take them as placed there.
    """

    goal: Array
    start_frame: StartFrame = STILL

    @classmethod
    def fit(cls, trajectories: list[Array], task: Task, settings: IntentSettings) -> "IntentModel":
        """Return the model that settings fit to pose trajectories (N, 7), already sampled at the agent's step."""
        return settings.fit(trajectories, task)

    @abstractmethod
    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7), Eqs. 13, 14."""

    @property
    def fitted(self) -> "IntentModel":
        """The model as it was fitted, without additional pairs."""
        return self

    def moved(self, poses: Array, predicted: Array) -> Array:
        """Return what additional pairs make of the fitted model's predictions (N, 7) from poses (N, 7)."""
        return predicted

    def intended(self, poses: Array, starts: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        return self.start_frame.unplaced(self.predict(self.start_frame.placed(poses, starts)), starts, poses)

    @property
    @abstractmethod
    def matrices(self) -> dict[str, KoopmanModel]:
        """The Koopman models it consists of, by the names that reports give them: K, or K_p and K_o."""

    def within(self, frame: StartFrame) -> "IntentModel":
        """Return the model, fitted to trajectories placed in a frame, with that frame."""
        return self

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything but the settings, as arrays."""

    def predict_step(self, poses: Array, step: float) -> Array:
        """Return the fixed-step predictions (N, 7): one step [m] of the agent long, at most up to the goal.

        p + s·(p̂ − p)/‖p̂ − p‖: raw predictions shorten where demonstrations disagree, and then
        standing still would be the right action. Orientation is that of the raw prediction.
        """
        return self.to_step(poses, self.predict(poses), step)

    def to_step(self, poses: Array, predicted: Array, step: float) -> Array:
        """Return predictions (N, 7) made from poses (N, 7) as motions of one step [m], at most up to the goal."""
        position = poses[:, pose.POSITION]
        motion = predicted[:, pose.POSITION] - position
        length = pose.norm(motion, keepdims=True)
        distance = np.minimum(step, pose.position_distance(poses, self.goal))[:, None]
        direction = motion / np.where(length > 0, length, 1.0)
        return pose.make(position + distance * direction, predicted[:, pose.QUATERNION])

    def roll_out(self, starts: Array, steps: int, step: float | None = None) -> Array:
        """Return poses (steps + 1, N, 7) of repeated prediction from starts (N, 7), rescaled if ``step`` is given."""
        poses = [starts]
        for done in range(steps):
            poses.append(self.predict(poses[-1]) if step is None else self.predict_step(poses[-1], step))
            if np.abs(poses[-1] - poses[-2]).max(initial=0.0) < _AT_REST:
                # What rests now rests for good.
                poses += [poses[-1]] * (steps - done - 1)
                break
        return np.array(poses)
