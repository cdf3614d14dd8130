"""The trust domain: where the intent model's prediction is relied upon (§3.4)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.demonstrations.resample import to_count
from koopdqn.pose import Array

COMPONENTS = ("x", "y", "z", "roll", "pitch", "yaw")


class TrustSettings(Settings):
    """How the trust domain is drawn around the demonstrations."""

    matching: Literal["step", "any"] = Field(
        description="compare with the demonstrations' same step (the paper) or with any of their steps"
    )
    sigmas: float = Field(gt=0, description="k: half the width of the domain, in standard deviations")
    position_floor_m: float = Field(ge=0, description="least standard deviation of x, y, z [m]")
    rotation_floor_rad: float = Field(ge=0, description="least standard deviation of roll, pitch, yaw [rad]")
    error_limit_m: float = Field(gt=0, description="trust no step whose held-out one-step error is larger [m]")
    needs: Literal["reached", "both"] = Field(
        description="which state must be trusted: the reached one (the paper) or also the one before"
    )


@dataclass(frozen=True)
class TrustDomain:
    """A box of k standard deviations around the mean of every step, less the steps where the model errs.

    Roll, pitch and yaw are those of the rotation relative to the goal's frame, away from their singularity.

    Attributes:
        settings: what it was drawn with.
        goal: the goal pose (7,).
        mean: (T, 6) [m, rad] of x, y, z, roll, pitch, yaw at every step.
        deviation: (T, 6) standard deviations, not below their floors.
        error: (T,) [m] the largest held-out one-step error at every step.
    """

    settings: TrustSettings
    goal: Array
    mean: Array
    deviation: Array
    error: Array

    @classmethod
    def fit(cls, trajectories: list[Array], errors: list[Array], goal: Array, settings: TrustSettings) -> "TrustDomain":
        """Return the domain of pose trajectories (N, 7) with held-out one-step errors (N − 1,) [m] each.

        With matching by step, the statistics of step t are over the demonstrations that have a step t, as
        in §3.4. With matching by any step, demonstrations are first aligned by their share of path travelled.
        """
        components = [components_of(trajectory, goal) for trajectory in trajectories]
        padded = [np.append(error, error[-1]) for error in errors]
        longest = max(len(rows) for rows in components)
        if settings.matching == "any":
            aligned = [components_of(to_count(trajectory, longest), goal) for trajectory in trajectories]
            stack = np.array(aligned)
            mean, deviation = stack.mean(axis=0), stack.std(axis=0)
            shares = [np.interp(np.linspace(0, 1, longest), np.linspace(0, 1, len(e)), e) for e in padded]
            error = np.array(shares).max(axis=0)
        else:
            at_step = [[rows[t] for rows in components if t < len(rows)] for t in range(longest)]
            mean = np.array([np.mean(rows, axis=0) for rows in at_step])
            deviation = np.array([np.std(rows, axis=0) for rows in at_step])
            error = np.array([max(e[t] for e in padded if t < len(e)) for t in range(longest)])
        floor = np.repeat([settings.position_floor_m, settings.rotation_floor_rad], 3)
        return cls(settings, goal, mean, np.maximum(deviation, floor), error)

    def inside(self, poses: Array, steps: np.ndarray) -> np.ndarray:
        """Return ``indomain`` of poses (N, 7) reached after ``steps`` (N,) steps, as booleans (N,).

        The step count matters under matching by step only; past the demonstrations' end it is their last.
        """
        rows = components_of(poses, self.goal)
        width = self.settings.sigmas * self.deviation
        known = self.error <= self.settings.error_limit_m
        if self.settings.matching == "step":
            index = np.minimum(steps, len(self.mean) - 1)
            return np.asarray(np.all(np.abs(rows - self.mean[index]) <= width[index], axis=1) & known[index])
        inside = np.ones((len(rows), int(known.sum())), dtype=bool)
        # One component at a time keeps the (N, T) temporaries small.
        for i in range(rows.shape[1]):
            inside &= np.abs(rows[:, i : i + 1] - self.mean[known, i]) <= width[known, i]
        return np.asarray(inside.any(axis=1))

    def outside(self, point: Array, step: int) -> str:
        """Return in a few words why a pose (7,) is not trusted, or an empty string if it is."""
        if self.inside(point[None], np.array([step]))[0]:
            return ""
        row = components_of(point[None], self.goal)[0]
        sigmas = np.abs(row - self.mean) / np.where(self.deviation > 0, self.deviation, np.inf)
        nearest = min(step, len(self.mean) - 1)
        if self.settings.matching == "any":
            nearest = int(sigmas.max(axis=1).argmin())
        worst = int(sigmas[nearest].argmax())
        if sigmas[nearest, worst] > self.settings.sigmas:
            name, far = COMPONENTS[worst], sigmas[nearest, worst]
            return f"{name} is {far:.1f} standard deviations from the demonstrations (limit {self.settings.sigmas:g})"
        error, limit = self.error[nearest] * 1e3, self.settings.error_limit_m * 1e3
        return f"the model's held-out error here is {error:.2f} mm (limit {limit:.2f} mm)"


def components_of(poses: Array, goal: Array) -> Array:
    """Return x, y, z [m] and roll, pitch, yaw [rad] (N, 6) of poses (N, 7), angles relative to the goal's frame."""
    relative = pose.multiply(pose.conjugate(goal[pose.QUATERNION]), poses[:, pose.QUATERNION])
    return np.concatenate([poses[:, pose.POSITION], pose.to_roll_pitch_yaw(relative)], axis=1)
