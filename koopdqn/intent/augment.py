"""Augmentation: additional pairs that lead back to the demonstrations, from near and from far."""

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from koopdqn.paths import SmoothPath, arc_lengths
from koopdqn.pose import Array
from koopdqn.settings import Settings

SPACING_M = 1e-3
_OTHER_DIRECTION = 0.5
"""Cosine between two directions of travel below which a model of states alone cannot follow both at one place."""


class Augmentation(Settings):
    """How demonstrations are augmented by states that lead back to them."""

    copies: int = Field(ge=0, le=100, description="augmented states near each demonstrated one; 0 for none")
    near_m: float = Field(gt=0, description="standard deviation of a near state's sideways offset [m]")
    far_copies: int = Field(ge=0, le=100, description="augmented states far from each demonstrated one; 0 for none")
    far: float = Field(
        gt=0, description="largest standard deviation of far states along an axis, in demonstrations' spreads"
    )
    far_weight: float = Field(gt=0, le=1, description="weight of a far pair; a demonstrated one has weight 1")
    pull_back_m: float = Field(gt=0, description="distance over which an augmented pair leads back [m]")
    touching_m: float = Field(
        ge=0,
        description="where the path passes itself nearer than this in another direction, the later part counts [m]",
    )
    seed: int = Field(ge=0)


@dataclass(frozen=True)
class Pairs:
    """States, their successors one step later, and the weight of each pair.

    Attributes:
        before: positions (M, 3) [m].
        after: positions (M, 3) [m].
        weight: (M,), 1 for demonstrated pairs.
    """

    before: Array
    after: Array
    weight: Array


@dataclass(frozen=True)
class PursuitPath:
    """A demonstrated path and the step that leads back to it from any position.

    Attributes:
        points: (P, 3) [m], evenly spaced.
        directions: (P, 3) unit vectors of travel.
        ahead: (P,) distance [m] to the point ``pull_back`` further along.
        latest: (P,) index of the point that counts at each: itself, or the later one where the path passes itself.
    """

    points: Array
    directions: Array
    ahead: Array
    latest: np.ndarray

    @classmethod
    def along(cls, positions: Array, pull_back: float, touching: float) -> "PursuitPath":
        """Return the path through demonstrated positions (N, 3) [m]."""
        path = SmoothPath.along(positions, SPACING_M)
        directions = np.gradient(path.points, axis=0)
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
        arc = np.arange(len(path.points)) * path.spacing
        ahead = np.linalg.norm(path.at(arc + pull_back) - path.points, axis=1)
        return cls(path.points, directions, ahead, _latest(path.points, directions, touching))

    def nearest(self, positions: Array) -> np.ndarray:
        """Return the index (N,) of the point that counts nearest to each position (N, 3)."""
        from scipy.spatial import cKDTree

        return np.asarray(self.latest[cKDTree(self.points).query(positions)[1]])

    def step_from(self, positions: Array, length: float) -> Array:
        """Return the positions (N, 3) [m] one step of ``length`` [m] from positions (N, 3), at most up to the end.

        The heading is the path's direction at the nearest point plus a pull toward that point, so that an offset
        decays over the look-ahead distance. On the path this is exact; aiming at a point ahead would cut its curves.
        """
        index = self.nearest(positions)
        back = (self.points[index] - positions) / np.maximum(self.ahead[index], SPACING_M)[:, None]
        heading = self.directions[index] + back
        heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-12)
        left = np.linalg.norm(self.points[-1] - positions, axis=1, keepdims=True)
        return np.asarray(positions + np.minimum(length, left) * heading)


def augmented(trajectories: list[Array], spread: float, settings: Augmentation) -> Pairs:
    """Return the pairs of position trajectories (N, 3) [m] and the augmented ones around them.

    A near state lies beside a demonstrated one, at right angles to the motion. A far one lies in any direction from
    it, offset along each axis by a standard deviation drawn log-uniformly up to ``far`` times the demonstrations'
    ``spread`` [m]. Each leads back to its own demonstration, so that where several pass the model leads to their mean.
    Where a demonstration passes an earlier part of itself in another direction, only the later part counts: a model of
    states cannot follow both, and one that averages them stands still or circles.
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
        path = PursuitPath.along(positions, settings.pull_back_m, settings.touching_m)
        arc = arc_lengths(positions)
        index = np.rint(arc / arc[-1] * (len(path.points) - 1)).astype(int)[:-1]
        kept = path.latest[index] == index
        found.append(Pairs(before[kept], after[kept], np.ones(int(kept.sum()))))
        moving = length[:, 0] > 1e-9
        step, here = float(np.median(length[moving])), before[moving]
        direction = motion[moving] / length[moving]
        for _ in range(settings.copies):
            offset = rng.normal(scale=settings.near_m, size=here.shape)
            offset -= (offset * direction).sum(axis=1, keepdims=True) * direction
            found.append(_leading_back(here + offset, path, step, 1.0))
        widest = max(np.log(settings.far * spread), np.log(settings.near_m))
        for _ in range(settings.far_copies):
            size = np.exp(rng.uniform(np.log(settings.near_m), widest, (len(here), 1)))
            found.append(_leading_back(here + size * rng.normal(size=here.shape), path, step, settings.far_weight))
    before, after, weight = (
        np.concatenate(each) for each in zip(*((p.before, p.after, p.weight) for p in found), strict=True)
    )
    return Pairs(before, after, weight)


def _leading_back(states: Array, path: PursuitPath, step: float, weight: float) -> Pairs:
    return Pairs(states, path.step_from(states, step), np.full(len(states), weight))


def _latest(points: Array, directions: Array, touching: float) -> np.ndarray:
    """Return for each point (P, 3) the last one within ``touching`` [m] that runs in another direction, else itself."""
    latest = np.arange(len(points))
    if touching > 0:
        from scipy.spatial import cKDTree

        early, late = cKDTree(points).query_pairs(touching, output_type="ndarray").T
        other = (directions[early] * directions[late]).sum(axis=1) < _OTHER_DIRECTION
        np.maximum.at(latest, early[other], late[other])
    # A later part may itself give way to one later still.
    while not np.array_equal(latest, latest[latest]):
        latest = latest[latest]
    return latest
