"""Scripted persons: each follows a reference path and returns to it in its own way."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from koopdqn import pose
from koopdqn.paths import SmoothPath, arc_lengths, row_products, to_count
from koopdqn.pose import Array
from koopdqn.settings import Name, Settings, load_settings
from koopdqn.tasks.step import full_step, one_step

if TYPE_CHECKING:
    from scipy.interpolate import BSpline


@dataclass(frozen=True)
class ReferencePath:
    """A path of poses, evenly spaced in arc length.

    Attributes:
        places: the positions.
        quaternions: (P, 4) the orientation at each of the positions' points.
    """

    places: SmoothPath
    quaternions: Array

    @classmethod
    def along(cls, poses: Array) -> "ReferencePath":
        """Return the path along poses (N, 7)."""
        places = SmoothPath.along(poses[:, pose.POSITION])
        return cls(places, to_count(poses, len(places.points))[:, pose.QUATERNION])

    @property
    def poses(self) -> Array:
        """The path's poses (P, 7)."""
        return pose.make(self.places.points, self.quaternions)

    def nearest(self, positions: Array, margin: float, *, alone: bool = False) -> Array:
        """Return the arc length (N,) [m] of the nearest point of the path to each position (N, 3) [m].

        Where the path passes itself there are several local minima of the distance. Of those within ``margin`` [m] of
        the least, the latest counts: an expert has no memory, and this choice lets it reach the end. With ``alone``
        rounding does not depend on the number of positions.
        """
        points = self.places.points
        products = row_products(2.0 * positions, points, alone=alone)
        squared = self._squares - products + (positions**2).sum(axis=1)[:, None]
        distance = np.sqrt(np.maximum(squared, 0.0))
        candidate = distance <= distance.min(axis=1, keepdims=True) + margin
        # Local minima only.
        candidate[:, 1:] &= distance[:, 1:] <= distance[:, :-1]
        candidate[:, :-1] &= distance[:, :-1] <= distance[:, 1:]
        latest = len(points) - 1 - candidate[:, ::-1].argmax(axis=1)
        return np.asarray(latest * self.places.spacing)

    @cached_property
    def _squares(self) -> Array:
        return np.asarray((self.places.points**2).sum(axis=1))

    def turned_at(self, arc: Array) -> Array:
        """Return the quaternions (N, 4) at arc lengths (N,) [m], clamped to the path's ends."""
        index = np.rint(arc / self.places.spacing).astype(int)
        return np.asarray(self.quaternions[np.clip(index, 0, len(self.quaternions) - 1)])


Aim = Callable[[ReferencePath, Array, Array, float], Array]
"""Returns the positions (N, 3) [m] that a person heads for, from the reference path, positions (N, 3) [m], the arc
lengths (N,) [m] of their nearest points, and the step [m]."""

# Within this distance of the goal [m, rad] an expert has come to rest; it is far under any tolerance.
_REST = 1e-6
# Points of a path count as equally near up to this share of a step.
_AS_NEAR = 0.25


