"""The Q-network: observations of poses, and the values of the ten actions."""

from collections.abc import Callable, Sequence
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
from koopdqn.threads import in_halves

_POSITION, _ROTATION = 3, 3
# Observations where orientation is held: position and the two distances.
_HELD = 5
# Observations that hardly vary (a held orientation's distance) are not scaled up further.
_LEAST_SPREAD = 0.02
_ROOT_TWO = float(np.sqrt(2.0))


class Buffers:
    """Memory reused from one update to the next: allocating costs more than the arithmetic."""

    def __init__(self, device: torch.device) -> None:
        """Begin without arrays, on a device."""
        self._device = device
        self._held: dict[tuple[str, int], Tensor] = {}

    def of(self, name: str, count: int, width: int) -> Tensor:
        """Return the uninitialised array (count, width) of a name; the same memory at every call."""
        held = self._held.get((name, width))
        if held is None or len(held) < count:
            held = self._held[name, width] = torch.empty(count + count // 4, width, device=self._device)
        return held[:count]


class QNetwork(nn.Module):
    """A multilayer perceptron with ReLU on normalised observations, and on random Fourier features of the position.

    Its outputs are the values of the ten actions, or, of an actor, the numbers of a twist.

    The right action changes every few millimetres; the features (Rahimi & Recht 2007) let a small network follow that.
    Their frequencies are random and not learned.
    """

    mean: Tensor
    spread: Tensor
    frequencies: Tensor
    phases: Tensor

    def __init__(
        self,
        inputs: int,
        settings: NetworkSettings,
        rng: np.random.Generator,
        device: str = "cpu",
        outputs: int = COUNT,
    ) -> None:
        """Make a network for observations (N, inputs) on a device, every weight drawn from ``rng``."""
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
        self.layers = nn.Sequential(*layers, linear(widths[-1], outputs, rng))
        self.device = torch.device(device)
        self.to(self.device)
        self._memory = Buffers(self.device)
        # Kept apart: looking them up in the modules takes as long as a small layer.
        self.weights = [(layer.weight, layer.bias) for layer in self.layers if isinstance(layer, nn.Linear)]

    def normalise_to(self, observations: NDArray[np.float32]) -> None:
        """Set mean and spread of the inputs from observations (N, inputs)."""
        self.mean.copy_(torch.from_numpy(observations.mean(axis=0)))
        self.spread.copy_(torch.from_numpy(np.maximum(observations.std(axis=0), _LEAST_SPREAD)))

    def forward(self, observations: Tensor) -> Tensor:
        """Return the values Q (N, 10) of observations (N, inputs)."""
        return self.activations(self.features(observations))[-1]

    def features(self, observations: Tensor) -> Tensor:
        """Return the first layer's inputs (N, inputs + features) for observations (N, inputs)."""
        return self.passed(observations, Buffers(self.device))[0]

    def activations(self, features: Tensor) -> list[Tensor]:
        """Return the outputs (N, units) of all layers for :meth:`features` (N, inputs + features); the last is Q."""
        return self._layers(features, [None] * len(self.weights))

    def passed(
        self, observations: Tensor, buffers: Buffers, *networks: "QNetwork"
    ) -> tuple[Tensor, list[list[Tensor]]]:
        """Return the :meth:`features` of observations (N, inputs), and each network's :meth:`activations` for them.

        The networks have these features too. Both halves of the rows are computed side by side, without gradients; the
        arrays are valid until the buffers' next use.
        """
        count, inputs = observations.shape
        seen = buffers.of("seen", count, inputs + self.phases.numel())
        waves = buffers.of("waves", count, self.phases.numel())
        made = [
            [buffers.of(f"network {number} layer {index}", count, len(bias)) for index, (_, bias) in layers]
            for number, layers in enumerate(enumerate(network.weights) for network in networks)
        ]

        def fill(rows: slice) -> None:
            torch.sub(observations[rows], self.mean, out=seen[rows, :inputs]).div_(self.spread)
            if self.phases.numel():
                found = torch.mm(observations[rows, : self._waved], self.frequencies, out=waves[rows])
                torch.mul(found.add_(self.phases).cos_(), _ROOT_TWO, out=seen[rows, inputs:])
            for network, out in zip(networks, made, strict=True):
                network._layers(seen[rows], [into[rows] for into in out])

        self.in_halves(count, fill)
        return seen, made

    def _layers(self, values: Tensor, out: Sequence[Tensor | None]) -> list[Tensor]:
        made = []
        for index, ((weight, bias), into) in enumerate(zip(self.weights, out, strict=True)):
            values = torch.addmm(bias, values, weight.t(), out=into)
            if index < len(self.weights) - 1:
                values = values.relu_()
            made.append(values)
        return made

    def in_halves(self, count: int, work: Callable[[slice], None]) -> None:
        """Do work on the halves of rows side by side on a processor, and at once on a GPU."""
        if self.device.type == "cpu":
            in_halves(count, work)
        else:
            work(slice(0, count))

    def values(self, observations: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the values Q (N, 10) of observations (N, inputs), without gradients."""
        with torch.no_grad():
            _, (made,) = self.passed(torch.from_numpy(observations).to(self.device), self._memory, self)
            return cast(NDArray[np.float32], made[-1].cpu().numpy().copy())


def _drawn(values: NDArray[np.float64]) -> Tensor:
    return torch.from_numpy(values.astype(np.float32))


def linear(inputs: int, outputs: int, rng: np.random.Generator) -> nn.Linear:
    """Return a layer whose weights (He et al. 2015) come from ``rng``, not from global random state."""
    # torch draws weights of its own first; the fork keeps its global random state.
    with torch.random.fork_rng(devices=()):
        layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        layer.weight.copy_(_drawn(rng.normal(scale=np.sqrt(2.0 / inputs), size=(outputs, inputs))))
        layer.bias.zero_()
    return layer


def values_in(inputs: int, settings: NetworkSettings, outputs: int = COUNT) -> int:
    """Return how many numbers a network for observations (N, inputs) consists of, its buffers included."""
    waved = _POSITION if inputs == _HELD else _POSITION + _ROTATION
    features = settings.fourier_features
    widths = [inputs + features, *settings.hidden, outputs]
    return 2 * inputs + (waved + 1) * features + sum((before + 1) * after for before, after in pairwise(widths))


def size(task: Task) -> int:
    """Return the number of observed values: 5 with orientation held, 8 otherwise."""
    return 5 if task.orientation == "held" else 8


def observe(poses: Array, task: Task) -> NDArray[np.float32]:
    """Return observations (N, 5), or (N, 8) with orientation learned, of poses (N, 7) in the start frame.

    Position [m], with orientation learned the rotation vector from the goal's orientation [rad], then the distances to
    the goal in position [m] and rotation [rad].
    """
    turn = pose.multiply(poses[:, pose.QUATERNION], pose.conjugate(task.goal[pose.QUATERNION]))
    columns = [poses[:, pose.POSITION]]
    if task.orientation == "learned":
        columns.append(pose.to_rotation_vector(turn))
    columns.append(pose.position_distance(poses, task.goal)[:, None])
    columns.append(pose.angle_of(turn)[:, None])
    return np.concatenate(columns, axis=1).astype(np.float32)
