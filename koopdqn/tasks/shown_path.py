"""A path of poses that a person was shown, or shows: where it passes, and how the tool is turned at each place."""

from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.resample import to_count
from koopdqn.pose import Array
from koopdqn.tasks.path import SmoothPath


@dataclass(frozen=True)
class ShownPath:
    """A path of poses, evenly spaced in arc length.

    Attributes:
        places: the positions.
        quaternions: (P, 4) the orientation at each of the positions' points.
    """

    places: SmoothPath
    quaternions: Array

    @classmethod
    def along(cls, poses: Array) -> "ShownPath":
        """Return the path along poses (N, 7)."""
        places = SmoothPath.along(poses[:, pose.POSITION])
        return cls(places, to_count(poses, len(places.points))[:, pose.QUATERNION])

    @property
    def poses(self) -> Array:
        """The path's poses (P, 7)."""
        return pose.make(self.places.points, self.quaternions)

    def nearest(self, positions: Array, margin: float) -> Array:
        """Return the arc length (N,) [m] of the place of the path that each position (N, 3) [m] goes on from.

        That is the nearest place. Where a path comes back to itself, several are nearer than the places beside them;
        of those within ``margin`` [m] of the nearest it is the latest: a law knows no past, and where a path crosses
        itself that choice makes it end.
        """
        points = self.places.points
        squared = (points**2).sum(axis=1) - 2.0 * positions @ points.T + (positions**2).sum(axis=1)[:, None]
        distance = np.sqrt(np.maximum(squared, 0.0))
        beside = np.pad(distance, ((0, 0), (1, 1)), constant_values=np.inf)
        candidate = (distance <= beside[:, :-2]) & (distance <= beside[:, 2:])
        candidate &= distance <= distance.min(axis=1, keepdims=True) + margin
        latest = len(points) - 1 - candidate[:, ::-1].argmax(axis=1)
        return np.asarray(latest * self.places.spacing)

    def turned_at(self, arc: Array) -> Array:
        """Return the quaternions (N, 4) at arc lengths (N,) [m], clamped to the path's ends."""
        index = np.rint(arc / self.places.spacing).astype(int)
        return np.asarray(self.quaternions[np.clip(index, 0, len(self.quaternions) - 1)])
