"""The trust domain: where the intent model's prediction is relied upon (§3.4)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, Strict

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import angles_in

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")

# Standard normal quantile of a one-sided test at 5 %.
_CHANCE = 1.645


class TrustSettings(Settings, ABC):
    """How the trust domain is fitted to the demonstrations; a new kind is a subclass and a YAML file."""

    least_right: float = Field(
        ge=0, le=1, description="share of rewards that must have the right sign where they are trusted"
    )
    doubts: Annotated[tuple[float, ...], Strict(False), Field(min_length=1)] = Field(
        description="guard bands around the tolerance, as ascending shares of it: a comparison within the band is not"
        " trusted. A place takes the first band with which least_right of the signs are right; where even the last is"
        " clearly not enough nothing is trusted"
    )
    needs: Literal["reached", "both"] = Field(
        description="which states must be trusted: the reached one (the paper) or also the one before"
    )

    @abstractmethod
    def fit(self, trajectories: list[Array], signs: list[Array], frame: Array) -> "TrustDomain":
        """Return the domain of pose trajectories (N, 7).

        Args:
            trajectories: demonstrated poses at the agent's step.
            signs: (N − 1, L, 2) for each, at every state but the last and for each of L doubts: how many rewards have
                the right sign in leave-one-out, of how many (:func:`koopdqn.intent.validation.jackknife_signs`).
            frame: (2, 4) of angles, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
        """

    def nominal(self, trajectories: list[Array]) -> float | None:
        """Return the nominal coverage of new demonstrations with these (N, 7) each; None if there is none."""
        return None

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray]) -> "TrustDomain":
        """Return the domain with these :meth:`TrustDomain.arrays`."""


@dataclass(frozen=True)
class Balls:
    """Balls around single poses that are trusted in addition to the demonstrations' domain.

    Attributes:
        poses: (M, 7) centers.
        radii: (M,) [m].
        turn: largest rotation distance from a center [rad].
    """

    poses: Array
    radii: Array
    turn: float

    def distance(self, poses: Array) -> Array:
        """Return the distances (N,) of poses (N, 7) from the nearest ball's center, in its radii."""
        if not len(self.radii):
            return np.full(len(poses), np.inf)
        squared = squared_distances(poses[:, pose.POSITION], self.poses[:, pose.POSITION])
        cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T), 0.0, 1.0)
        far = np.maximum(np.sqrt(squared) / self.radii, 2.0 * np.arccos(cosine) / self.turn)
        return np.asarray(far.min(axis=1))

    def contains(self, poses: Array) -> np.ndarray:
        """Return whether a ball contains each pose (N, 7), as booleans (N,)."""
        if not len(self.radii):
            return np.zeros(len(poses), dtype=bool)
        near = squared_distances(poses[:, pose.POSITION], self.poses[:, pose.POSITION]) <= self.radii**2
        turned = np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T) >= np.cos(0.5 * self.turn)
        return np.asarray((near & turned).any(axis=1))


@dataclass(frozen=True)
class Trust:
    """Whether N poses are trusted, and why.

    Attributes:
        demonstrated: (N,) whether by the demonstrations.
        certified: (N,) whether by a nearby answer alone.
        doubt: (N,) guard band: the share of the tolerance within which comparisons are not trusted.
    """

    demonstrated: np.ndarray
    certified: np.ndarray
    doubt: Array


