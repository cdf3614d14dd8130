"""Putting a bottle into a shelf from both of its sides, demonstrated from one only."""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from pydantic import Field, model_validator

from koopdqn import pose
from koopdqn.paths import SmoothPath
from koopdqn.pose import Array
from koopdqn.tasks.person import Expert, ReferencePath
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import Waypoints


class BothSidesTask(ShelfTask):
    """The shelf with starts beside both side walls and demonstrations beside one.

    Demonstrations do not show that the path around the other wall is the mirror image.
    """

    lengths: ClassVar[tuple[str, ...]] = (*ShelfTask.lengths, "other_waypoints")

    other_waypoints: Waypoints = Field(description="flange positions from the other side, start first, goal last [m]")
    other_share: float = Field(ge=0, le=1, description="share of the starts that lie on the other side")

    @model_validator(mode="after")
    def _check_ends(self) -> "BothSidesTask":
        if self.other_waypoints[-1] != self.waypoints[-1]:
            raise ValueError(
                f"other_waypoints must end at the goal {self.waypoints[-1]} m, found {self.other_waypoints[-1]}"
            )
        return self

    def expert(self, finer: int = 1) -> Expert:
        """Return the expert that follows the nearer of the two paths."""
        own = super().expert(finer)
        other = self.person.expert(self._other_path, self.goal, own.step, own.turn)
        return _AlongNearer(own.path, own.aim, own.goal, own.step, own.turn, other)

    @cached_property
    def _other_path(self) -> ReferencePath:
        places = SmoothPath.through(self.other_waypoints)
        return ReferencePath(places, np.tile(self.goal[pose.QUATERNION], (len(places.points), 1)))

    def draw_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7), a share ``other_share`` of them from the other side."""
        poses = self.draw_demonstrated_starts(rng, count)
        other = rng.random(count) < self.other_share
        poses[other, pose.POSITION] += np.array(self.other_waypoints[0]) - self.waypoints[0]
        return poses

    def draw_demonstrated_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7) of the demonstrated side."""
        return super().draw_starts(rng, count)


@dataclass(frozen=True)
class _AlongNearer(Expert):
    """An expert with two paths to one goal, which follows the nearer one.

    Attributes:
        other: the expert on the second path.
    """

    other: Expert

    def next_pose(self, poses: Array, *, alone: bool = False) -> Array:
        """Return the poses (N, 7) one step after poses (N, 7)."""
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
