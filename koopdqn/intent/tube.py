"""The tube: a trust domain whose radius is calibrated by leaving one demonstration out."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.trust import TrustDomain, TrustSettings, calibrate, no_balls, squared_distances
from koopdqn.paths import mean_poses, way_lengths
from koopdqn.pose import Array

# Demonstrations needed to estimate the spread along the path with one left out.
_LEAST_FOR_SPREAD = 3
# One of n demonstrations is at most √n spreads of all from the others' mean; twice that, as the spread is averaged
# along the path.
_MOST_SPREADS = 2.0


class TubeSettings(TrustSettings):
    """How the tube is fitted."""

    coverage: float = Field(
        gt=0, lt=1, description="share of new demonstrations to contain from end to end; n of them allow n/(n+1)"
    )
    spacing_m: float = Field(gt=0, description="between neighbouring places on the tube's middle [m]")
    smoothing_m: float = Field(
        gt=0,
        description="path length to either side over which the spread and the share of right signs are averaged [m]",
    )
    floor_m: float = Field(gt=0, description="spread added to that of the demonstrations' positions [m]")
    floor_rad: float = Field(gt=0, description="spread added to that of their orientations [rad]")
    fixed_radius_m: float = Field(gt=0, description="radius around a single demonstration, the least around two [m]")
    fixed_radius_rad: float = Field(gt=0, description="the same of its orientation [rad]")
    answer_radius_rad: float = Field(
        gt=0, le=3.2, description="rotation distance from an answer's pose within which it certifies [rad]"
    )

    def rank(self, count: int) -> int:
        """Return the rank of the leave-one-out score taken as radius: the k-th of n gives coverage k/(n + 1)."""
        return min(count, int(np.ceil(self.coverage * (count + 1) - 1e-9)))

    def fit(self, trajectories: list[Array], signs: list[Array], frame: Array) -> TrustDomain:
        """Return the tube of pose trajectories (N, 7) with right signs (N − 1, L, 2) each.

        A jackknife: a demonstration's score is the largest distance of its states from the mean of the others, in
        spreads. The radius is the score of the given rank times the spread of all, but at most 2√n times that spread:
        an odd one among n that are alike is far off in their spread and widens that of all, which counts it twice. Two
        have the distances between them as radii, but at least those of a single one. With few demonstrations the
        coverage is not guaranteed (Barber et al. 2021); ``fit.fresh`` measures it.
        """
        middle = Middle.of(trajectories, self)
        fixed = np.array([self.fixed_radius_m, self.fixed_radius_rad])
        if len(trajectories) == 1:
            radius = np.tile(fixed, (len(middle.poses), 1))
        else:
            scores = np.sort(self._scores(trajectories), axis=0)
            radius = np.minimum(scores[self.rank(len(scores)) - 1], self._most(len(scores))) * middle.spread
        if len(trajectories) < _LEAST_FOR_SPREAD:
            # That two happen to be alike says little.
            radius = np.maximum(radius, fixed)
        places = [middle.nearest(rows[:-1]) for rows in trajectories]
        window = round(self.smoothing_m / self.spacing_m)
        sure = calibrate(places, signs, len(middle.poses), window, self)
        return Tube(self, *sure, no_balls(self.answer_radius_rad), middle.poses, radius, middle.gap)

    def _scores(self, trajectories: list[Array]) -> Array:
        """Return the score (D, 2) of each of D trajectories (N, 7) by which the radii of both units are chosen.

        With two demonstrations there is no spread whose units compare position and orientation, so that each has its
        own; otherwise the larger counts for both.
        """
        scores = []
        for index, held_out in enumerate(trajectories):
            others = Middle.of(trajectories[:index] + trajectories[index + 1 :], self, len(trajectories))
            if len(trajectories) < _LEAST_FOR_SPREAD:
                scores.append(others.apart(held_out).max(axis=0))
            else:
                scores.append(np.full(2, others.distance(held_out).max()))
        return np.array(scores)

    def _most(self, count: int) -> float:
        return np.inf if count < _LEAST_FOR_SPREAD else float(_MOST_SPREADS * np.sqrt(count))

    def nominal(self, trajectories: list[Array]) -> float | None:
        """Return the nominal coverage with these demonstrations (N, 7); None with fewer than three."""
        count = len(trajectories)
        if count < _LEAST_FOR_SPREAD:
            return None
        held = int((self._scores(trajectories).max(axis=1) <= self._most(count)).sum())
        return min(self.rank(count), held) / (count + 1)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> TrustDomain:
        """Return the domain with these arrays."""
        balls = no_balls(self.answer_radius_rad)
        return Tube(self, arrays["right"], arrays["doubt"], balls, arrays["middle"], arrays["radius"], arrays["spread"])


@dataclass(frozen=True)
class Middle:
    """The mean of demonstrations and their spread around it.

    Attributes:
        poses: (S, 7) along the mean.
        gap: (S, 2) [m, rad] standard deviation (n − 1) of the demonstrations' positions and orientations from it.
        spread: (S, 2) [m, rad] the same averaged along the path, not below its floor: the unit of scores.
    """

    poses: Array
    gap: Array
    spread: Array

    @classmethod
    def of(cls, trajectories: list[Array], settings: TubeSettings, known: int | None = None) -> "Middle":
        """Return the mean of pose trajectories (N, 7), aligned by the share of their path.

        Args:
            trajectories: demonstrated poses.
            settings: spacing, smoothing and floors.
            known: number of demonstrations, those left out included. With fewer than three the spread is the floor.
        """
        length = float(np.mean([way_lengths(rows)[-1] for rows in trajectories]))
        count = max(2, int(np.ceil(length / settings.spacing_m)) + 1)
        poses = mean_poses(trajectories, count)
        gaps = np.array([_gaps(poses, rows) for rows in trajectories])
        variance = (gaps**2).sum(axis=0) / max(1, len(trajectories) - 1)
        floor = np.array([settings.floor_m, settings.floor_rad])
        if (len(trajectories) if known is None else known) < _LEAST_FOR_SPREAD:
            return cls(poses, np.sqrt(variance), np.tile(floor, (count, 1)))
        window = max(1, round(settings.smoothing_m / settings.spacing_m))
        return cls(poses, np.sqrt(variance), np.sqrt(_moving_mean(variance, window) + floor**2))

    def distance(self, poses: Array) -> Array:
        """Return the distances (N,) of poses (N, 7) from the nearest place, in spreads."""
        return np.asarray(scaled_distances(poses, self.poses, self.spread).min(axis=1))

    def apart(self, poses: Array) -> Array:
        """Return the distances (N, 2) of positions and of orientations of poses (N, 7), in spreads.

        From the place nearest in position.
        """
        moved, turned = _scaled(poses, self.poses, self.spread)
        place = moved.argmin(axis=1)[:, None]
        return np.concatenate([np.take_along_axis(each, place, axis=1) for each in (moved, turned)], axis=1)

    def nearest(self, poses: Array) -> np.ndarray:
        """Return the place (N,) nearest to each position of poses (N, 7)."""
        squared = squared_distances(poses[:, pose.POSITION], self.poses[:, pose.POSITION])
        return np.asarray(squared.argmin(axis=1))


@dataclass(frozen=True)
class Tube(TrustDomain):
    """Balls of calibrated radius along the demonstrations' mean, except at places where the model errs.

    A state is trusted if position and orientation are both within the radii of some place, and if enough rewards are
    right at the place nearest to it.

    Attributes:
        middle: (S, 7) poses along the mean.
        radius: (S, 2) [m, rad] of positions and of orientations.
        spread: (S, 2) [m, rad] RMS distance of the demonstrations from the mean.
    """

    settings: TubeSettings
    middle: Array
    radius: Array
    spread: Array

    places = ("middle", "radius", "spread")

    def shape_contains(self, poses: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the tube contains poses (N, 7), and the nearest place's doubt; steps do not matter."""
        squared = squared_distances(poses[:, pose.POSITION], self.middle[:, pose.POSITION])
        cosine = np.abs(poses[:, pose.QUATERNION] @ self.middle[:, pose.QUATERNION].T)
        limit, least = self._limits_squared
        within = np.asarray(((squared <= limit) & (cosine >= least)).any(axis=1))
        return within, self.doubt[squared.argmin(axis=1)]

    @cached_property
    def _limits_squared(self) -> tuple[Array, Array]:
        half = np.minimum(0.5 * self.radius[:, 1], 0.5 * np.pi)
        return self.radius[:, 0] ** 2, np.cos(half)

    def depth(self, poses: Array) -> Array:
        """Return the distances (N,) of poses (N, 7) from the middle, in radii."""
        return np.asarray(scaled_distances(poses, self.middle, self.radius).min(axis=1))

    def gap(self, poses: Array) -> Array:
        """Return the distances (N,) [m] of the positions of poses (N, 7) from the tube."""
        squared = squared_distances(poses[:, pose.POSITION], self.middle[:, pose.POSITION])
        return np.asarray(np.maximum(np.sqrt(squared) - self.radius[:, 0], 0.0).min(axis=1))

    def reason(self, point: Array, step: int) -> str:
        """Return how far a pose (7,) is from the tube, or how few rewards are right there."""
        far = scaled_distances(point[None], self.middle, self.radius)[0]
        place = int(far.argmin())
        if far[place] > 1.0:
            # Measured in radii the widest place may be nearest; people expect the one nearest in metres.
            outside = pose.position_distance(point, self.middle) - self.radius[:, 0]
            if (outside > 0.0).all():
                place = int(outside.argmin())
            radius, turn = self.radius[place]
            moved = float(outside[place] + radius)
            turned = float(pose.rotation_distance(point, self.middle[place]))
            if moved / radius >= turned / turn:
                return f"position is {moved * 1e3:.1f} mm from the demonstrations' mean (tube {radius * 1e3:.1f} mm)"
            return f"orientation is {np.degrees(turned):.1f}° from the demonstrations' (tube {np.degrees(turn):.1f}°)"
        squared = squared_distances(point[None, pose.POSITION], self.middle[:, pose.POSITION])
        return self.doubt_of(int(squared[0].argmin()))


