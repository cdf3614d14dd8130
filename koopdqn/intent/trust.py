"""The trust domain: where the intent model's prediction is relied upon (§3.4)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.demonstrations.resample import to_count
from koopdqn.pose import Array
from koopdqn.tasks.path import at_arc_lengths
from koopdqn.tasks.task import angles_in

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")


class TrustSettings(Settings):
    """How the trust domain is drawn around the demonstrations."""

    matching: Literal["step", "any", "everywhere", "nowhere"] = Field(
        description="compare with the demonstrations' same step (the paper) or with any of their steps; or, to see what"
        " the domain is good for, trust everything or nothing"
    )
    sigmas: float = Field(gt=0, description="k: half the width of the domain, in standard deviations")
    position_floor_m: float = Field(ge=0, description="least standard deviation of x, y, z [m]")
    rotation_floor_rad: float = Field(ge=0, description="least standard deviation of roll, pitch, yaw [rad]")
    error_of: Literal["raw", "rescaled"] = Field(
        description="whether the error that counts is the raw prediction's or that of one as long as the agent's step"
    )
    error_limit_m: float = Field(gt=0, description="trust no step whose held-out one-step error is larger [m]")
    error_limit_rad: float = Field(gt=0, description="the same for orientation [rad]")
    needs: Literal["reached", "both"] = Field(
        description="which state must be trusted: the reached one (the paper) or also the one before"
    )


@dataclass(frozen=True)
class TrustDomain:
    """A box of k standard deviations around the mean of every step, less the steps where the model errs.

    Roll, pitch and yaw are those of the rotation relative to a frame that keeps them from their singularity.

    Attributes:
        settings: what it was drawn with.
        frame: (2, 4) that frame, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
        mean: (T, 6) [m, rad] of x, y, z, roll, pitch, yaw at every step.
        deviation: (T, 6) standard deviations, not below their floors.
        error: (T, 2) [m, rad] the largest held-out one-step errors of position and orientation at every step.
    """

    settings: TrustSettings
    frame: Array
    mean: Array
    deviation: Array
    error: Array

    @classmethod
    def fit(
        cls, trajectories: list[Array], errors: list[Array], frame: Array, settings: TrustSettings
    ) -> "TrustDomain":
        """Return the domain of pose trajectories (N, 7) with held-out one-step errors (N − 1, 2) [m, rad] each.

        With matching by step, the statistics of step t are over the demonstrations that have a step t, as
        in §3.4. Otherwise demonstrations are first aligned by their share of path travelled.
        """
        components = [components_of(trajectory, frame) for trajectory in trajectories]
        padded = [np.concatenate([error, error[-1:]]) for error in errors]
        longest = max(len(rows) for rows in components)
        if settings.matching != "step":
            aligned = [components_of(to_count(trajectory, longest), frame) for trajectory in trajectories]
            stack = np.array(aligned)
            mean, deviation = stack.mean(axis=0), stack.std(axis=0)
            share = np.linspace(0, 1, longest)
            error = np.max([at_arc_lengths(e, np.linspace(0, 1, len(e)), share) for e in padded], axis=0)
        else:
            at_step = [[rows[t] for rows in components if t < len(rows)] for t in range(longest)]
            mean = np.array([np.mean(rows, axis=0) for rows in at_step])
            deviation = np.array([np.std(rows, axis=0) for rows in at_step])
            error = np.array([np.max([e[t] for e in padded if t < len(e)], axis=0) for t in range(longest)])
        floor = np.repeat([settings.position_floor_m, settings.rotation_floor_rad], 3)
        return cls(settings, frame, mean, np.maximum(deviation, floor), error)

    def inside(self, poses: Array, steps: np.ndarray) -> np.ndarray:
        """Return ``indomain`` of poses (N, 7) reached after ``steps`` (N,) steps, as booleans (N,).

        The step count matters under matching by step only; past the demonstrations' end it is their last.
        """
        if self.settings.matching in ("everywhere", "nowhere"):
            return np.full(len(poses), self.settings.matching == "everywhere")
        rows = components_of(poses, self.frame)
        width = self.settings.sigmas * self.deviation
        known = self.known
        if self.settings.matching == "step":
            index = np.minimum(steps, len(self.mean) - 1)
            return np.asarray(np.all(np.abs(rows - self.mean[index]) <= width[index], axis=1) & known[index])
        inside = np.ones((len(rows), int(known.sum())), dtype=bool)
        # One component at a time keeps the (N, T) temporaries small.
        for i in range(rows.shape[1]):
            inside &= np.abs(rows[:, i : i + 1] - self.mean[known, i]) <= width[known, i]
        return np.asarray(inside.any(axis=1))

    @property
    def known(self) -> np.ndarray:
        """Whether the model's held-out errors are within their limits at every step, as booleans (T,)."""
        return np.asarray(np.all(self.error <= self._limits, axis=1))

    def outside(self, point: Array, step: int) -> str:
        """Return in a few words why a pose (7,) is not trusted, or an empty string if it is."""
        if self.inside(point[None], np.array([step]))[0]:
            return ""
        if self.settings.matching == "nowhere":
            return "nothing is trusted (trust.matching=nowhere)"
        row = components_of(point[None], self.frame)[0]
        gap = np.abs(row - self.mean)
        sigmas = np.where(gap > 0, gap / np.where(self.deviation > 0, self.deviation, 1e-12), 0.0)
        nearest = min(step, len(self.mean) - 1)
        if self.settings.matching != "step":
            nearest = int(sigmas.max(axis=1).argmin())
        worst = int(sigmas[nearest].argmax())
        if sigmas[nearest, worst] > self.settings.sigmas:
            name, far = COMPONENTS[worst], sigmas[nearest, worst]
            return f"{name} is {far:.1f} standard deviations from the demonstrations (limit {self.settings.sigmas:g})"
        position, rotation = self.error[nearest] * (1e3, np.degrees(1.0))
        most, turn = self._limits * (1e3, np.degrees(1.0))
        return (
            f"the model's held-out error here is {position:.2f} mm and {rotation:.2f}°"
            f" (limits {most:.2f} mm and {turn:.2f}°)"
        )

    @property
    def _limits(self) -> Array:
        return np.array([self.settings.error_limit_m, self.settings.error_limit_rad])


def components_of(poses: Array, frame: Array) -> Array:
    """Return x, y, z [m] and roll, pitch, yaw [rad] (N, 6) of poses (N, 7), angles in a frame (2, 4)."""
    return np.concatenate([poses[:, pose.POSITION], angles_in(frame, poses[:, pose.QUATERNION])], axis=1)
