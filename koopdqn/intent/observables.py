"""Observables: the functions g that lift a state so that its dynamics become linear (Eqs. 5, 6)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from koopdqn.config.settings import Floats, Settings, load_settings
from koopdqn.pose import Array


class Observables(Settings, ABC):
    """A lift g of states x (N, d) to z (N, D) whose first d entries are x itself.

    Because the state is part of the lift, the inverse g⁻¹ reads the first d entries (§5.1). Subclass it
    for new observables; the subclass's fields are its settings.
    """

    def lift(self, states: Array) -> Array:
        """Return the lifted states (N, D) of states (N, d)."""
        return np.concatenate([states, self.features(states)], axis=1)

    def project(self, lifted: Array, dimension: int) -> Array:
        """Return the states (N, d) of lifted states (N, D): the inverse g⁻¹, Eq. 14."""
        return lifted[:, :dimension]

    @abstractmethod
    def features(self, states: Array) -> Array:
        """Return the nonlinear part (N, D − d) of the lift of states (N, d)."""


def _to_observables(value: Any) -> Any:
    return load_settings(value, Observables, "intent.observables") if isinstance(value, Mapping) else value


AnyObservables = Annotated[Observables, BeforeValidator(_to_observables)]
"""Observables of any kind, as a field of settings."""


class Affine(Observables):
    """A constant beside the state, which makes an affine law linear."""

    def features(self, states: Array) -> Array:
        """Return ones (N, 1)."""
        return np.ones((len(states), 1))


class SecondOrder(Observables):
    """The paper's lift: [a, b, c] → [a, b, c, a², b², c², ab, ac, bc] (§5.1), for any number of components."""

    def features(self, states: Array) -> Array:
        """Return the squares and the products of pairs, in the paper's order."""
        first, second = np.triu_indices(states.shape[1], k=1)
        return np.concatenate([states**2, states[:, first] * states[:, second]], axis=1)


class RandomFourier(Observables):
    """Random Fourier features of a Gaussian kernel that vanish at the origin: √(2/F)·(cos(wᵀx + b) − cos b).

    With the goal as origin every observable is zero there, so that K maps the goal to itself: the
    goal is a fixed point whatever the data (Rahimi & Recht 2007 give the features).
    """

    count: int = Field(ge=1, le=5000, description="number of features F")
    length_scale: float = Field(gt=0, description="of the kernel, in units of the demonstrations' spread")
    seed: int = Field(ge=0, description="of the frequencies w and phases b")

    @cached_property
    def _draw(self) -> tuple[Array, Array]:
        rng = np.random.default_rng([self.seed, self.count])
        return rng.normal(size=(3, self.count)) / self.length_scale, rng.uniform(0, 2 * np.pi, self.count)

    def features(self, states: Array) -> Array:
        """Return the features (N, F) of states (N, 3)."""
        frequencies, phases = self._draw
        waves = np.cos(states @ frequencies + phases) - np.cos(phases)
        return np.asarray(np.sqrt(2.0 / self.count) * waves)


class RadialTurn(Observables):
    """For rotation vectors o from the goal: the direction o/‖o‖ times hat functions of the angle ‖o‖.

    A turn along the geodesic to the goal shortens o and keeps its direction, at a rate that may be any function
    of the angle; with these observables such a law is exactly linear where the rate is linear between the
    knots. They know no wrap: up to just short of half a turn o is continuous.
    """

    knots: Floats = Field(min_length=2, description="angles at which the hat functions peak, increasing [rad]")

    @model_validator(mode="after")
    def _check_knots(self) -> "RadialTurn":
        if self.knots[0] <= 0 or np.any(np.diff(self.knots) <= 0):
            raise ValueError(f"knots must be positive and increase, found {list(self.knots)}")
        return self

    def features(self, states: Array) -> Array:
        """Return the features (N, 3 knots) of rotation vectors (N, 3) [rad]."""
        angle = np.linalg.norm(states, axis=1)
        # Below the first knot the direction fades, so that everything vanishes at the goal.
        direction = states / np.maximum(angle, self.knots[0])[:, None]
        count = len(self.knots)
        hats = np.stack([np.interp(angle, self.knots, np.eye(count)[k]) for k in range(count)], axis=1)
        return np.asarray((hats[:, :, None] * direction[:, None, :]).reshape(len(states), 3 * count))
