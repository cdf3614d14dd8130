"""Observables: the functions g that lift a state so that its dynamics become linear (Eqs. 5, 6)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from itertools import combinations_with_replacement
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field, PrivateAttr, model_validator

from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.settings import Floats, Interval, Settings, load_settings, shown


class Observables(Settings, ABC):
    """A lift g of states x (N, d) to z (N, D) whose first d entries are x itself.

    The inverse g⁻¹ reads those entries (§5.1, Eq. 14). Subclass it for new observables; the fields are its settings.
    """

    def lift(self, states: Array) -> Array:
        """Return the lifted states (N, D) of states (N, d).

        Raises:
            BadInputError: the features are no real numbers (N, D − d).
        """
        features = np.asarray(self.features(states))
        if features.ndim != 2 or len(features) != len(states) or features.dtype.kind not in "fiub":
            found = f"{features.dtype} of shape {features.shape}"
            raise self._must_return(f"real numbers of shape ({len(states)}, any number), a row a state", found)
        return np.concatenate([states, features], axis=1)

    def lift_to_fit(self, states: Array) -> Array:
        """Return :meth:`lift` of states (N, d) that a model is fitted to.

        Raises:
            BadInputError: the features of finite states are not real numbers (N, D − d), or not finite.
        """
        lifted = self.lift(states)
        if not np.isfinite(lifted).all() and np.isfinite(states).all():
            row = int(np.isfinite(lifted).all(axis=1).argmin())
            features = shown(lifted[row, states.shape[1] :].tolist())
            raise self._must_return("finite numbers", f"{features} of a state {states[row].tolist()}")
        return lifted

    def _must_return(self, rule: str, found: str) -> BadInputError:
        return BadInputError(f"observables {type(self).__name__}: features must return {rule}, found {found}")

    @abstractmethod
    def features(self, states: Array) -> Array:
        """Return the nonlinear part (N, D − d) of the lift of states (N, d)."""

    def fitted_to(self, states: Array) -> "Observables":
        """Return the observables fitted to states (M, d), where they depend on data."""
        return self

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what :meth:`fitted_to` took from the states."""
        return {}

    def restored(self, arrays: Mapping[str, np.ndarray]) -> "Observables":
        """Return the observables with these :meth:`arrays`."""
        return self


def _to_observables(where: str) -> BeforeValidator:
    return BeforeValidator(lambda v: load_settings(v, Observables, where) if isinstance(v, Mapping) else v)


AnyObservables = Annotated[Observables, _to_observables("intent.observables")]
"""Observables of any kind, as a field of settings."""
RotationObservables = Annotated[Observables, _to_observables("intent.rotation.observables")]
"""The same for the model of orientations."""


class Affine(Observables):
    """A constant observable, with which affine dynamics are linear."""

    def features(self, states: Array) -> Array:
        """Return ones (N, 1)."""
        return np.ones((len(states), 1))


class SecondOrder(Observables):
    """The paper's lift: [a, b, c] → [a, b, c, a², b², c², ab, ac, bc] (§5.1), for any number of components."""

    def features(self, states: Array) -> Array:
        """Return the squares and the products of pairs, in the paper's order."""
        first, second = np.triu_indices(states.shape[1], k=1)
        return np.concatenate([states**2, states[:, first] * states[:, second]], axis=1)


class Polynomial(Observables):
    """All monomials of the state from degree 2 to ``degree``; they vanish at the origin."""

    degree: int = Field(ge=1, le=12, description="highest degree")

    def features(self, states: Array) -> Array:
        """Return the monomials (N, F) of states (N, d), by degree and then in lexicographic order."""
        columns = [
            np.prod(states[:, list(chosen)], axis=1)
            for degree in range(2, self.degree + 1)
            for chosen in combinations_with_replacement(range(states.shape[1]), degree)
        ]
        return np.stack(columns, axis=1) if columns else np.zeros((len(states), 0))