@dataclass(frozen=True)
class Expert:
    """A scripted person on a path: gives the next pose for any pose.

    The scripted oracle, agreement figures and reference paths come from it. It depends on the pose alone and knows
    nothing of the Koopman model. Each step goes straight toward the aim and turns as the path does one step ahead,
    scaled to what the actions can do.

    Attributes:
        path: the path to follow; it ends at the goal.
        aim: the position to head for.
        goal: pose (7,) at which it stops.
        step: distance of one step [m].
        turn: turn of one step in place [rad]; 0 where the goal's orientation is held.
        in_full: whether it turns about any axis, as continuous actions can, and not to the goal alone.
    """

    path: ReferencePath
    aim: Aim
    goal: Array
    step: float
    turn: float
    in_full: bool = field(default=False, kw_only=True)

    def next_pose(self, poses: Array, *, alone: bool = False) -> Array:
        """Return the poses (N, 7) one step after poses (N, 7).

        With ``alone`` each is to the last bit what it is without the others.
        """
        position = poses[:, pose.POSITION]
        arc = self.path.nearest(position, _AS_NEAR * self.step, alone=alone)
        way = self.aim(self.path, position, arc, self.step) - position
        direction = way / np.maximum(pose.norm(way), 1e-12)[:, None]
        room = pose.position_distance(poses, self.goal)
        moved = position + np.minimum(self.step, room)[:, None] * direction
        if not self.turn:
            return pose.make(moved, self.goal[pose.QUATERNION])
        wished = pose.make(moved, self.path.turned_at(arc + self.step))
        if self.in_full:
            return full_step(poses, wished, room, self.step, self.turn)
        return one_step(poses, wished, self.goal, room, self.step, self.turn)

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) from a start (7,) to the goal, at most ``limit`` steps."""
        return self.roll_outs(start[None], limit)[0]

    def roll_outs(self, starts: Array, limit: int) -> list[Array]:
        """Return the poses (T, 7) from each of several starts (N, 7): to the last bit as :meth:`roll_out` does."""
        paths = [[start] for start in starts]
        under_way, poses = list(range(len(starts))), starts
        for _ in range(limit):
            if not under_way:
                break
            poses = self.next_pose(poses, alone=True)
            for index, reached in zip(under_way, poses, strict=True):
                paths[index].append(reached)
            left = np.maximum(pose.position_distance(poses, self.goal), pose.rotation_distance(poses, self.goal))
            on = left >= _REST
            under_way, poses = [index for index, more in zip(under_way, on, strict=True) if more], poses[on]
        return [np.array(path) for path in paths]


class Person(Settings, ABC):
    """A scripted person that demonstrates and answers. Subclass it for your own; the fields are its settings."""

    name: Name

    @abstractmethod
    def expert(self, reference: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        """Return this person as an expert on a path.

        Args:
            reference: the path; it ends at the goal.
            goal: pose (7,) at which the expert stops.
            step: distance of one step [m].
            turn: turn of one step in place [rad]; 0 where the goal's orientation is held.
        """


def _to_person(value: object) -> object:
    return load_settings(value, Person, "task.person") if isinstance(value, Mapping) else value


AnyPerson = Annotated[Person, BeforeValidator(_to_person)]
"""A person of any kind, as a field of settings."""


class Pursuit(Person):
    """Pursues a point ahead on the path: a small offset decays as exp(−distance / look-ahead)."""

    look_ahead_m: float = Field(
        ge=1e-3, le=1.0, description="how far ahead on the path the person looks, at least a step [m]"
    )

    def expert(self, reference: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        """Return the pursuit of the path."""
        return Expert(reference, self._aim, goal, step, turn)

    def _aim(self, path: ReferencePath, positions: Array, arc: Array, step: float) -> Array:
        return path.places.at(arc + max(self.look_ahead_m, step))


class Wide(Pursuit):
    """Pursues a path with larger detours from the straight line to the goal."""

    wider: float = Field(ge=0, le=1, description="how much larger the detours are, as a share of them")

    def expert(self, reference: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        """Return the pursuit of the wider path."""
        points = reference.places.points
        chord = points[-1] - points[0]
        along = (points - points[0]) @ chord / max(float(chord @ chord), 1e-12)
        straight = points[0] + along[:, None] * chord
        wider = straight + (1.0 + self.wider) * (points - straight)
        return super().expert(ReferencePath.along(pose.make(wider, reference.quaternions)), goal, step, turn)


class Square(Person):
    """Returns to the path at a right angle: farther than a step from it, heads for its nearest point."""

    def expert(self, reference: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        """Return the expert that first returns to the path, then goes along it."""
        return Expert(reference, _nearest_first, goal, step, turn)


def _nearest_first(path: ReferencePath, positions: Array, arc: Array, step: float) -> Array:
    nearest = path.places.at(arc)
    off = pose.norm(positions - nearest, keepdims=True) > step
    return np.where(off, nearest, path.places.at(arc + step))


class Via(Person):
    """Passes via points with minimum jerk (Flash & Hogan 1985).

    The via points lie at equal shares of the reference path; between them the motion is that of least jerk. An offset
    decays along the minimum-jerk polynomial and is zero at the next via point.
    """

    via_points: int = Field(ge=1, le=50, description="number of via points between start and goal")

    def expert(self, reference: ReferencePath, goal: Array, step: float, turn: float) -> Expert:
        """Return the expert that passes the via points."""
        path, arcs = self._through_via_points(reference)
        return Expert(path, partial(_minimum_jerk, arcs), goal, step, turn)

    def _through_via_points(self, reference: ReferencePath) -> tuple[ReferencePath, Array]:
        """Return the path of least jerk through the via points, and the arc lengths (V,) [m] of those and its ends."""
        count = self.via_points + 2
        # A short path has fewer points than that.
        share = np.unique(np.rint(np.linspace(0.0, len(reference.places.points) - 1, count)).astype(int))
        times, spline = least_jerk(reference.places.points[share])
        fine = np.linspace(0.0, times[-1], 4 * len(reference.places.points))
        points = np.asarray(spline(fine))
        # Orientations are those of the reference path at the same share of the way between two via points.
        index = np.rint(np.interp(fine, times, share)).astype(int)
        path = ReferencePath.along(pose.make(points, reference.quaternions[index]))
        return path, np.interp(times, fine, arc_lengths(points))


def least_jerk(points: Array) -> tuple[Array, "BSpline"]:
    """Return times (V,) and the curve of least squared jerk through points (V, 3) [m] at those times.

    It is the natural spline of degree five. Times are cumulated chord lengths.
    """
    from scipy.interpolate import make_interp_spline

    times = arc_lengths(points)
    free = [(3, np.zeros(3)), (4, np.zeros(3))]
    return times, make_interp_spline(times, points, k=5, bc_type=(free, free))


def _minimum_jerk(arcs: Array, path: ReferencePath, positions: Array, arc: Array, step: float) -> Array:
    """Return the next point of the path plus the decayed offset, between via points at arc lengths (V,) [m]."""
    ahead = max(1.0, np.rint(step / path.places.spacing)) * path.places.spacing
    # The segment at the middle of the coming step: at a via point, the next one.
    segment = np.clip(np.searchsorted(arcs, arc + 0.5 * ahead) - 1, 0, len(arcs) - 2)
    begin, length = arcs[segment], np.diff(arcs)[segment]
    here, there = (np.clip((at - begin) / length, 0.0, 1.0) for at in (arc, arc + ahead))
    share = _offset_left(there) / np.maximum(_offset_left(here), 1e-12)
    offset = positions - path.places.at(arc)
    return path.places.at(arc + ahead) + share[:, None] * offset


def _offset_left(share: Array) -> Array:
    """Return the remaining share of an offset in a minimum-jerk motion, 1 − (10u³ − 15u⁴ + 6u⁵) at times u (N,)."""
    return (1.0 - share) ** 3 * (1.0 + 3.0 * share + 6.0 * share**2)
