"""Double DQN: updates from replayed transitions (Eqs. 1, 3; van Hasselt et al. 2016), with Adam (Kingma & Ba 2015)."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from koopdqn.artifact import below
from koopdqn.intent.reward import ActionEvaluation
from koopdqn.rl.network import Buffers, QNetwork
from koopdqn.rl.replay_buffer import Batch
from koopdqn.rl.settings import Agent, AgentSettings
from koopdqn.threads import halves, side_by_side

_BETA1: Final = 0.9
_BETA2: Final = 0.999
_EPSILON: Final = 1e-8
# The backward functions of the mean squared error and of ReLU, as autograd calls them.
_mse_slope = torch.ops.aten.mse_loss_backward
_relu_slope = torch.ops.aten.threshold_backward.grad_input
_MEAN: Final = 1
_ONE: Final = torch.ones(())


class Adam:
    """The optimiser Adam with its default decay rates.

    All parameters lie in one array, one after the other, and are moved at once.

    Attributes:
        gradients: where the gradient with respect to each parameter is put before a step.
    """

    def __init__(self, parameters: Sequence[Tensor], learning_rate: float) -> None:
        """Begin with moments of zero; the parameters' memory becomes part of the array."""
        self._learning_rate = learning_rate
        self._parameters = list(parameters)
        self._values = torch.cat([values.detach().flatten() for values in parameters])
        self._gradient, self._mean, self._square, self._root = (torch.zeros_like(self._values) for _ in range(4))
        self.gradients = self._each(self._gradient)
        for parameter, values in zip(parameters, self._each(self._values), strict=True):
            parameter.data = values
        self._steps = [torch.zeros(()) for _ in parameters]

    def step(self) -> None:
        """Make one step of gradient descent."""
        steps = float(self._steps[0]) + 1.0
        root = (1 - _BETA2**steps) ** 0.5
        self._mean.lerp_(self._gradient, 1 - _BETA1)
        self._square.mul_(_BETA2).addcmul_(self._gradient, self._gradient, value=1 - _BETA2)
        torch.sqrt(self._square, out=self._root).div_(root).add_(_EPSILON)
        self._values.addcdiv_(self._mean, self._root, value=-self._learning_rate / (1 - _BETA1**steps))
        for count in self._steps:
            count += 1

    def descend(self, loss: Tensor) -> None:
        """Make one step down a loss, its gradient found by autograd."""
        found = torch.autograd.grad(loss, self._parameters)
        torch.cat([each.flatten() for each in found], out=self._gradient)
        self.step()

    def state(self) -> dict[str, np.ndarray]:
        """Return a copy of the moments and the step count of every parameter, by its index."""
        return {
            f"{index}.{name}": values.cpu().numpy().copy()
            for name, column in self._columns().items()
            for index, values in enumerate(column)
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`state` returned."""
        for name, column in self._columns().items():
            for index, values in enumerate(column):
                values.copy_(torch.from_numpy(state[f"{index}.{name}"]))

    def _columns(self) -> dict[str, list[Tensor]]:
        return {"exp_avg": self._each(self._mean), "exp_avg_sq": self._each(self._square), "step": self._steps}

    def _each(self, values: Tensor) -> list[Tensor]:
        """Return the part of an array that is of each parameter, in its shape."""
        parts = torch.split(values, [each.numel() for each in self._parameters])
        return [part.view_as(each) for part, each in zip(parts, self._parameters, strict=True)]


def q_targets(rewards: Tensor, online_next: Tensor, target_next: Tensor, gamma: float, double: bool) -> Tensor:
    """Return the targets (N,) of Q(s, a) where something follows; elsewhere a target is the reward alone.

    Double: r + γ Q'(s', argmax_a Q(s', a)). Otherwise Eq. 3 as written, with the target network Q':
    r + γ max_a Q'(s', a). Rewards are (N,), Q(s', ·) and Q'(s', ·) of the online and the target network (N, 10).
    """
    if double:
        best = online_next.argmax(dim=1, keepdim=True)
        value = target_next.gather(1, best).squeeze(1)
    else:
        value = target_next.max(dim=1).values
    return rewards + gamma * value


class Networks(ABC):
    """An online network and its target, one of which is the policy, and the state of all that learns with them.

    Attributes:
        settings: of the agent.
        online: the network that acts.
        target: the network that evaluates.
        updates: number of updates made.
    """

    settings: Agent
    online: QNetwork
    target: QNetwork
    updates: int

    @abstractmethod
    def _parts(self) -> "dict[str, nn.Module | Adam]":
        """Return everything that learns, by the name under which its state is stored."""

    def normalise_to(self, observations: np.ndarray) -> None:
        """Set mean and spread of both networks' inputs from observations (N, inputs)."""
        self.online.normalise_to(observations)
        self.target.normalise_to(observations)

    @property
    def policy_network(self) -> QNetwork:
        """The network that is the policy: the online one, or the target, its average over updates."""
        return self.target if self.settings.policy_network == "target" else self.online

    def policy_arrays(self) -> dict[str, np.ndarray]:
        """Return a copy of the policy network's parameters and buffers."""
        return arrays_of(self.policy_network)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as arrays."""
        state = {"updates": np.array(self.updates)}
        for part, held in self._parts().items():
            arrays = held.state() if isinstance(held, Adam) else arrays_of(held)
            state |= {f"{part}.{name}": values for name, values in arrays.items()}
        return state

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`state` returned."""
        for part, held in self._parts().items():
            arrays = below(state, f"{part}.")
            if isinstance(held, Adam):
                held.restore(arrays)
            else:
                load_arrays(held, arrays)
        self.updates = int(state["updates"])

    def _tensor(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(values).to(self.online.device)


class Learner(Networks):
    """The double DQN: networks of the values of the ten actions, and the optimiser."""

    settings: AgentSettings

    def __init__(self, inputs: int, settings: AgentSettings, rng: np.random.Generator) -> None:
        """Make the networks for observations of ``inputs`` values, with weights drawn from ``rng``."""
        self.settings = settings
        self.online, self.target = (QNetwork(inputs, settings.network, rng, settings.device) for _ in range(2))
        self._device = self.online.device
        self.target.load_state_dict(self.online.state_dict())
        self.updates = 0
        self._adam = Adam(list(self.online.parameters()), settings.learning_rate)
        self._parameters, self._target_parameters = (
            [values.detach() for values in network.parameters()] for network in (self.online, self.target)
        )
        self._forward, self._backward = (Buffers(self._device) for _ in range(2))

    def _parts(self) -> dict[str, nn.Module | Adam]:
        return {"online": self.online, "target": self.target, "adam": self._adam}

    def propose(self, observe: Callable[[], NDArray[np.float32]], rng: np.random.Generator) -> None:
        """Propose nothing: Table 1's actions are all there are."""

    def ranking(self, observations: NDArray[np.float32], evaluation: ActionEvaluation) -> np.ndarray:
        """Return by what (N, 10) an action is chosen: its value."""
        return self.online.values(observations)

    def update(self, batch: Batch) -> float:
        """Make one update from a batch and return its loss (mean squared error).

        Adjacent transitions of one state share its forward pass.
        """
        stop = batch.terminated if self.settings.bootstrap_undone else batch.terminated | batch.undone
        with torch.no_grad():
            targets = self._targets(batch, stop)
            states, state_of = distinct(batch.observations)
            features, (layers,) = self.online.passed(self._tensor(states), self._forward, self.online)
            index = self._tensor(state_of), self._tensor(batch.actions)
            chosen = layers[-1][index]
            loss = nn.functional.mse_loss(chosen, targets)
            slope = torch.zeros_like(layers[-1])
            slope.index_put_(index, _mse_slope(_ONE.to(self._device), chosen, targets, _MEAN), accumulate=True)
            self._find_gradients([features, *layers[:-1]], slope)
            self._adam.step()
            self.updates += 1
            if self.updates % self.settings.target_every == 0:
                torch._foreach_lerp_(self._target_parameters, self._parameters, self.settings.target_rate)
        return float(loss)

    def _targets(self, batch: Batch, stop: NDArray[np.bool_]) -> Tensor:
        """Return the targets (N,) of a batch; where ``stop`` (N,) is true they do not bootstrap."""
        # Most actions of a state are wrong, and their targets do not bootstrap.
        follows = np.flatnonzero(~stop)
        # Features are not learned, so both networks have the same.
        after = self._tensor(batch.next_observations[follows])
        _, ((*_, online), (*_, target)) = self.online.passed(after, self._forward, self.online, self.target)
        targets = self._tensor(batch.rewards.copy())
        rows = self._tensor(follows)
        targets[rows] = q_targets(targets[rows], online, target, self.settings.gamma, self.settings.double)
        return targets

    def _find_gradients(self, inputs: list[Tensor], slope: Tensor) -> None:
        """Put the gradients of the loss with respect to the online parameters where Adam takes them.

        Given are the inputs of every layer (N, units) and the gradient with respect to Q (N, 10).
        """
        weights = [weight for weight, _ in self.online.weights]
        slopes = [self._backward.of(f"layer {index}", *seen.shape) for index, seen in enumerate(inputs) if index]
        slopes.append(slope)
        of_weights, of_biases = self._adam.gradients[::2], self._adam.gradients[1::2]

        def pass_back(rows: slice) -> None:
            for index in range(len(weights) - 1, 0, -1):
                into = slopes[index - 1][rows]
                torch.mm(slopes[index][rows], weights[index], out=into)
                _relu_slope(into, inputs[index][rows], 0, grad_input=into)

        def weigh(half: int) -> None:
            for seen, after, found in zip(inputs, slopes, of_weights, strict=True):
                for units in halves(len(found))[half : half + 1]:
                    torch.mm(after[:, units].t(), seen, out=found[units])

        self.online.in_halves(len(slope), pass_back)
        if self._device.type == "cpu":
            side_by_side(weigh)
        else:
            weigh(0)
            weigh(1)
        for after, found in zip(slopes, of_biases, strict=True):
            torch.sum(after, dim=0, out=found)


def distinct(observations: NDArray[np.float32]) -> tuple[NDArray[np.float32], np.ndarray]:
    """Return observations (N, inputs) with adjacent equal ones merged (B, inputs), and the index of each (N,)."""
    new = np.ones(len(observations), dtype=bool)
    new[1:] = (observations[1:] != observations[:-1]).any(axis=1)
    return observations[new], np.cumsum(new) - 1


def load_arrays(network: nn.Module, arrays: dict[str, np.ndarray]) -> None:
    """Set a network's parameters and buffers.

    Raises:
        RuntimeError: names or shapes do not fit the network.
    """
    network.load_state_dict({name: torch.from_numpy(values.copy()) for name, values in arrays.items()})


def arrays_of(network: nn.Module) -> dict[str, np.ndarray]:
    """Return a copy of a network's parameters and buffers."""
    return {name: values.detach().cpu().numpy().copy() for name, values in network.state_dict().items()}
