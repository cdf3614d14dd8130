"""The human intent model: from any pose, the pose a person would take next."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np

from koopdqn import pose
from koopdqn.config.settings import Name, Settings
from koopdqn.intent.edmd import KoopmanModel
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

# Steps that an additional pair reaches at most: a person who comes back over half a metre does not mean that far.
_REACH_STEPS = 10.0


def reach_of(task: Task) -> float:
    """Return how far from its pose an answer changes the prediction [m]: the look-ahead, or ten steps if shorter."""
    return min(task.pull_back_m, _REACH_STEPS * task.step_m)


class IntentSettings(Settings, ABC):
    """How an intent model is fitted; a new kind of model is a subclass and a YAML file."""

    name: Name

    @abstractmethod
    def fit(self, trajectories: list[Array], task: Task) -> "IntentModel":
        """Return the model fitted to pose trajectories (N, 7), already sampled at the agent's step.

        Where there is a choice of ridges it is that of the first.
        """

    def alternatives(self, trajectories: list[Array], task: Task) -> "dict[float, IntentModel]":
        """Return the models of all ridges that may be chosen among, by ridge; they predict, their K may be partial.

        The first is the one taken where nothing can choose.
        """
        return {self.ridges[0]: self.fit(trajectories, task)}

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
        reach: how far from its pose an additional pair changes the prediction [m].
    """

    goal: Array
    reach: float

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: IntentSettings) -> "IntentModel":
        """Return the model whose :meth:`arrays` these are, with what it was extended with."""
        model = settings.restore(arrays)
        if "pairs_before" in arrays:
            return model.extended(arrays["pairs_before"], arrays["pairs_after"])
        return model

    @classmethod
    def fit(cls, trajectories: list[Array], task: Task, settings: IntentSettings) -> "IntentModel":
        """Return the model that settings fit to pose trajectories (N, 7), already sampled at the agent's step."""
        return settings.fit(trajectories, task)

    @abstractmethod
    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7), Eqs. 13, 14."""

    @property
    @abstractmethod
    def matrices(self) -> dict[str, KoopmanModel]:
        """The Koopman models it consists of, by the names that reports give them: K, or K_p and K_o."""

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything but the settings, as arrays."""

    def extended(self, poses: Array, following: Array) -> "IntentModel":
        """Return the model with additional pairs: from poses (M, 7) a person goes to ``following`` (M, 7).

        They move the prediction within about :attr:`reach` of their poses and nowhere else, so that an answer
        counts as a fact about its surroundings. Equal pairs give the same model, and no pairs the model itself.
        """
        from koopdqn.intent.correction import CorrectedIntent

        return CorrectedIntent(self, np.array(poses), np.array(following)) if len(poses) else self

    def preferred(self, poses: Array, step: float) -> Array:
        """Return the predictions (N, 7) rescaled to the agent's step [m], at most up to the goal.

        p + s·(p̂ − p)/‖p̂ − p‖: raw predictions shorten where demonstrations disagree, and then
        standing still would be the right action. Orientation is predicted as it is.
        """
        predicted = self.predict(poses)
        position = poses[:, pose.POSITION]
        motion = predicted[:, pose.POSITION] - position
        length = np.linalg.norm(motion, axis=1, keepdims=True)
        distance = np.minimum(step, pose.position_distance(poses, self.goal))[:, None]
        direction = motion / np.where(length > 0, length, 1.0)
        return pose.make(position + distance * direction, predicted[:, pose.QUATERNION])

    def roll_out(self, starts: Array, steps: int, step: float | None = None) -> Array:
        """Return poses (steps + 1, N, 7) of repeated prediction from starts (N, 7), rescaled if ``step`` is given."""
        poses = [starts]
        for _ in range(steps):
            poses.append(self.predict(poses[-1]) if step is None else self.preferred(poses[-1], step))
        return np.array(poses)
