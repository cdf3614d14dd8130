"""Putting a bottle into a shelf compartment, upright all the way (§5.1 of the paper)."""

from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.settings import Metres3
from koopdqn.tasks.task import Task

if TYPE_CHECKING:
    from koopdqn.robot.scene import SceneBuilder

BOARD_M = 0.018
WOOD = (0.76, 0.60, 0.42, 1.0)
DARK_WOOD = (0.62, 0.47, 0.32, 1.0)
METAL = (0.35, 0.36, 0.38, 1.0)
GLASS = (0.16, 0.45, 0.30, 1.0)


class ShelfTask(Task):
    """The arm carries a bottle from beside a shelf around the edge of its side wall into a compartment.

    The flange's z axis points horizontally at the shelf; a gripper holds the bottle ``grip_m`` in front of
    the flange, its axis along the flange's x axis. Orientation is held; tilt over ``max_tilt_rad`` breaks the rule.
    """

    # What grows with the arm; boards and fingers stay as thick as they are.
    lengths: ClassVar[tuple[str, ...]] = (
        *("waypoints", "start_half_range_m", "variation_m", "grip_m", "bottle_radius_m", "bottle_height_m"),
        *("compartment_corner_m", "compartment_size_m", "lip_m"),
    )

    max_tilt_rad: float = Field(gt=0, description="tilt of the bottle from upright that breaks the rule [rad]")
    grip_m: float = Field(gt=0, description="from the flange to the bottle's axis along the flange's z axis [m]")
    bottle_radius_m: float = Field(gt=0)
    bottle_height_m: float = Field(gt=0)
    compartment_corner_m: Metres3 = Field(description="least x, y, z inside the compartment [m]")
    compartment_size_m: Metres3 = Field(description="inner depth, width and height of the compartment [m]")
    lip_m: float = Field(ge=0, description="height of the front lip above the compartment's floor [m]")

    @property
    def orientation(self) -> Literal["held", "learned"]:
        """The bottle stays upright."""
        return "held"

    @property
    def rule(self) -> str:
        """The tilt rule."""
        return f"tilt stays within {np.degrees(self.max_tilt_rad):.3g}°"

    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return whether the bottle tilts too far at each pose (N, 7), as booleans (N,)."""
        upright = pose.rotate(self.goal[pose.QUATERNION], [1.0, 0.0, 0.0])
        axis = pose.rotate(poses[:, pose.QUATERNION], np.array([1.0, 0.0, 0.0]))
        tilt = np.arctan2(pose.norm(pose.cross(axis, upright)), axis @ upright)
        return np.asarray(tilt > self.max_tilt_rad)

    def scaled(self, factor: float) -> Self:
        """Return the task with path, start region, shelf and bottle ``factor`` times as large, about the base."""
        if factor == 1.0:
            return self
        # Anew, since a copy would keep the path of the first.
        kept = {name: getattr(self, name) for name in type(self).model_fields}
        return type(self)(**{**kept, **{name: _times(kept[name], factor) for name in self.lengths}})

    def furnish(self, scene: "SceneBuilder") -> None:
        """Put a parallel gripper with a bottle on the flange, and the shelf in front of the arm."""
        self._hold_bottle(scene)
        self._stand_shelf(scene)

    def _hold_bottle(self, scene: "SceneBuilder") -> None:
        reach, radius = self.grip_m, self.bottle_radius_m
        palm = 0.55 * reach
        scene.tool_box("gripper_palm", (0.0, 0.0, palm / 2), (0.03, 0.035, palm / 2), METAL, mass=0.5)
        finger = (reach + 0.6 * radius - palm) / 2
        for side, sign in (("left", 1.0), ("right", -1.0)):
            center = (0.0, sign * (radius + 0.006), palm + finger)
            scene.tool_box(f"gripper_finger_{side}", center, (0.012, 0.006, finger), METAL, mass=0.08)
        body = 0.72 * self.bottle_height_m
        # The flange's x axis points down, so the bottle's neck is on its negative side.
        bottom = self.bottle_height_m / 2
        scene.tool_cylinder(
            "bottle_body", (bottom - body, 0.0, reach), (bottom, 0.0, reach), radius, GLASS, mass=0.4, payload=True
        )
        scene.tool_cylinder(
            "bottle_neck",
            (-bottom, 0.0, reach),
            (bottom - body, 0.0, reach),
            0.4 * radius,
            GLASS,
            mass=0.1,
            payload=True,
        )

    def _stand_shelf(self, scene: "SceneBuilder") -> None:
        x, y, z = self.compartment_corner_m
        depth, width, height = self.compartment_size_m
        half = BOARD_M / 2
        middle_x, middle_y = x + depth / 2, y + width / 2
        outer_half = width / 2 + BOARD_M
        floor_z = scene.floor_height
        top = z + height + BOARD_M
        for name, board_z in (("shelf_bottom", z - half), ("shelf_top", z + height + half)):
            # Between the side boards, so that no two faces lie in one plane and flicker.
            scene.furniture_box(name, (middle_x, middle_y, board_z), (depth / 2 - 0.002, width / 2, half), WOOD)
        for name, board_y in (("shelf_right", y - half), ("shelf_left", y + width + half)):
            center = (middle_x, board_y, (floor_z + top) / 2)
            scene.furniture_box(name, center, (depth / 2, half, (top - floor_z) / 2), WOOD)
        back = (x + depth + half, middle_y, (floor_z + top) / 2)
        scene.furniture_box("shelf_back", back, (half, outer_half, (top - floor_z) / 2), DARK_WOOD)
        lower = floor_z + 0.35
        scene.furniture_box("shelf_lower", (middle_x, middle_y, lower), (depth / 2 - 0.002, width / 2, half), WOOD)
        if self.lip_m > 0:
            lip = (x + half, middle_y, z + self.lip_m / 2)
            scene.furniture_box("shelf_lip", lip, (half, width / 2, self.lip_m / 2), DARK_WOOD)


def _times(value: Any, factor: float) -> Any:
    return tuple(_times(item, factor) for item in value) if isinstance(value, tuple) else factor * value
