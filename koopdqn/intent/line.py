"""The line-fit baseline (Fig. 5): a least-squares line through one demonstration instead of a Koopman model."""

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.edmd import KoopmanModel
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.observables import Affine
from koopdqn.intent.rotation import RotationModel
from koopdqn.intent.separate import SeparateIntent
from koopdqn.pose import Array
from koopdqn.tasks.task import Task


class LineIntentSettings(IntentSettings):
    """How a line is fitted to one demonstration."""

    demonstration: int = Field(ge=0, description="which demonstration, counted from 0; the last if there are fewer")

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model whose prediction goes one step along the line from the point of it nearest to the pose."""
        chosen = trajectories[min(self.demonstration, len(trajectories) - 1)]
        rotation = None
        if task.orientation == "learned":
            rotation = RotationModel(_line_model(task.angles(chosen[:, pose.QUATERNION])), task.frame, "angles")
        return SeparateIntent(_line_model(chosen[:, pose.POSITION]), rotation, task.goal)

    @property
    def ridges(self) -> tuple[float, ...]:
        """None: a line needs no ridge."""
        return (0.0,)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model whose arrays these are."""
        rotation = None
        if "rotation_matrix" in arrays:
            rotation = RotationModel(_model(arrays["rotation_matrix"]), arrays["rotation_frame"], "angles")
        return SeparateIntent(_model(arrays["matrix"]), rotation, arrays["goal"])


def line_through(states: Array) -> tuple[Array, Array]:
    """Return offset a (d,) and step b (d,) of the least-squares line a + b·t through states (N, d) at t = 0, 1, 2 …."""
    steps = np.arange(len(states))
    step, offset = np.polynomial.polynomial.polyfit(steps, states, 1)[::-1]
    return offset, step


def _line_model(states: Array) -> KoopmanModel:
    # x' = a + b (bᵀ(x − a)/bᵀb + 1) is affine, so that it is a Koopman model with a constant observable.
    offset, step = line_through(states)
    length = float(step @ step)
    projector = np.outer(step, step) / length if length > 0 else np.zeros((len(step), len(step)))
    constant = offset - projector @ offset + step
    matrix = np.zeros((len(step) + 1, len(step) + 1))
    matrix[:-1, :-1], matrix[:-1, -1], matrix[-1, -1] = projector, constant, 1.0
    return _model(matrix)


def _model(matrix: Array) -> KoopmanModel:
    return KoopmanModel(Affine(), np.zeros(len(matrix) - 1), 1.0, matrix)