@dataclass(frozen=True)
class TrustDomain(ABC):
    """Where the intent model is trusted.

    Attributes:
        settings: how it was fitted.
        right: (S,) share of counted rewards with the right sign in leave-one-out, at each of the domain's S places.
        doubt: (S,) guard band there, as a share of the tolerance; infinite where nothing is trusted.
        balls: what answers added.
    """

    settings: TrustSettings
    right: Array
    doubt: Array
    balls: Balls

    places: ClassVar[tuple[str, ...]] = ()
    """Names of the arrays (S, ...) of its places, the first of which begins with positions."""

    @property
    def shaped(self) -> bool:
        """Whether it lies somewhere; one that trusts everything or nothing does not."""
        return True

    def nearest_step(self, point: Array) -> int | None:
        """Return the step at whose place a pose (7,) is nearest; None of a domain that is the same at every step."""
        return None

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what the domain consists of but its settings and balls, as arrays."""
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name not in ("settings", "balls")}

    def drawn(self, frame: StartFrame) -> Self:
        """Return the domain for pictures, with its places where they lie: a frame may have unfolded a path."""
        if frame.unfolding is None:
            return self
        first = getattr(self, self.places[0])
        kept = ~frame.between_floors(first[:, pose.POSITION])
        held = {name: getattr(self, name)[kept] for name in (*self.places, "right", "doubt")}
        balls = self.balls.poses.copy()
        for rows in (held[self.places[0]], balls):
            rows[:, pose.POSITION] = frame.folded(rows[:, pose.POSITION])
        return replace(self, balls=replace(self.balls, poses=balls), **held)

    @abstractmethod
    def shape_contains(self, poses: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the shape contains poses (N, 7) after ``steps`` (N,), and the doubt (N,) there.

        The doubt of a pose outside the shape has no meaning.
        """

    @abstractmethod
    def depth(self, poses: Array) -> Array:
        """Return the distances (N,) of poses (N, 7) from the shape's middle, in its half widths."""

    @abstractmethod
    def gap(self, poses: Array) -> Array:
        """Return the distances (N,) [m] of the positions of poses (N, 7) from the shape; 0 within it."""

    @abstractmethod
    def reason(self, point: Array, step: int) -> str:
        """Return in a few words why an untrusted pose (7,) after ``step`` steps is not trusted."""

    def assess(self, poses: Array, steps: np.ndarray) -> Trust:
        """Return whether poses (N, 7) reached after ``steps`` (N,) steps are trusted, and why.

        Demonstrations go before answers: within the shape, where the model errs, no ball is trusted. The step count
        matters only to a domain that matches states by step.
        """
        demonstrated, doubt = self.shape_contains(poses, steps)
        doubt = np.where(demonstrated, doubt, self._largest_doubt)
        return Trust(demonstrated & np.isfinite(doubt), ~demonstrated & self.balls.contains(poses), doubt)

    @cached_property
    def _largest_doubt(self) -> float:
        """The largest finite doubt of all places, used outside the shape."""
        return float(self.doubt[self.known].max(initial=self.settings.doubts[0]))

    def contains(self, poses: Array, steps: np.ndarray) -> np.ndarray:
        """Return ``indomain`` of poses (N, 7) reached after ``steps`` (N,) steps, as booleans (N,)."""
        trust = self.assess(poses, steps)
        return np.asarray(trust.demonstrated | trust.certified)

    def distance(self, poses: Array) -> Array:
        """Return the distances (N,) of poses (N, 7) from the domain's middle, in its radii: at most 1 within.

        The larger of position and orientation counts, each in its own unit. The distance is that of the shape alone: a
        place where the model errs is not trusted even within 1.
        """
        return np.minimum(self.depth(poses), self.balls.distance(poses))

    def extended(self, poses: Array, radii: Array) -> Self:
        """Return the domain with further trusted balls of radii (M,) [m] around poses (M, 7)."""
        balls = Balls(
            np.concatenate([self.balls.poses, poses]), np.concatenate([self.balls.radii, radii]), self.balls.turn
        )
        return replace(self, balls=balls)

    @property
    def known(self) -> np.ndarray:
        """Whether rewards at every place are trusted, as booleans (S,)."""
        return np.asarray(np.isfinite(self.doubt))

    def outside(self, point: Array, step: int) -> str:
        """Return in a few words why a pose (7,) is not trusted, or an empty string if it is."""
        return "" if self.contains(point[None], np.array([step]))[0] else self.reason(point, step)

    def doubt_of(self, place: int) -> str:
        """Return in a few words how few rewards are right at an untrusted place."""
        return (
            f"with a demonstration left out only {self.right[place]:.0%} of the rewards here are right"
            f" (least {self.settings.least_right:.0%})"
        )


def calibrate(
    places: list[np.ndarray], signs: list[Array], count: int, window: int, settings: TrustSettings
) -> tuple[Array, Array]:
    """Return the share of right signs and the doubt, (S,) each, at S places.

    The doubt is infinite, and the place not trusted, where the share with the largest doubt is significantly below the
    stated one (one-sided score test of a proportion at 5 %).

    Args:
        places: (N − 1,) for each demonstration, the place of each of its states.
        signs: (N − 1, L, 2) for each, as :meth:`TrustSettings.fit` takes them.
        count: number S of places.
        window: neighbours to either side that count too; a place without states takes the values of the nearest.
        settings: the stated share, and the L doubts.
    """
    totals, states = np.zeros((count, len(settings.doubts), 2)), np.zeros(count)
    for where, counted in zip(places, signs, strict=True):
        np.add.at(totals, where, counted)
        np.add.at(states, where, 1.0)
    spans = [slice(max(0, i - window), i + window + 1) for i in range(count)]
    around, states = (np.array([values[span].sum(axis=0) for span in spans]) for values in (totals, states))
    seen = np.flatnonzero(around[:, 0, 1] > 0)
    nearest = seen[np.abs(np.arange(count)[:, None] - seen).argmin(axis=1)]
    share = around[nearest, :, 0] / around[nearest, :, 1]
    stated = settings.least_right
    enough = share >= stated
    level = np.where(enough.any(axis=1), enough.argmax(axis=1), len(settings.doubts) - 1)
    right = share[np.arange(count), level]
    refuted = right < stated - _CHANCE * np.sqrt(stated * (1.0 - stated) / states[nearest])
    return right, np.where(refuted, np.inf, np.array(settings.doubts)[level])


def no_balls(turn: float) -> Balls:
    """Return no balls; those added later contain orientations within ``turn`` [rad]."""
    return Balls(np.zeros((0, 7)), np.zeros(0), turn)


def squared_distances(positions: Array, others: Array) -> Array:
    """Return the squared distances (N, M) [m²] of positions (N, 3) and others (M, 3) [m]."""
    # Centering both keeps the cancellation of the three terms harmless.
    middle = others.mean(axis=0)
    a, b = positions - middle, others - middle
    return np.asarray(np.maximum((a**2).sum(axis=1)[:, None] - 2.0 * a @ b.T + (b**2).sum(axis=1), 0.0))


def components_of(poses: Array, frame: Array) -> Array:
    """Return x, y, z [m] and roll, pitch, yaw [rad] (N, 6) of poses (N, 7), angles in a frame (2, 4)."""
    return np.concatenate([poses[:, pose.POSITION], angles_in(frame, poses[:, pose.QUATERNION])], axis=1)
