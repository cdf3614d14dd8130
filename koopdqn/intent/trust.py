"""The trust domain: where the intent model's prediction is relied upon (§3.4)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, Strict

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.task import angles_in

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")

# Standard deviations that chance alone exceeds to one side in one of twenty cases.
_CHANCE = 1.645


class TrustSettings(Settings, ABC):
    """How the trust domain is drawn around the demonstrations; a new kind is a subclass and a YAML file."""

    least_right: float = Field(
        ge=0, le=1, description="share of rewards that must have the right sign where they are trusted"
    )
    doubts: Annotated[tuple[float, ...], Strict(False), Field(min_length=1)] = Field(
        description="shares of the tolerance, ascending: the first one by which comparisons must be clear of it for"
        " least_right of them to be right holds at a place; where the last is clearly not enough nothing is trusted"
    )
    needs: Literal["reached", "both"] = Field(
        description="which state must be trusted: the reached one (the paper) or also the one before"
    )

    @abstractmethod
    def fit(self, trajectories: list[Array], signs: list[Array], frame: Array) -> "TrustDomain":
        """Return the domain of pose trajectories (N, 7); see :meth:`TrustDomain.fit`."""

    def nominal(self, count: int) -> float | None:
        """Return the share of new demonstrations that a domain of ``count`` is made to hold; None for no promise."""
        return None

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray]) -> "TrustDomain":
        """Return the domain whose :meth:`TrustDomain.arrays` these are, without what it was extended with."""


@dataclass(frozen=True)
class Balls:
    """Surroundings of single poses that are trusted on top of what the demonstrations vouch for.

    Attributes:
        poses: (M, 7) their middles.
        radii: (M,) [m].
        turn: how far an orientation may be from a middle's [rad].
    """

    poses: Array
    radii: Array
    turn: float

    def distance(self, poses: Array) -> Array:
        """Return how far poses (N, 7) are from the middle of the ball that is nearest, in its radii, (N,)."""
        if not len(self.radii):
            return np.full(len(poses), np.inf)
        squared = squared_distances(poses[:, pose.POSITION], self.poses[:, pose.POSITION])
        cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T), 0.0, 1.0)
        far = np.maximum(np.sqrt(squared) / self.radii, 2.0 * np.arccos(cosine) / self.turn)
        return np.asarray(far.min(axis=1))

    def holds(self, poses: Array) -> np.ndarray:
        """Return whether each pose (N, 7) is in a ball, as booleans (N,)."""
        if not len(self.radii):
            return np.zeros(len(poses), dtype=bool)
        near = squared_distances(poses[:, pose.POSITION], self.poses[:, pose.POSITION]) <= self.radii**2
        turned = np.abs(poses[:, pose.QUATERNION] @ self.poses[:, pose.QUATERNION].T) >= np.cos(0.5 * self.turn)
        return np.asarray((near & turned).any(axis=1))


@dataclass(frozen=True)
class Vouched:
    """What vouches for N poses.

    Attributes:
        shown: (N,) whether demonstrations do.
        answered: (N,) whether only an answer nearby does.
        doubt: (N,) by which share of the tolerance comparisons must be clear of it to be relied upon.
    """

    shown: np.ndarray
    answered: np.ndarray
    doubt: Array


@dataclass(frozen=True)
class TrustDomain(ABC):
    """Where the model is relied upon.

    Attributes:
        settings: what it was drawn with.
        right: (S,) the share of the rewards that count whose sign is right with a demonstration left out, at the S
            places that the domain consists of.
        doubt: (S,) by which share of the tolerance a comparison must be clear of it to count there; infinite where
            nothing is trusted.
        balls: what it was extended with.
    """

    settings: TrustSettings
    right: Array
    doubt: Array
    balls: Balls

    @classmethod
    def fit(cls, trajectories: list[Array], signs: list[Array], frame: Array, settings: TrustSettings) -> "TrustDomain":
        """Return the domain of pose trajectories (N, 7).

        Args:
            trajectories: demonstrated poses at the agent's step.
            signs: (N − 1, L, 2) for each state but the last of each and each of L doubts: how many rewards have the
                right sign by a model that has not seen the demonstration, of how many that count
                (:mod:`koopdqn.intent.signs`).
            frame: (2, 4) of angles, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
            settings: how it is drawn.
        """
        return settings.fit(trajectories, signs, frame)

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: TrustSettings) -> "TrustDomain":
        """Return the domain whose :meth:`arrays` these are."""
        domain = settings.restore(arrays)
        return domain.extended(arrays["ball_poses"], arrays["ball_radii"]) if "ball_poses" in arrays else domain

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything but the settings, as arrays."""
        held = {"right": self.right, "doubt": self.doubt, **self.shape()}
        if len(self.balls.radii):
            held |= {"ball_poses": self.balls.poses, "ball_radii": self.balls.radii}
        return held

    @abstractmethod
    def shape(self) -> dict[str, np.ndarray]:
        """Return the arrays that hold the domain's shape."""

    @abstractmethod
    def covers(self, poses: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return of poses (N, 7) after ``steps`` (N,) whether they lie within the shape, and the doubt there.

        Booleans (N,) and shares of the tolerance (N,), which mean nothing outside the shape.
        """

    @abstractmethod
    def depth(self, poses: Array) -> Array:
        """Return how far poses (N, 7) are from the middle of the demonstrations, in its half widths, (N,)."""

    @abstractmethod
    def gap(self, poses: Array) -> Array:
        """Return how far the positions of poses (N, 7) are from what demonstrations vouch for, (N,) [m]; 0 within."""

    @abstractmethod
    def reason(self, point: Array, step: int) -> str:
        """Return in a few words why a pose (7,) that is not trusted after ``step`` steps is not."""

    def vouched(self, poses: Array, steps: np.ndarray) -> "Vouched":
        """Return what vouches for poses (N, 7) reached after ``steps`` (N,) steps.

        What demonstrations say goes before answers: where they went and the model errs, no ball is relied upon.
        The step count matters to a domain that matches states by step only.
        """
        within, doubt = self.covers(poses, steps)
        doubt = np.where(within, doubt, self._widest)
        return Vouched(within & np.isfinite(doubt), ~within & self.balls.holds(poses), doubt)

    @cached_property
    def _widest(self) -> float:
        """The largest doubt of all places, for what lies beside them."""
        return float(self.doubt[self.known].max(initial=self.settings.doubts[0]))

    def inside(self, poses: Array, steps: np.ndarray) -> np.ndarray:
        """Return ``indomain`` of poses (N, 7) reached after ``steps`` (N,) steps, as booleans (N,)."""
        vouched = self.vouched(poses, steps)
        return np.asarray(vouched.shown | vouched.answered)

    def distance(self, poses: Array) -> Array:
        """Return how far poses (N, 7) are from the domain's middle, in its radii, (N,): at most 1 within.

        Position and orientation are each measured in their own unit, and the larger counts. It is the shape alone:
        where the model is known to err, a distance within 1 is not trusted either.
        """
        return np.minimum(self.depth(poses), self.balls.distance(poses))

    def extended(self, poses: Array, radii: Array) -> Self:
        """Return the domain with balls around poses (M, 7) of radii (M,) [m], within which any state is trusted."""
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
        return "" if self.inside(point[None], np.array([step]))[0] else self.reason(point, step)

    def doubt_of(self, place: int) -> str:
        """Return what is said of a state that is not trusted for how often rewards are right at a place."""
        return (
            f"with a demonstration left out only {self.right[place]:.0%} of the rewards here are right"
            f" (least {self.settings.least_right:.0%})"
        )


def calibrated(
    places: list[np.ndarray], signs: list[Array], count: int, window: int, settings: TrustSettings
) -> tuple[Array, Array]:
    """Return the share of right signs and the doubt, (S,) each, at S places.

    A place is not trusted, of infinite doubt, where even the largest doubt leaves a share that is below the stated one
    by more than chance makes of so few states (score test of a share, one-sided, at 5 %).

    Args:
        places: (N − 1,) the place of each state of each demonstration.
        signs: (N − 1, L, 2) of each, as :meth:`TrustDomain.fit` takes them.
        count: number S of places.
        window: neighbours to either side that count too; a place without any state is like those next to it.
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
    """Return no balls; those added later hold orientations within ``turn`` [rad]."""
    return Balls(np.zeros((0, 7)), np.zeros(0), turn)


def squared_distances(positions: Array, others: Array) -> Array:
    """Return the squared distances (N, M) [m²] of positions (N, 3) and others (M, 3) [m]."""
    # One middle for both keeps the cancellation of the three terms harmless.
    middle = others.mean(axis=0)
    a, b = positions - middle, others - middle
    return np.asarray(np.maximum((a**2).sum(axis=1)[:, None] - 2.0 * a @ b.T + (b**2).sum(axis=1), 0.0))


def components_of(poses: Array, frame: Array) -> Array:
    """Return x, y, z [m] and roll, pitch, yaw [rad] (N, 6) of poses (N, 7), angles in a frame (2, 4)."""
    return np.concatenate([poses[:, pose.POSITION], angles_in(frame, poses[:, pose.QUATERNION])], axis=1)