def scaled_distances(poses: Array, places: Array, unit: Array) -> Array:
    """Return the distances (N, S) of poses (N, 7) from places (S, 7), in units (S, 2) [m, rad] of each place.

    The larger of position and orientation counts.
    """
    return np.asarray(np.maximum(*_scaled(poses, places, unit)))


def _scaled(poses: Array, places: Array, unit: Array) -> tuple[Array, Array]:
    """Return :func:`scaled_distances` of positions and of orientations apart."""
    moved = np.sqrt(squared_distances(poses[:, pose.POSITION], places[:, pose.POSITION])) / unit[:, 0]
    cosine = np.clip(np.abs(poses[:, pose.QUATERNION] @ places[:, pose.QUATERNION].T), 0.0, 1.0)
    return moved, 2.0 * np.arccos(cosine) / unit[:, 1]


def _gaps(poses: Array, rows: Array) -> Array:
    """Return the distances (S, 2) [m, rad] between a mean (S, 7) and a demonstration (N, 7), at every place.

    The larger of two: from the place to the demonstration, and to the place from the states nearest to it. So a
    demonstration that starts before the mean, or leaves it, is noticed too.
    """
    squared = squared_distances(poses[:, pose.POSITION], rows[:, pose.POSITION])
    there, here = squared.argmin(axis=1), squared.argmin(axis=0)
    moved = np.sqrt(squared.min(axis=1))
    turned = pose.rotation_distance(poses, rows[there])
    np.maximum.at(moved, here, np.sqrt(squared.min(axis=0)))
    np.maximum.at(turned, here, pose.rotation_distance(poses[here], rows))
    return np.stack([moved, turned], axis=1)


def _moving_mean(values: Array, window: int) -> Array:
    """Return values (S, 2) averaged over ``window`` neighbours to either side, as many as there are."""
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(values, axis=0)])
    index = np.arange(len(values))
    low, high = np.maximum(index - window, 0), np.minimum(index + window + 1, len(values))
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])
