"""Handing a knife to a person: the edge turns down before the blade comes near (§5.2 of the paper)."""

from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field, Strict, model_validator

from koopdqn import pose
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.settings import Fraction, Metres3, Settings, Vector3
from koopdqn.tasks.task import Task

if TYPE_CHECKING:
    from koopdqn.robot.scene import SceneBuilder

METAL = (0.35, 0.36, 0.38, 1.0)
STEEL = (0.82, 0.84, 0.87, 1.0)
EDGE = (0.85, 0.25, 0.15, 1.0)
GRIP = (0.16, 0.11, 0.08, 1.0)
WOOD = (0.76, 0.60, 0.42, 1.0)
CLOTH = (0.25, 0.35, 0.55, 1.0)
SKIN = (0.85, 0.66, 0.53, 1.0)
# Lines along the blade, from edge to spine; the least of their distances to the receiver is the blade's.
_BLADE_LINES = 5
# A path shorter than this [m] goes nowhere.
_NO_WAY_M = 1e-9


class Limb(Settings):
    """A part of the receiver: a capsule between two points in UR Base."""

    name: str
    start: Metres3
    end: Metres3
    radius_m: float = Field(gt=0)
    skin: bool


class Block(Settings):
    """A piece of furniture: a box along the axes of UR Base."""

    name: str
    center_m: Metres3
    size_m: Metres3


