"""The trust domain: where the intent model's prediction is relied upon (§3.4)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.pose import Array
from koopdqn.tasks.task import angles_in

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")


class TrustSettings(Settings, ABC):
    """How the trust domain is drawn around the demonstrations; a new kind is a subclass and a YAML file."""

    error_of: Literal["raw", "rescaled"] = Field(
        description="whether the error that counts is the raw prediction's or that of one as long as the agent's step"
    )
    error_limit_m: float = Field(gt=0, description="trust no step whose held-out one-step error is larger [m]")
    error_limit_rad: float = Field(gt=0, description="the same for orientation [rad]")
    needs: Literal["reached", "both"] = Field(
        description="which state must be trusted: the reached one (the paper) or also the one before"
    )

    @abstractmethod
    def fit(self, trajectories: list[Array], errors: list[Array], frame: Array) -> "TrustDomain":
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
class TrustDomain(ABC):
    """Where the model is relied upon.

    Attributes:
        settings: what it was drawn with.
        error: (S, 2) [m, rad] the largest held-out one-step errors of position and orientation along the
            demonstrations, at the S places that the domain consists of.
        balls: what it was extended with.
    """

    settings: TrustSettings
    error: Array
    balls: Balls

    @classmethod
    def fit(
        cls, trajectories: list[Array], errors: list[Array], frame: Array, settings: TrustSettings
    ) -> "TrustDomain":
        """Return the domain of pose trajectories (N, 7).

        Args:
            trajectories: demonstrated poses at the agent's step.
            errors: (N − 1, 2) held-out one-step errors [m, rad] of each; zero where none could be measured.
            frame: (2, 4) of angles, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
            settings: how it is drawn.
        """
        return settings.fit(trajectories, errors, frame)

    @classmethod
    def restore(cls, arrays: Mapping[str, np.ndarray], settings: TrustSettings) -> "TrustDomain":
        """Return the domain whose :meth:`arrays` these are."""
        domain = settings.restore(arrays)
        return domain.extended(arrays["ball_poses"], arrays["ball_radii"]) if "ball_poses" in arrays else domain

    def arrays(self) -> dict[str, np.ndarray]:
        """Return everything but the settings, as arrays."""
        held = {"error": self.error, **self.shape()}
        if len(self.balls.radii):
            held |= {"ball_poses": self.balls.poses, "ball_radii": self.balls.radii}
        return held

    @abstractmethod
    def shape(self) -> dict[str, np.ndarray]:
        """Return the arrays that hold the domain's shape."""

    @abstractmethod
    def covers(self, poses: Array, steps: np.ndarray) -> np.ndarray:
        """Return whether demonstrations and errors vouch for poses (N, 7) after ``steps`` (N,), as booleans (N,)."""

    @abstractmethod
    def depth(self, poses: Array) -> Array:
        """Return how far poses (N, 7) are from the middle of the demonstrations, in its half widths, (N,)."""

    @abstractmethod
    def reason(self, point: Array, step: int) -> str:
        """Return in a few words why a pose (7,) that is not trusted after ``step`` steps is not."""

    def inside(self, poses: Array, steps: np.ndarray) -> np.ndarray:
        """Return ``indomain`` of poses (N, 7) reached after ``steps`` (N,) steps, as booleans (N,).

        The step count matters to a domain that matches states by step only.
        """
        return np.asarray(self.covers(poses, steps) | self.balls.holds(poses))

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
        """Whether the model's held-out errors are within their limits at every place, as booleans (S,)."""
        return np.asarray(np.all(self.error <= self._limits, axis=1))

    def outside(self, point: Array, step: int) -> str:
        """Return in a few words why a pose (7,) is not trusted, or an empty string if it is."""
        return "" if self.inside(point[None], np.array([step]))[0] else self.reason(point, step)

    def error_reason(self, place: int) -> str:
        """Return what is said of a state that is not trusted for the model's error at a place."""
        position, rotation = self.error[place] * (1e3, np.degrees(1.0))
        most, turn = self._limits * (1e3, np.degrees(1.0))
        return (
            f"the model's held-out error here is {position:.2f} mm and {rotation:.2f}°"
            f" (limits {most:.2f} mm and {turn:.2f}°)"
        )

    @property
    def _limits(self) -> Array:
        return np.array([self.settings.error_limit_m, self.settings.error_limit_rad])


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
