"""The bend: an intent and its trust domain, carried along a path that was moved aside in part.

Around an obstacle, or where a person corrects it, the path to take is the intent's own plus an offset. What a person
would do beside the moved path is what they would do beside their own: so a pose is straightened (its place's offset
taken away), the intent and its trust are asked there, and the answer is bent back.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.intent.model import IntentModel, ModelOver
from koopdqn.intent.trust import TrustDomain
from koopdqn.paths import SmoothPath, arc_lengths
from koopdqn.pose import Array

if TYPE_CHECKING:
    from scipy.spatial import KDTree

CORRECTED: Final = "bend/path"
"""The array of a policy's file that only a corrected one holds: :attr:`Bend.path`."""
# A waypoint may be at most this far from the path [m].
_FARTHEST_M = 0.2
# The way to a waypoint and from it, in its distance from the path, and at least [m].
_WAY, _LEAST_WAY_M = 1.5, 0.02
# Coming nearer to the path counts as so much of coming forward along it.
_BESIDE = 0.3
# Directions of travel are those of chords of this length [m].
_CHORD_M = 0.004


@dataclass(frozen=True)
class Bend:
    """A path and by how much each of its points is moved aside, in the intent's start frame.

    Attributes:
        path: (P, 3) [m] the intent's own path, evenly spaced.
        offsets: (P, 3) [m] of its points; none at the path's ends.
    """

    path: Array
    offsets: Array

    @classmethod
    def none(cls, positions: Array) -> "Bend":
        """Return the bend of the path along positions (N, 3) [m] that moves nothing."""
        path = SmoothPath.along(positions).points
        return cls(path, np.zeros_like(path))

    def through(self, waypoints: Array, told: Array | None = None) -> "Bend":
        """Return the bend with its moved path led through waypoints (W, 3) [m], and back where they end.

        Messages tell them as they are, or as they were ``told`` (W, 3) in another frame.

        Each waypoint moves the point of the path nearest to it. The way to the first and from the last one begins and
        ends 1.5 times as far along the path as that waypoint is aside. Before and behind nothing moves.

        Raises:
            BadInputError: they are not in the path's order, too far from it, or at its ends.
        """
        from scipy.interpolate import PchipInterpolator
        from scipy.spatial import KDTree

        arc = arc_lengths(self.bent)
        apart, place = KDTree(self.bent).query(waypoints)
        if apart.max() > _FARTHEST_M:
            raise BadInputError(
                f"waypoints: must lie within {_FARTHEST_M:g} m of the learned path, found one {apart.max():.3f} m away"
            )
        if (np.diff(arc[place]) <= 0.0).any():
            row, said = int((np.diff(arc[place]) <= 0.0).argmax()), waypoints if told is None else told
            raise BadInputError(
                "waypoints: must be in the order in which the path passes them, found"
                f" {_shown(said[row])} m before {_shown(said[row + 1])} m"
            )
        first, last = (arc[place[i]] + sign * max(_LEAST_WAY_M, _WAY * apart[i]) for i, sign in ((0, -1.0), (-1, 1.0)))
        first, last = max(first, arc[1]), min(last, arc[-2])
        if arc[place[0]] - arc[1] < _LEAST_WAY_M or arc[-2] - arc[place[-1]] < _LEAST_WAY_M:
            raise BadInputError(
                f"waypoints: must lie at least {_LEAST_WAY_M:g} m of path from its start and its goal, which stay,"
                f" found {arc[place[0]]:.3f} m and {arc[-1] - arc[place[-1]]:.3f} m"
            )
        at = np.concatenate([[0.0, first], arc[place], [last, arc[-1]]])
        none = np.zeros((2, 3))
        moved = PchipInterpolator(at, np.concatenate([none, waypoints - self.bent[place], none]))(arc)
        return Bend(self.path, self.offsets + moved)

    @cached_property
    def bent(self) -> Array:
        """The moved path (P, 3) [m]."""
        return self.path + self.offsets

    def straightened(self, poses: Array) -> Array:
        """Return poses (N, 7) as they lie beside the intent's own path when these lie so beside the moved one."""
        place = self._nearest(poses)
        beside = poses[:, pose.POSITION] - self.bent[place]
        position = self.path[place] + pose.rotate(pose.conjugate(self._turns[place]), beside)
        return pose.make(position, poses[:, pose.QUATERNION])

    def bent_next(self, poses: Array, straight: Array, following: Array) -> Array:
        """Return the poses (N, 7) after poses (N, 7), whose straightened ones go from ``straight`` to ``following``.

        The motion is turned as the moved path is turned from the path there.
        """
        motion = following[:, pose.POSITION] - straight[:, pose.POSITION]
        turned = pose.rotate(self._turns[self._nearest(poses)], motion)
        return pose.make(poses[:, pose.POSITION] + turned, following[:, pose.QUATERNION])

    def beside(self, poses: Array) -> Array:
        """Return the offsets (N, 3) [m] of poses (N, 7) from the nearest points of the moved path."""
        return np.asarray(poses[:, pose.POSITION] - self.bent[self._nearest(poses)])

    def come(self, poses: Array) -> Array:
        """Return how far poses (N, 7) have come along the moved path (N,) [m], less a part of their distance to it."""
        place = self._nearest(poses)
        return np.asarray(self._arc[place] - _BESIDE * pose.norm(poses[:, pose.POSITION] - self.bent[place]))

    def bent_each(self, trajectories: Sequence[Array]) -> list[Array]:
        """Return straight trajectories (N, 7) as they lie beside the moved path."""
        from scipy.spatial import KDTree

        tree, found = KDTree(self.path), []
        for rows in trajectories:
            place = tree.query(rows[:, pose.POSITION])[1]
            beside = pose.rotate(self._turns[place], rows[:, pose.POSITION] - self.path[place])
            found.append(pose.make(self.bent[place] + beside, rows[:, pose.QUATERNION]))
        return found

    @cached_property
    def _arc(self) -> Array:
        return arc_lengths(self.bent)

    def _nearest(self, poses: Array) -> np.ndarray:
        return np.asarray(self._tree.query(poses[:, pose.POSITION])[1])

    @cached_property
    def _tree(self) -> "KDTree":
        from scipy.spatial import KDTree

        return KDTree(self.bent)

    @cached_property
    def _turns(self) -> Array:
        """The quaternions (P, 4) that turn the path's direction to the moved path's by the smallest angle."""
        spacing = float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).mean())
        half = max(1, round(0.5 * _CHORD_M / spacing))
        index = np.arange(len(self.path))
        ahead, back = np.minimum(index + half, len(index) - 1), np.maximum(index - half, 0)
        one, other = (rows[ahead] - rows[back] for rows in (self.path, self.bent))
        one, other = (rows / np.maximum(pose.norm(rows, keepdims=True), 1e-12) for rows in (one, other))
        along = (one * other).sum(axis=1, keepdims=True)
        return pose.normalized(np.concatenate([1.0 + along + 1e-9, np.cross(one, other)], axis=1))


