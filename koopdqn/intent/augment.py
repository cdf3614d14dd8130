"""Stabilisation: made-up pairs that lead back to the demonstrations, from near them and from afar."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from koopdqn.paths import SmoothPath, arc_lengths
from koopdqn.pose import Array
from koopdqn.settings import Settings

SPACING_M = 1e-3
_AGAINST = 0.5
"""Cosine between two directions of travel below which a model of states alone cannot follow both at one place."""


class Stabilisation(Settings):
    """How the demonstrations are surrounded by states that lead back to them."""

    copies: int = Field(ge=0, le=100, description="made-up states near each demonstrated one; 0 for none")
    near_m: float = Field(gt=0, description="standard deviation of a near state's sideways offset [m]")
    far_copies: int = Field(ge=0, le=100, description="made-up states far from each demonstrated one; 0 for none")
    far: float = Field(gt=0, description="how far the farthest lie, in units of the demonstrations' spread")
    far_weight: float = Field(gt=0, le=1, description="what a far pair counts beside a demonstrated one")
    pull_back_m: float = Field(gt=0, description="distance over which a made-up pair leads back [m]")
    touching_m: float = Field(
        ge=0, description="a path nearer than this to an earlier part of itself that runs elsewhere takes its place [m]"
    )
    seed: int = Field(ge=0)


@dataclass(frozen=True)
class Pairs:
    """States, where a person would be a step later, and what each pair counts.

    Attributes:
        before: positions (M, 3) [m].
        after: positions (M, 3) [m].
        weight: (M,), 1 for what was demonstrated.
    """

    before: Array
    after: Array
    weight: Array


@dataclass(frozen=True)
class Course:
    """A demonstrated path that says, for any position, where it leads.

    Attributes:
        points: (P, 3) [m], evenly spaced.
        directions: (P, 3) unit vectors of travel.
        ahead: (P,) distance [m] to the point ``pull_back`` further along.
        heeded: (P,) index of the point that counts at each: itself, or where the path comes by again, the later one.
    """

    points: Array
    directions: Array
    ahead: Array
    heeded: np.ndarray

    @classmethod
    def along(cls, positions: Array, pull_back: float, touching: float) -> "Course":
        """Return the course of demonstrated positions (N, 3) [m]."""
        path = SmoothPath.along(positions, SPACING_M)
        directions = np.gradient(path.points, axis=0)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        arc = np.arange(len(path.points)) * path.spacing
        ahead = np.linalg.norm(path.at(arc + pull_back) - path.points, axis=1)
        return cls(path.points, directions, ahead, _heeded(path.points, directions, touching))

    def nearest(self, positions: Array) -> np.ndarray:
        """Return the index (N,) of the point nearest to each position (N, 3), and of what is heeded there."""
        from scipy.spatial import cKDTree

        return np.asarray(self.heeded[cKDTree(self.points).query(positions)[1]])

    def step_from(self, positions: Array, length: float) -> Array:
        """Return the positions (N, 3) [m] a step of ``length`` [m] from positions (N, 3), at most up to the end.

        The step goes along the path's own direction at the nearest point, turned toward that point so that an
        offset dies out over the look-ahead distance: the pursuit law of :mod:`koopdqn.tasks.person`,
        exact on the path itself, where aiming at a point ahead would cut its curves.
        """
        index = self.nearest(positions)
        back = (self.points[index] - positions) / np.maximum(self.ahead[index], SPACING_M)[:, None]
        heading = self.directions[index] + back
        heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-12)
        left = np.linalg.norm(self.points[-1] - positions, axis=1, keepdims=True)
        return np.asarray(positions + np.minimum(length, left) * heading)


def surrounded(trajectories: list[Array], spread: float, settings: Stabilisation) -> Pairs:
    """Return the pairs of position trajectories (N, 3) [m], and the made-up ones around them.

    A near state lies beside a demonstrated one, at right angles to the motion there; a far one anywhere around it, at
    distances spread evenly over their orders of magnitude up to ``far`` times the demonstrations' ``spread`` [m]. All
    lead back to their own demonstration, so that where several pass the model leads to their mean. Where a
    demonstration comes by an earlier part of itself on another course, only the later part counts: a model of states
    cannot follow both, and one that averages them stands still or circles.
    """
    rng = np.random.default_rng(settings.seed)
    found: list[Pairs] = []
    for positions in trajectories:
        before, after = positions[:-1], positions[1:]
        motion = after - before
        length = np.linalg.norm(motion, axis=1, keepdims=True)
        if not settings.copies + settings.far_copies or arc_lengths(positions)[-1] < SPACING_M:
            found.append(Pairs(before, after, np.ones(len(before))))
            continue
        course = Course.along(positions, settings.pull_back_m, settings.touching_m)
        place = _places(positions, course)[:-1]
        kept = course.heeded[place] == place
        found.append(Pairs(before[kept], after[kept], np.ones(int(kept.sum()))))
        moving = length[:, 0] > 1e-9
        step, here = float(np.median(length[moving])), before[moving]
        direction = motion[moving] / length[moving]
        for _ in range(settings.copies):
            offset = rng.normal(scale=settings.near_m, size=here.shape)
            offset -= (offset * direction).sum(axis=1, keepdims=True) * direction
            found.append(_leading_back(here + offset, course, step, 1.0))
        widest = max(np.log(settings.far * spread), np.log(settings.near_m))
        for _ in range(settings.far_copies):
            size = np.exp(rng.uniform(np.log(settings.near_m), widest, (len(here), 1)))
            found.append(_leading_back(here + size * rng.normal(size=here.shape), course, step, settings.far_weight))
    return Pairs(
        np.concatenate([pairs.before for pairs in found]),
        np.concatenate([pairs.after for pairs in found]),
        np.concatenate([pairs.weight for pairs in found]),
    )


def _leading_back(states: Array, course: Course, step: float, weight: float) -> Pairs:
    return Pairs(states, course.step_from(states, step), np.full(len(states), weight))


def _places(positions: Array, course: Course) -> np.ndarray:
    """Return the index (N,) on the course of its own positions (N, 3)."""
    arc = arc_lengths(positions)
    return np.asarray(np.rint(arc / arc[-1] * (len(course.points) - 1)).astype(int))


def _heeded(points: Array, directions: Array, touching: float) -> np.ndarray:
    """Return for each point (P, 3) the last one within ``touching`` [m] whose direction is another, else itself."""
    heeded = np.arange(len(points))
    if touching > 0:
        from scipy.spatial import cKDTree

        early, late = cKDTree(points).query_pairs(touching, output_type="ndarray").T
        against = (directions[early] * directions[late]).sum(axis=1) < _AGAINST
        np.maximum.at(heeded, early[against], late[against])
    # A later part may itself give way to one later still.
    for _ in range(len(points)):
        further = heeded[heeded]
        if np.array_equal(further, heeded):
            break
        heeded = further
    return heeded
