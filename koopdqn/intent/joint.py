"""One Koopman model of the whole pose, which §5.2 mentions and advises against for its larger residual."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.edmd import KoopmanModel, snapshot_pairs
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.observables import AnyObservables
from koopdqn.pose import Array
from koopdqn.tasks.task import Task, angles_in, quaternions_in


class JointIntentSettings(IntentSettings):
    """How one K is fitted to x, y, z [m] and roll, pitch, yaw [rad] together."""

    observables: AnyObservables
    ridge: float = Field(ge=0, description="λ of the regularised least squares; 0 is K = A G†")

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model fitted to pose trajectories (N, 7)."""
        before, after = snapshot_pairs([_state(trajectory, task.frame) for trajectory in trajectories])
        koopman = KoopmanModel.fit(self.observables, before, after, np.zeros(6), 1.0, self.ridge)
        return JointIntent(koopman, task.frame, task.orientation == "held", task.goal)

    @property
    def ridges(self) -> tuple[float, ...]:
        """The one ridge."""
        return (self.ridge,)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model whose arrays these are."""
        koopman = KoopmanModel(self.observables, np.zeros(6), 1.0, arrays["matrix"])
        return JointIntent(koopman, arrays["frame"], bool(arrays["held"]), arrays["goal"])


@dataclass(frozen=True)
class JointIntent(IntentModel):
    """A model of positions and angles together.

    Attributes:
        koopman: the model of states (N, 6).
        frame: (2, 4) of the angles, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
        held: whether orientation is held whatever the model says.
        goal: the goal pose (7,).
    """

    koopman: KoopmanModel
    frame: Array
    held: bool
    goal: Array

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7)."""
        rows = self.koopman.predict(_state(poses, self.frame))
        turned = poses[:, pose.QUATERNION] if self.held else quaternions_in(self.frame, rows[:, 3:])
        return pose.make(rows[:, :3], turned)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """The one K."""
        return {"K": self.koopman}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything but the settings, as arrays."""
        return {
            "matrix": self.koopman.matrix,
            "frame": self.frame,
            "held": np.array(self.held),
            "goal": self.goal,
        }


def _state(poses: Array, frame: Array) -> Array:
    return np.concatenate([poses[:, pose.POSITION], angles_in(frame, poses[:, pose.QUATERNION])], axis=1)