def _shown(position: Array) -> list[float]:
    return [round(float(value), 4) for value in position]


@dataclass(frozen=True)
class BentIntent(ModelOver):
    """An intent model along a moved path.

    Attributes:
        base: the model as it was fitted.
        bend: the moved path.
    """

    bend: Bend

    @property
    def unbent(self) -> IntentModel:
        """The base."""
        return self.base

    def placed(self, trajectories: list[Array]) -> list[Array]:
        """Return demonstrated trajectories (N, 7) along the moved path, in the start frame."""
        return self.bend.bent_each(self.base.placed(trajectories))

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7)."""
        straight = self.bend.straightened(poses)
        return self.bend.bent_next(poses, straight, self.base.predict(straight))


@dataclass(frozen=True)
class BentTrust(TrustDomain):
    """A trust domain along a moved path: a pose is trusted where the straightened one is.

    Attributes:
        base: the domain as it was fitted.
        bend: the moved path.
    """

    base: TrustDomain
    bend: Bend

    @classmethod
    def of(cls, base: TrustDomain, bend: Bend) -> "BentTrust":
        """Return a domain bent."""
        return cls(base.settings, base.right, base.doubt, base.balls, base, bend)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the base's arrays; the bend is never stored."""
        return self.base.arrays()

    def nearest_step(self, point: Array) -> int | None:
        """Return the base's nearest step of the straightened pose (7,)."""
        return self.base.nearest_step(self.bend.straightened(point[None])[0])

    def shape_contains(self, poses: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return whether the base contains the straightened poses (N, 7), and the doubt (N,) there."""
        return self.base.shape_contains(self.bend.straightened(poses), steps)

    def depth(self, poses: Array) -> Array:
        """Return the distances (N,) of the straightened poses (N, 7) from the base's middle, in its half widths."""
        return self.base.depth(self.bend.straightened(poses))

    def gap(self, poses: Array) -> Array:
        """Return the distances (N,) [m] of the straightened poses (N, 7) from the base."""
        return self.base.gap(self.bend.straightened(poses))

    def reason(self, point: Array, step: int) -> str:
        """Return in a few words why an untrusted pose (7,) is not trusted."""
        return self.base.reason(self.bend.straightened(point[None])[0], step)
