"""The paper's trust domain: k standard deviations around the mean of every step (§3.4)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn.intent.trust import COMPONENTS, Balls, TrustDomain, TrustSettings, calibrate, components_of, no_balls
from koopdqn.paths import to_count, way_lengths
from koopdqn.pose import Array


class BoxSettings(TrustSettings):
    """How the boxes are fitted."""

    matching: Literal["step", "any", "everywhere", "nowhere"] = Field(
        description="compare with the demonstrations' same step (the paper) or with any of their steps; everywhere and"
        " nowhere, for ablations, trust everything or nothing"
    )
    sigmas: float = Field(gt=0, description="k: half the width of the domain, in standard deviations")
    position_floor_m: float = Field(ge=0, description="least standard deviation of x, y, z [m]")
    rotation_floor_rad: float = Field(ge=0, description="least standard deviation of roll, pitch, yaw [rad]")

    def fit(self, trajectories: list[Array], signs: list[Array], frame: Array) -> TrustDomain:
        """Return the boxes of pose trajectories (N, 7) with right signs (N − 1, L, 2) each.

        With matching by step, the statistics of step t are over the demonstrations that have a step t (§3.4).
        Otherwise demonstrations are first aligned by the share of their path.
        """
        components = [components_of(trajectory, frame) for trajectory in trajectories]
        longest = max(len(rows) for rows in components)
        if self.matching != "step":
            evenly = [to_count(trajectory, longest, way_lengths(trajectory)) for trajectory in trajectories]
            aligned = [components_of(each, frame) for each in evenly]
            stack = np.array(aligned)
            mean, deviation = stack.mean(axis=0), stack.std(axis=0)
            # The aligned step nearest to each state.
            places = [np.rint(np.linspace(0, longest - 1, len(rows)))[:-1].astype(int) for rows in components]
        else:
            at_step = [[rows[t] for rows in components if t < len(rows)] for t in range(longest)]
            mean = np.array([np.mean(rows, axis=0) for rows in at_step])
            deviation = np.array([np.std(rows, axis=0) for rows in at_step])
            places = [np.arange(len(rows) - 1) for rows in components]
        floor = np.repeat([self.position_floor_m, self.rotation_floor_rad], 3)
        sure = calibrate(places, signs, longest, 0, self)
        return Box(self, *sure, self._no_balls(), frame, mean, np.maximum(deviation, floor))

    def restore(self, arrays: Mapping[str, np.ndarray]) -> TrustDomain:
        """Return the domain with these arrays."""
        right, doubt, *shape = (arrays[name] for name in ("right", "doubt", "frame", "mean", "deviation"))
        return Box(self, right, doubt, self._no_balls(), *shape)

    def _no_balls(self) -> Balls:
        return no_balls(max(self.sigmas * self.rotation_floor_rad, 1e-3))


@dataclass(frozen=True)
class Box(TrustDomain):
    """A box of k standard deviations around the mean of every step, except at steps where the model errs.

    Attributes:
        frame: (2, 4) of roll, pitch and yaw, as :attr:`koopdqn.tasks.task.Task.frame` gives it.
        mean: (T, 6) [m, rad] of x, y, z, roll, pitch, yaw at every step.
        deviation: (T, 6) standard deviations, not below their floors.
    """

    settings: BoxSettings
    frame: Array
    mean: Array
    deviation: Array

    places = ("mean", "deviation")

    @property
    def shaped(self) -> bool:
        """Whether states are compared with the demonstrations' steps."""
        return self.settings.matching in ("step", "any")

    def shape_contains(self, poses: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether a box (with matching by step, that of their step) contains poses (N, 7), and its doubt."""
        if not self.shaped:
            everything = np.full(len(poses), self.settings.matching == "everywhere")
            return everything, np.full(len(poses), self.settings.doubts[0])
        rows = components_of(poses, self.frame)
        width = self.settings.sigmas * self.deviation
        if self.settings.matching == "step":
            # Past the demonstrations' end, their last step.
            index = np.minimum(steps, len(self.mean) - 1)
            return np.asarray(np.all(np.abs(rows - self.mean[index]) <= width[index], axis=1)), self.doubt[index]
        contained: np.ndarray = np.ones((len(rows), len(self.mean)), dtype=bool)
        # One component at a time keeps the (N, T) temporaries small.
        for i in range(rows.shape[1]):
            contained &= np.abs(rows[:, i : i + 1] - self.mean[:, i]) <= width[:, i]
        return np.asarray(contained.any(axis=1)), np.where(contained, self.doubt, np.inf).min(axis=1)

    def nearest_step(self, point: Array) -> int | None:
        """Return the step of the nearest box of a pose (7,); None where the step does not matter."""
        if self.settings.matching != "step":
            return None
        return int(self._sigmas(components_of(point[None], self.frame))[0].max(axis=1).argmin())

    def depth(self, poses: Array) -> Array:
        """Return the distances (N,) of poses (N, 7) from the nearest box's center, in half widths."""
        if not self.shaped:
            return np.full(len(poses), 0.0 if self.settings.matching == "everywhere" else np.inf)
        rows = components_of(poses, self.frame)
        return np.asarray(self._sigmas(rows).max(axis=2).min(axis=1) / self.settings.sigmas)

    def gap(self, poses: Array) -> Array:
        """Return the distances (N,) [m] of the positions of poses (N, 7) from the nearest box."""
        if not self.shaped:
            return np.zeros(len(poses))
        width = self.settings.sigmas * self.deviation[:, :3]
        outside = np.abs(poses[:, None, :3] - self.mean[:, :3]) - width
        return np.asarray(np.linalg.norm(np.maximum(outside, 0.0), axis=2).min(axis=1))

    def reason(self, point: Array, step: int) -> str:
        """Return which component of a pose (7,) is too far off, or how few rewards are right there."""
        if self.settings.matching == "nowhere":
            return "nothing is trusted (trust.matching=nowhere)"
        sigmas = self._sigmas(components_of(point[None], self.frame))[0]
        nearest = min(step, len(self.mean) - 1)
        if self.settings.matching != "step":
            nearest = int(sigmas.max(axis=1).argmin())
        worst = int(sigmas[nearest].argmax())
        if sigmas[nearest, worst] > self.settings.sigmas:
            name, far = COMPONENTS[worst], sigmas[nearest, worst]
            return f"{name} is {far:.1f} standard deviations from the demonstrations (limit {self.settings.sigmas:g})"
        return self.doubt_of(nearest)

    def _sigmas(self, rows: Array) -> Array:
        """Return the distances (N, T, 6) of rows (N, 6) from the mean of every step, in standard deviations."""
        gap = np.abs(rows[:, None] - self.mean)
        return np.where(gap > 0, gap / np.where(self.deviation > 0, self.deviation, 1e-12), 0.0)
