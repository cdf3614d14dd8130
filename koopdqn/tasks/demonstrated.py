"""A task that demonstrations alone define: their starts, their goal, and going on as they did."""

from functools import cached_property
from typing import TYPE_CHECKING, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.paths import SmoothPath, mean_poses
from koopdqn.pose import Array
from koopdqn.schema import Sha256
from koopdqn.tasks.person import ShownPath
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task

if TYPE_CHECKING:
    from koopdqn.robot.scene import SceneBuilder

RotationType = Literal["held", "geodesic", "free"]
"""What a task made from demonstrations does with orientation."""

# A start this many goal tolerances from the goal is no start; the region may hold the goal where starts spread wide.
_CLEAR_OF_GOAL = 3.0


class DemonstratedTask(Task):
    """The arm alone in the arena does what training demonstrations showed.

    Its fields say all that artifacts need to tell one such task from another; the demonstrations themselves are
    not among them and are given by :meth:`shown`.
    """

    turning: RotationType = Field(
        description="held: the goal's orientation all the way, as demonstrated; geodesic: the demonstrated turn is"
        " learned; free: orientation was demonstrated but is no part of the task, and the goal's is kept"
    )
    held_limit_rad: float = Field(gt=0, description="turn away from the goal that breaks the rule, where held [rad]")
    start_margin_m: float = Field(gt=0, description="how far a start lies from a demonstrated one, along each axis [m]")
    follows_start: bool = Field(
        description="whether a path keeps beside the others what its start lies beside theirs, less and less toward"
        " the goal"
    )
    holdout: int = Field(ge=0, description="demonstrations kept for evaluation")
    training: Sha256 = Field(description="of the training demonstrations' content")

    _trajectories: tuple[Array, ...] = PrivateAttr(default=())

    @classmethod
    def shown(cls, trajectories: list[Array], **fields: object) -> "DemonstratedTask":
        """Return the task that fields describe, with its training trajectories (N, 7) at the agent's step.

        Raises:
            ValidationError: a field breaks a rule.
        """
        task = cls.model_validate(fields)
        task._trajectories = tuple(trajectories)
        return task

    @property
    def trajectories(self) -> tuple[Array, ...]:
        """The training demonstrations' poses (N, 7) each, at the agent's step.

        Raises:
            BadInputError: the task was read from an artifact, which does not hold them.
        """
        if not self._trajectories:
            raise BadInputError(f"task {self.name}: must come with its demonstrations, found their digest alone")
        return self._trajectories

    @property
    def orientation(self) -> Literal["held", "learned"]:
        """Learned where the demonstrated turn goes along the geodesic to the goal."""
        return "learned" if self.turning == "geodesic" else "held"

    @property
    def rule(self) -> str:
        """The orientation rule, if there is one."""
        if self.turning == "held":
            return f"orientation stays within {np.degrees(self.held_limit_rad):.2g}° of the goal's"
        return "none"

    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return whether orientation strays at each pose (N, 7) of a task that holds it, as booleans (N,)."""
        if self.turning != "held":
            return np.zeros(len(poses), dtype=bool)
        return np.asarray(pose.rotation_distance(poses, self.goal) > self.held_limit_rad)

    def furnish(self, scene: "SceneBuilder") -> None:
        """Add nothing: demonstrations do not tell what stands around the arm."""

    @cached_property
    def nominal_path(self) -> SmoothPath:
        """The training demonstration that begins at the nominal start."""
        nearest = min(self.trajectories, key=lambda each: float(pose.position_distance(each[0], self.nominal_start)))
        return SmoothPath.along(nearest[:, pose.POSITION])

    @property
    def person_frame(self) -> StartFrame:
        """The frame that the demonstrations, left out one at a time, ask for."""
        return StartFrame(self.nominal_start[pose.POSITION], self.goal[pose.POSITION], self.follows_start)

    @cached_property
    def shown_path(self) -> ShownPath:
        """The mean of the training demonstrations, all told as from the nominal start.

        Of what demonstrations alone tell, their mean was found to be nearest to those left out.
        """
        count = max(len(rows) for rows in self.trajectories)
        return ShownPath.along(mean_poses(self.person_frame.each(self.trajectories), count))

    def with_starts_scaled(self, scale: float) -> Self:
        """Return the task with ``scale`` times the distance that a start may lie from a demonstrated one."""
        return self.model_copy(update={"start_margin_m": scale * self.start_margin_m})

    def draw_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7), each beside the start of a training demonstration drawn evenly.

        Orientation is that start's. Draws within a few tolerances of the goal are drawn again.
        """
        starts = np.array([trajectory[0] for trajectory in self.trajectories])
        drawn: list[Array] = []
        while len(drawn) < count:
            start = starts[rng.integers(len(starts))].copy()
            start[pose.POSITION] += rng.uniform(-self.start_margin_m, self.start_margin_m, 3)
            if pose.position_distance(start, self.goal) > _CLEAR_OF_GOAL * self.goal_tolerance_m:
                drawn.append(start)
        return np.array(drawn)