class KnifeTask(Task):
    """The arm brings a knife to a receiver, handle first, edge up at the start and down at the end.

    The gripper holds the blade by its spine, along the flange's z axis; the handle, beyond it, points at the receiver.
    The turn is about the blade's long axis. The blade is safe while its edge is within ``safe_angle_rad`` of straight
    down; the rule is broken when the blade is nearer to the receiver than ``rule_distance_m`` and not safe.
    """

    edge: Vector3 = Field(description="direction of the cutting edge, a unit vector in the flange frame")
    blade_start_m: float = Field(gt=0, description="where the blade begins along the flange's z axis [m]")
    blade_length_m: float = Field(gt=0)
    blade_height_m: float = Field(gt=0, description="from spine to edge [m]")
    handle_length_m: float = Field(gt=0)
    safe_angle_rad: float = Field(gt=0)
    rule_distance_m: float = Field(gt=0)
    turn_from: Fraction = Field(description="share of the reference path at which the turn begins")
    turn_until: Fraction = Field(description="share of the reference path at which the turn ends")
    receiver: Annotated[tuple[Limb, ...], Strict(False), Field(min_length=1)]
    furniture: Annotated[tuple[Block, ...], Strict(False)]

    @model_validator(mode="after")
    def _check_edge(self) -> "KnifeTask":
        length = float(np.linalg.norm(self.edge))
        if abs(length - 1.0) > 1e-3 or abs(self.edge[2]) > 1e-3:
            raise ValueError(f"edge must be a unit vector at right angles to the flange's z axis, found {self.edge}")
        if self.turn_until <= self.turn_from:
            raise ValueError(f"turn_until must be over turn_from ({self.turn_from:g}), found {self.turn_until:g}")
        return self

    @property
    def orientation(self) -> Literal["held", "learned"]:
        """The turn is part of what is learned."""
        return "learned"

    def turned(self, share: Array) -> Array:
        """Return the share (N,) of the turn at shares (N,) of the reference path: a smooth step 3u² − 2u³."""
        u = np.clip((share - self.turn_from) / (self.turn_until - self.turn_from), 0.0, 1.0)
        return np.asarray(u**2 * (3.0 - 2.0 * u))

    @property
    def rule(self) -> str:
        """The blade rule."""
        angle = np.degrees(self.safe_angle_rad)
        return f"edge within {angle:.3g}° of straight down before the blade is within {self.rule_distance_m:g} m"

    def blade_angle(self, poses: Array) -> Array:
        """Return the angle (N,) [rad] of the edge to straight down at poses (N, 7)."""
        edge = pose.rotate(poses[:, pose.QUATERNION], np.array(self.edge))
        return np.asarray(np.arctan2(np.hypot(edge[:, 0], edge[:, 1]), -edge[:, 2]))

    def blade_distance(self, poses: Array) -> Array:
        """Return the distance (N,) [m] from the nearest point of the blade to the receiver at poses (N, 7)."""
        first, second = (
            pose.rotate(poses[:, None, pose.QUATERNION], line) + poses[:, None, pose.POSITION]
            for line in self._blade_lines
        )
        starts, ends, radii = self._limbs
        return np.asarray(
            (segment_distance(first[:, :, None], second[:, :, None], starts, ends) - radii).min(axis=(1, 2))
        )

    @cached_property
    def _blade_lines(self) -> tuple[Array, Array]:
        """Both ends (_BLADE_LINES, 3) [m] of lines along the blade, in the flange frame."""
        heights = np.linspace(-0.5, 0.5, _BLADE_LINES)[:, None] * self.blade_height_m * np.array(self.edge)
        first, second = (heights + np.array([0.0, 0.0, end]) for end in self._blade_ends)
        return first, second

    @cached_property
    def _limbs(self) -> tuple[Array, Array, Array]:
        """Starts (L, 3), ends (L, 3) and radii (L,) of the receiver's limbs [m]."""
        starts, ends = (np.array([getattr(limb, name) for limb in self.receiver]) for name in ("start", "end"))
        return starts, ends, np.array([limb.radius_m for limb in self.receiver])

    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return whether the blade is near the receiver and not safe at each pose (N, 7), as booleans (N,)."""
        broken = np.asarray(self.blade_angle(poses) > self.safe_angle_rad)
        if broken.any():
            broken[broken] = self.blade_distance(poses[broken]) < self.rule_distance_m
        return broken

    def measures(self, path: Array, step_seconds: float) -> dict[str, float]:
        """Return the blade's final angle, share of the path until safe, least distance to the receiver and speed."""
        angle = self.blade_angle(path)
        unsafe = np.flatnonzero(angle > self.safe_angle_rad)
        safe_from = int(unsafe[-1]) + 1 if len(unsafe) else 0
        # Of the way, not of the steps: where the tool turns in place nothing comes nearer.
        way = arc_lengths(path[:, pose.POSITION])
        until = 1.0 if safe_from == len(path) else way[safe_from] / max(way[-1], _NO_WAY_M)
        tip = np.array([0.0, 0.0, self._blade_ends[1]]) + 0.5 * self.blade_height_m * np.array(self.edge)
        points = path[:, pose.POSITION] + pose.rotate(path[:, pose.QUATERNION], tip)
        return {
            "blade_angle_final_deg": float(np.degrees(angle[-1])),
            "fraction_until_safe": min(1.0, float(until)),
            "min_blade_distance_m": float(self.blade_distance(path).min()),
            "blade_speed_m_s": float(np.linalg.norm(np.diff(points, axis=0), axis=1).max() / step_seconds),
        }

    @property
    def _blade_ends(self) -> tuple[float, float]:
        return self.blade_start_m, self.blade_start_m + self.blade_length_m

    def furnish(self, scene: "SceneBuilder") -> None:
        """Add a gripper with a knife, the furniture and the receiver."""
        edge = np.array(self.edge)
        side = np.cross([0.0, 0.0, 1.0], edge)
        start, end = self._blade_ends
        palm = start - 0.02
        scene.tool_box("gripper_palm", (0.0, 0.0, palm / 2), (0.03, 0.03, palm / 2), METAL, mass=0.5)
        # The fingers reach over the spine, away from the edge.
        finger = (start + 0.04 - palm) / 2
        spine = -0.25 * self.blade_height_m * edge
        for name, sign in (("left", 1.0), ("right", -1.0)):
            center = spine + sign * 0.008 * side + np.array([0.0, 0.0, palm + finger])
            size = np.abs(0.006 * side) + np.abs(0.010 * edge) + np.array([0.0, 0.0, finger])
            scene.tool_box(f"gripper_finger_{name}", center.tolist(), size.tolist(), METAL, mass=0.08)
        half = self.blade_height_m / 2
        middle = np.array([0.0, 0.0, (start + end) / 2])
        thin = np.abs(0.0015 * side) + np.array([0.0, 0.0, self.blade_length_m / 2])
        body = thin + np.abs(0.8 * half * edge)
        scene.tool_box("blade", (middle - 0.2 * half * edge).tolist(), body.tolist(), STEEL, mass=0.12, payload=True)
        rim = thin + np.abs(0.2 * half * edge)
        scene.tool_box("edge", (middle + 0.8 * half * edge).tolist(), rim.tolist(), EDGE, mass=0.02, payload=True)
        scene.tool_cylinder(
            "handle", (0.0, 0.0, end), (0.0, 0.0, end + self.handle_length_m), 0.012, GRIP, mass=0.08, payload=True
        )
        for block in self.furniture:
            half_size = (0.5 * np.array(block.size_m)).tolist()
            scene.furniture_box(block.name, block.center_m, half_size, WOOD)
        for limb in self.receiver:
            rgba = SKIN if limb.skin else CLOTH
            scene.furniture_capsule(f"receiver_{limb.name}", limb.start, limb.end, limb.radius_m, rgba)


def segment_distance(first: Array, second: Array, start: Array, end: Array) -> Array:
    """Return the distances (...) [m] between segments first–second and start–end, (..., 3) each; they broadcast.

    The closest points of two lines are clamped to the segments in turn (Ericson, Real-Time Collision
    Detection, §5.1.9).
    """
    u, v, w = second - first, end - start, first - start
    a, b, c = (u * u).sum(axis=-1), (u * v).sum(axis=-1), (v * v).sum(axis=-1)
    d, e = (u * w).sum(axis=-1), (w * v).sum(axis=-1)
    determinant = a * c - b * b
    parallel = determinant < 1e-12
    s = np.clip(np.where(parallel, 0.0, (b * e - c * d) / np.where(parallel, 1.0, determinant)), 0.0, 1.0)
    t = np.clip((b * s + e) / c, 0.0, 1.0)
    s = np.clip((b * t - d) / a, 0.0, 1.0)
    gap = w + s[..., None] * u - t[..., None] * v
    return pose.norm(gap)
