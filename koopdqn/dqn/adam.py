"""Adam (Kingma & Ba 2015) by torch's own function: to make its class loads torch's compiler, which takes a second."""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

_BETA1: Final = 0.9
_BETA2: Final = 0.999
_EPSILON: Final = 1e-8


class Adam:
    """An optimiser of given parameters, with the usual decay rates of the moments."""

    def __init__(self, parameters: Sequence[Tensor], learning_rate: float) -> None:
        """Begin without moments."""
        self._parameters = [parameter.detach() for parameter in parameters]
        self._learning_rate = learning_rate
        self._means = [torch.zeros_like(values) for values in self._parameters]
        self._squares = [torch.zeros_like(values) for values in self._parameters]
        self._steps = [torch.zeros(()) for _ in self._parameters]

    def step(self, gradients: Sequence[Tensor]) -> None:
        """Change the parameters by one step against their gradients."""
        adam(
            self._parameters,
            list(gradients),
            self._means,
            self._squares,
            [],
            self._steps,
            foreach=False,
            amsgrad=False,
            beta1=_BETA1,
            beta2=_BETA2,
            lr=self._learning_rate,
            weight_decay=0.0,
            eps=_EPSILON,
            maximize=False,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Return a copy of the moments and the step count of every parameter, by its index."""
        return {
            f"{index}.{name}": values.numpy().copy()
            for name, column in self._columns().items()
            for index, values in enumerate(column)
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on from what :meth:`state` returned."""
        for name, column in self._columns().items():
            for index, values in enumerate(column):
                values.copy_(torch.from_numpy(state[f"{index}.{name}"]))

    def _columns(self) -> dict[str, list[Tensor]]:
        return {"exp_avg": self._means, "exp_avg_sq": self._squares, "step": self._steps}
