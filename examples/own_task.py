"""A task of your own: carry a block over a wall. One class here, one YAML in examples/conf/task/wall.yaml.

Run it with ``python examples/own_task.py seed=3``. On the command line, with this folder on PYTHONPATH, it is
``koopdqn train --config-dir examples/conf task=wall``.
"""

import sys
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

import koopdqn
from koopdqn.pose import Array
from koopdqn.robot.scene import SceneBuilder
from koopdqn.tasks.task import Task

HERE = Path(__file__).parent
GREY, BLUE = (0.6, 0.6, 0.6, 1.0), (0.2, 0.4, 0.8, 1.0)


class WallTask(Task):
    """The arm carries a block over a wall, the flange's z axis down; orientation is held."""

    wall_height_m: float = Field(gt=0, description="upper edge of the wall in UR Base [m]")

    @property
    def orientation(self) -> Literal["held", "learned"]:
        """The block stays upright."""
        return "held"

    @property
    def rule(self) -> str:
        """There is none beside the wall."""
        return "no rule but the wall"

    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return False for each pose (N, 7)."""
        return np.zeros(len(poses), dtype=bool)

    def furnish(self, scene: SceneBuilder) -> None:
        """Put a block on the flange and a wall between start and goal."""
        scene.tool_box("block", (0.0, 0.0, 0.04), (0.03, 0.03, 0.04), BLUE, mass=0.3, payload=True)
        scene.furniture_box("wall", (0.5, 0.0, self.wall_height_m / 2), (0.15, 0.01, self.wall_height_m / 2), GREY)


if __name__ == "__main__":
    config = koopdqn.load_config("task=wall", *sys.argv[1:], config_dir=HERE / "conf")
    demonstrations = koopdqn.generate(config)
    intent = koopdqn.fit(config, demonstrations)
    trained = koopdqn.train(config, demonstrations, intent)
    report = koopdqn.evaluate(config, demonstrations, intent, trained).report
    print(f"{report['success_rate']:.0%} of {report['episodes']} starts, {trained.questions} questions asked")
