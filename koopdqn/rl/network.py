"""The Q-network: from a pose to an observation, and from that to ten values, one for each action."""

from itertools import pairwise
from typing import cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.rl.settings import NetworkSettings
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.task import Task

_POSITION, _ROTATION = 3, 3
# Observations where orientation is held: position and the two distances.
_HELD = 5
# Observations that hardly vary (a held orientation's distance) must not be blown up.
_LEAST_SPREAD = 0.02


class QNetwork(nn.Module):
    """A multilayer perceptron with ReLU on normalised observations, and on random Fourier features of the position.

    Which action is right changes every few millimetres; the features (Rahimi & Recht 2007) let a small
    network follow that. Their frequencies are drawn once and not learned.
    """

    mean: Tensor
    spread: Tensor
    frequencies: Tensor
    phases: Tensor

    def __init__(self, inputs: int, settings: NetworkSettings, rng: np.random.Generator) -> None:
        """Make a network for observations (N, inputs), every weight drawn from ``rng``."""
        super().__init__()
        features = settings.fourier_features
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("spread", torch.ones(inputs))
        scale = np.array([settings.length_scale_m] * _POSITION + [settings.length_scale_rad] * _ROTATION)
        # Position, and with orientation learned the rotation vector.
        self._waved = _POSITION if inputs == _HELD else _POSITION + _ROTATION
        drawn = rng.normal(size=(self._waved, features)) / scale[: self._waved, None]
        self.register_buffer("frequencies", _drawn(drawn))
        self.register_buffer("phases", _drawn(rng.uniform(0, 2 * np.pi, features)))
        widths = [inputs + features, *settings.hidden]
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [linear(before, after, rng), nn.ReLU()]
        self.layers = nn.Sequential(*layers, linear(widths[-1], COUNT, rng))

    def normalise_to(self, observations: NDArray[np.float32]) -> None:
        """Take mean and spread of the inputs from observations (N, inputs)."""
        self.mean.copy_(torch.from_numpy(observations.mean(axis=0)))
        self.spread.copy_(torch.from_numpy(np.maximum(observations.std(axis=0), _LEAST_SPREAD)))

    def forward(self, observations: Tensor) -> Tensor:
        """Return the values Q (N, 10) of observations (N, inputs)."""
        return self.of_features(self.features(observations))

    def of_features(self, features: Tensor) -> Tensor:
        """Return the values Q (N, 10) of what :meth:`features` makes of observations (N, inputs + features)."""
        return cast(Tensor, self.layers(features))

    def features(self, observations: Tensor) -> Tensor:
        """Return what the first layer sees (N, inputs + features) of observations (N, inputs)."""
        normalised = (observations - self.mean) / self.spread
        if not self.phases.numel():
            return normalised
        waves = torch.cos(observations[:, : self._waved] @ self.frequencies + self.phases)
        return torch.cat([normalised, np.sqrt(2.0) * waves], dim=1)

    def values(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the values Q (N, 10) of observations (N, inputs), without gradients."""
        with torch.no_grad():
            return cast(NDArray[np.float32], self(torch.from_numpy(observations)).numpy())


def _drawn(values: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


def linear(inputs: int, outputs: int, rng: np.random.Generator) -> nn.Linear:
    """Return a layer whose weights (He et al. 2015) come from ``rng``, not from global random state."""
    # torch draws weights of its own first; its global random state stays as it was.
    with torch.random.fork_rng(devices=()):
        layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        layer.weight.copy_(_drawn(rng.normal(scale=np.sqrt(2.0 / inputs), size=(outputs, inputs))))
        layer.bias.zero_()
    return layer


def values_in(inputs: int, settings: NetworkSettings) -> int:
    """Return how many numbers a network for observations (N, inputs) consists of, its buffers included."""
    waved = _POSITION if inputs == _HELD else _POSITION + _ROTATION
    features = settings.fourier_features
    widths = [inputs + features, *settings.hidden, COUNT]
    return 2 * inputs + (waved + 1) * features + sum((before + 1) * after for before, after in pairwise(widths))


def size(task: Task) -> int:
    """Return the number of observed values: 5 with orientation held, 8 otherwise."""
    return 5 if task.orientation == "held" else 8


def observe(poses: Array, task: Task) -> NDArray[np.float32]:
    """Return observations (N, 5) or (N, 8) of poses (N, 7), told as from the task's nominal start.

    Position [m], with orientation learned also the rotation vector from the goal's orientation [rad], then
    the distances to the goal in position [m] and rotation [rad].
    """
    columns = [poses[:, pose.POSITION]]
    if task.orientation == "learned":
        columns.append(
            pose.to_rotation_vector(
                pose.multiply(poses[:, pose.QUATERNION], pose.conjugate(task.goal[pose.QUATERNION]))
            )
        )
    columns.append(pose.position_distance(poses, task.goal)[:, None])
    columns.append(pose.rotation_distance(poses, task.goal)[:, None])
    return np.concatenate(columns, axis=1).astype(np.float32)
