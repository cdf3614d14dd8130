"""The human intent model: from any pose, the pose a person would take next."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from koopdqn import pose
from koopdqn.config.settings import Name, Settings, load_settings
from koopdqn.intent.edmd import KoopmanModel, snapshot_pairs
from koopdqn.intent.observables import Observables
from koopdqn.intent.stabilise import Stabilisation, surrounded
from koopdqn.pose import Array


def _to_observables(value: Any) -> Any:
    return load_settings(value, Observables, "intent.observables") if isinstance(value, Mapping) else value


class IntentSettings(Settings):
    """How the intent model is fitted."""

    name: Name
    observables: Annotated[Observables, BeforeValidator(_to_observables)]
    goal_centered: bool = Field(description="take the goal as origin and the demonstrations' spread as unit")
    ridge: float = Field(ge=0, description="λ of the regularised least squares; 0 is the paper's K = A G†")
    stabilisation: Stabilisation


@dataclass(frozen=True)
class IntentModel:
    """The prediction of a person's next pose, with orientation held.

    Attributes:
        position: the Koopman model of positions, K_p.
        goal: the goal pose (7,).
    """

    position: KoopmanModel
    goal: Array

    @classmethod
    def fit(cls, trajectories: list[Array], goal: Array, settings: IntentSettings) -> "IntentModel":
        """Return the model fitted to pose trajectories (N, 7), already sampled at the agent's step."""
        positions = [trajectory[:, pose.POSITION] for trajectory in trajectories]
        before, after = surrounded(*snapshot_pairs(positions), settings.stabilisation)
        center, scale = np.zeros(3), 1.0
        if settings.goal_centered:
            everything = np.concatenate(positions)
            center = goal[pose.POSITION].copy()
            scale = float(np.sqrt(((everything - everything.mean(axis=0)) ** 2).sum(axis=1).mean()))
        model = KoopmanModel.fit(settings.observables, before, after, center, scale, settings.ridge)
        return cls(model, goal)

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7), Eqs. 13, 14; orientation is held."""
        return pose.make(self.position.predict(poses[:, pose.POSITION]), poses[:, pose.QUATERNION])

    def preferred(self, poses: Array, step: float) -> Array:
        """Return the predictions (N, 7) rescaled to the agent's step [m], at most up to the goal.

        p + s·(p̂ − p)/‖p̂ − p‖: raw predictions shorten where demonstrations disagree, and then
        standing still would be the right action.
        """
        position = poses[:, pose.POSITION]
        motion = self.position.predict(position) - position
        length = np.linalg.norm(motion, axis=1, keepdims=True)
        distance = np.minimum(step, pose.position_distance(poses, self.goal))[:, None]
        direction = motion / np.where(length > 0, length, 1.0)
        return pose.make(position + distance * direction, poses[:, pose.QUATERNION])

    def roll_out(self, starts: Array, steps: int, step: float | None = None) -> Array:
        """Return poses (steps + 1, N, 7) of repeated prediction from starts (N, 7), rescaled if ``step`` is given."""
        poses = [starts]
        for _ in range(steps):
            poses.append(self.predict(poses[-1]) if step is None else self.preferred(poses[-1], step))
        return np.array(poses)
