"""Putting a bottle into a shelf from both of its sides, demonstrated from one: where trust matters."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydantic import Field, model_validator

from koopdqn import pose
from koopdqn.paths import SmoothPath
from koopdqn.pose import Array
from koopdqn.tasks.person import Law, ShownPath
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import Waypoints


class BothSidesTask(ShelfTask):
    """The shelf, with starts beside either of its side walls and demonstrations from beside one.

    Nothing demonstrated tells that the other wall is gone around the other way.
    """

    other_waypoints: Waypoints = Field(description="flange positions from the other side, start first, goal last [m]")
    other_share: float = Field(ge=0, le=1, description="share of the starts that lie on the other side")

    @model_validator(mode="after")
    def _check_ends(self) -> "BothSidesTask":
        if self.other_waypoints[-1] != self.waypoints[-1]:
            raise ValueError(
                f"other_waypoints must end at the goal {self.waypoints[-1]} m, found {self.other_waypoints[-1]}"
            )
        return self

    def law(self, finer: int = 1) -> Law:
        """Return the person's law from either side, along the path that is nearer."""
        own = super().law(finer)
        other = self.person.law(self._other_path, self.goal, own.step, own.turn)
        return _AlongNearer(own.path, own.aim, own.goal, own.step, own.turn, other)

    @cached_property
    def _other_path(self) -> ShownPath:
        places = SmoothPath.through(self.other_waypoints)
        return ShownPath(places, np.tile(self.goal[pose.QUATERNION], (len(places.points), 1)))

    def draw_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7), each from the start region of a side drawn by its share."""
        poses = self.draw_demonstrated_starts(rng, count)
        other = rng.random(count) < self.other_share
        poses[other, pose.POSITION] += np.array(self.other_waypoints[0]) - self.waypoints[0]
        return poses

    def draw_demonstrated_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7) of the side that is demonstrated."""
        return super().draw_starts(rng, count)


@dataclass(frozen=True)
class _AlongNearer(Law):
    """A law of two paths to one goal: from every pose that of the path that is nearer.

    Attributes:
        other: the law of the second path.
    """

    other: Law

    def next_pose(self, poses: Array, *, alone: bool = False) -> Array:
        """Return where the person would be after one step from poses (N, 7)."""
        position = poses[:, pose.POSITION]
        own, other = (
            np.linalg.norm(path.at(path.nearest(position, alone=alone)) - position, axis=1)
            for path in (self.path.places, self.other.path.places)
        )
        return np.where(
            (own <= other)[:, None],
            super().next_pose(poses, alone=alone),
            self.other.next_pose(poses, alone=alone),
        )
