"""A task of your own: pour from a can into a glass. docs/tutorial-own-task.md builds it step by step."""

import sys
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn import fit, generate, load_config, pose, train
from koopdqn.pose import Array
from koopdqn.robot.scene import SceneBuilder
from koopdqn.settings import Vector3
from koopdqn.tasks.task import Task

CAN, GLASS, WOOD = (0.7, 0.2, 0.2, 1.0), (0.6, 0.8, 0.9, 1.0), (0.76, 0.60, 0.42, 1.0)


class PouringTask(Task):
    """A can is carried upright over a rack to a glass and tilted there, about the flange's z axis."""

    glass_m: Vector3 = Field(description="middle of the glass's upper edge in UR Base [m]")
    mouth_m: Vector3 = Field(description="middle of the can's mouth in the flange frame [m]")
    spill_rad: float = Field(gt=0, description="tilt at which the can begins to pour [rad]")
    near_m: float = Field(gt=0, description="level distance from mouth to glass within which it may pour [m]")

    @property
    def orientation(self) -> Literal["held", "learned"]:
        """The tilt is part of what is learned."""
        return "learned"

    @property
    def rule(self) -> str:
        """What :meth:`rule_broken` watches over."""
        return "nothing is poured beside the glass"

    def turned(self, share: Array) -> Array:
        """Return the share (N,) of the tilt at shares (N,) of the path: a smooth step from 60 to 95 % of it."""
        return np.asarray((u := np.clip((share - 0.6) / 0.35, 0.0, 1.0)) ** 2 * (3.0 - 2.0 * u))

    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return whether the can pours beside the glass at each pose (N, 7)."""
        tilt = np.arccos(np.clip(-pose.rotate(poses[:, 3:], [1.0, 0.0, 0.0])[:, 2], -1.0, 1.0))
        mouth = poses[:, :3] + pose.rotate(poses[:, 3:], self.mouth_m)
        return np.asarray((tilt > self.spill_rad) & (pose.norm((mouth - self.glass_m)[:, :2]) > self.near_m))

    def furnish(self, scene: SceneBuilder) -> None:
        """Put a can on the flange, and a table with a rack and the glass before the arm."""
        (top, _, reach), (x, y, z) = self.mouth_m, self.glass_m
        scene.tool_box("gripper", (0.0, 0.0, reach / 2 - 0.02), (0.02, 0.02, reach / 2 - 0.02), WOOD, mass=0.5)
        scene.tool_cylinder("can", (top, 0.0, reach), (-top, 0.0, reach), 0.03, CAN, mass=0.3, payload=True)
        scene.furniture_box("glass", (x, y, z - 0.05), (0.035, 0.035, 0.05), GLASS)
        scene.furniture_box("table", (x + 0.05, 0.0, z - 0.115), (0.25, 0.4, 0.015), WOOD)
        scene.furniture_box("rack", (x, y - 0.245, z - 0.01), (0.05, 0.03, 0.09), WOOD)


if __name__ == "__main__":
    config = load_config("task=pouring", *sys.argv[1:], config_dir=f"{sys.path[0]}/conf")
    trained = train(config, demos := generate(config), fit(config, demos))
    print(f"learned: {trained.learned}, {trained.questions} questions asked")