class RandomFourier(Observables):
    """Random Fourier features of Gaussian kernels that vanish at the origin: √(2/F)·(cos(wᵀx + b) − cos b).

    With the goal as origin every observable is zero there, so that the goal is a fixed point of K whatever the data
    (features of Rahimi & Recht 2007). Kernel widths are spaced logarithmically: narrow ones follow the path's turns,
    wide ones extrapolate its direction.
    """

    count: int = Field(ge=1, le=5000, description="number of features F")
    length_scales: Interval = Field(
        description="narrowest and widest kernel, in units of the demonstrations' spread; equal for one kernel"
    )
    seed: int = Field(ge=0, description="of the frequencies w and phases b")

    @model_validator(mode="after")
    def _check_scales(self) -> "RandomFourier":
        if not 0 < self.length_scales[0] <= self.length_scales[1]:
            raise ValueError(f"length_scales must be positive, the narrowest first, found {list(self.length_scales)}")
        return self

    @cached_property
    def _draw(self) -> tuple[Array, Array, Array]:
        rng = np.random.default_rng([self.seed, self.count])
        share = (np.arange(self.count) + 0.5) / self.count
        narrowest, widest = self.length_scales
        scales = narrowest * (widest / narrowest) ** share
        frequencies, phases = rng.normal(size=(3, self.count)) / scales, rng.uniform(0, 2 * np.pi, self.count)
        return frequencies, phases, np.cos(phases)

    def features(self, states: Array) -> Array:
        """Return the features (N, F) of states (N, 3)."""
        frequencies, phases, at_goal = self._draw
        # In place: with many states, allocating costs more than the arithmetic.
        waves: Array = states @ frequencies
        waves += phases
        np.cos(waves, out=waves)
        waves -= at_goal
        waves *= np.sqrt(2.0 / self.count)
        return waves


class RadialBasis(Observables):
    """Gaussian radial basis functions minus their value at the origin, which stays a fixed point.

    The first center is the state nearest to the origin, each further one the state farthest from those before
    (Gonzalez 1985).
    """

    count: int = Field(ge=1, le=5000, description="number of centers, or of the states if there are fewer")
    length_scale: float = Field(gt=0, description="of the functions, in units of the demonstrations' spread")

    _centers: Array | None = PrivateAttr(default=None)

    def fitted_to(self, states: Array) -> Observables:
        """Return the observables with centers chosen among states (M, d)."""
        chosen = [int((states**2).sum(axis=1).argmin())]
        apart = ((states - states[chosen[0]]) ** 2).sum(axis=1)
        while len(chosen) < self.count and apart.max() > 0:
            chosen.append(int(apart.argmax()))
            apart = np.minimum(apart, ((states - states[chosen[-1]]) ** 2).sum(axis=1))
        return self.restored({"centers": states[chosen]})

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the centers (F, d)."""
        return {} if self._centers is None else {"centers": self._centers}

    def restored(self, arrays: Mapping[str, np.ndarray]) -> Observables:
        """Return the observables with these centers."""
        copy = self.model_copy()
        copy._centers = np.array(arrays["centers"])
        return copy

    def features(self, states: Array) -> Array:
        """Return the features (N, F) of states (N, d).

        Raises:
            ValueError: there are no centers yet.
        """
        if self._centers is None:
            raise ValueError("the centers must be chosen among states first (fitted_to), found none")
        return self._bumps(states) - self._bumps(np.zeros((1, states.shape[1])))

    def _bumps(self, states: Array) -> Array:
        centers = self._centers
        assert centers is not None
        squared = (states**2).sum(axis=1)[:, None] - 2.0 * states @ centers.T + (centers**2).sum(axis=1)
        return np.asarray(np.exp(-0.5 * np.maximum(squared, 0.0) / self.length_scale**2))


class RadialTurn(Observables):
    """The direction o/‖o‖ times hat functions of the angle ‖o‖, for rotation vectors o from the goal.

    A turn along the geodesic to the goal shortens o and keeps its direction. With these observables such dynamics are
    exactly linear if their rate is linear between the knots. There is no wrap below half a turn.
    """

    knots: Floats = Field(min_length=2, description="angles at which the hat functions peak, increasing [rad]")

    @model_validator(mode="after")
    def _check_knots(self) -> "RadialTurn":
        if self.knots[0] <= 0 or np.any(np.diff(self.knots) <= 0):
            raise ValueError(f"knots must be positive and increase, found {list(self.knots)}")
        return self

    def features(self, states: Array) -> Array:
        """Return the features (N, 3 K) of rotation vectors (N, 3) [rad] for K knots."""
        angle = np.linalg.norm(states, axis=1)
        # Below the first knot the direction fades to zero at the goal.
        direction = states / np.maximum(angle, self.knots[0])[:, None]
        count = len(self.knots)
        hats = np.stack([np.interp(angle, self.knots, np.eye(count)[k]) for k in range(count)], axis=1)
        return np.asarray((hats[:, :, None] * direction[:, None, :]).reshape(len(states), 3 * count))
