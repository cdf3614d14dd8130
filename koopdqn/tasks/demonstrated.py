"""A task defined by demonstrations alone: their starts, their goal, and the mean of their paths."""

from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr, ValidationError

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.paths import SmoothPath, mean_poses
from koopdqn.pose import Array
from koopdqn.settings import Sha256, flaw
from koopdqn.tasks.person import ReferencePath
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task
from koopdqn.tasks.unfolding import Unfolding

if TYPE_CHECKING:
    from koopdqn.robot.scene import SceneBuilder

RotationType = Literal["held", "geodesic", "full", "free"]
"""How a task made from demonstrations treats orientation."""

LEAST_WAY = 4.0
"""Least distance of a demonstrated start from the goal, in goal tolerances; a path that passes itself may be closed."""
CLEAR_OF_GOAL = 3.0
"""A start within this many goal tolerances of the goal is none; a wide start region may contain the goal."""


class DemonstratedTask(Task):
    """The arm, alone in its scene but for obstacles, repeats what training demonstrations showed.

    Where the goal moves, demonstrations move with it: all poses are told as seen from the goal, as if it were where it
    was demonstrated, and starts are drawn as they then lie.

    The fields identify the task in artifacts. The demonstrations are not among them; :meth:`shown` takes them.
    """

    goal_moves: ClassVar[bool] = True

    turning: RotationType = Field(
        description="held: the goal's orientation all the way, as demonstrated; geodesic: the part of"
        " the demonstrated turn toward the goal is learned; full: all of it, which continuous actions can do; free:"
        " orientation was demonstrated but is no part of the task, and the goal's is kept"
    )
    held_limit_rad: float = Field(gt=0, description="turn away from the goal that breaks the rule, where held [rad]")
    start_margin_m: float = Field(gt=0, description="how far a start lies from a demonstrated one, along each axis [m]")
    follows_start: bool = Field(
        description="whether a path keeps the offset of its start from the others', fading toward the goal, and goes on"
        " as a regression on the start says"
    )
    passes_itself: bool = Field(
        default=False, description="whether the path comes over the same place again and is told leg by leg"
    )
    holdout: int = Field(ge=0, description="demonstrations kept for evaluation")
    training: Sha256 = Field(description="SHA-256 of the training demonstrations' content")

    _trajectories: tuple[Array, ...] = PrivateAttr(default=())
    _unfolding: Unfolding | None = PrivateAttr(default=None)

    @classmethod
    def shown(cls, trajectories: list[Array], **fields: object) -> "DemonstratedTask":
        """Return the task with these fields and training trajectories (N, 7) at the agent's step.

        Raises:
            BadInputError: a field breaks a rule.
        """
        try:
            task = cls.model_validate(fields)
        except ValidationError as error:
            raise BadInputError(f"task {fields['name']}: {flaw(error).removeprefix('Value error, ')}") from error
        return task.showing(trajectories)

    def showing(self, trajectories: list[Array], unfolding: Unfolding | None = None) -> Self:
        """Return the task, as read from an artifact, with training trajectories (N, 7) at the agent's step.

        An unfolding that an artifact holds counts, not what would be found today.
        """
        task = self.model_copy()
        task._trajectories, task._unfolding = tuple(trajectories), unfolding
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
    def demonstrated(self) -> tuple[Array, ...]:
        """The same, or nothing where the task was read from an artifact."""
        return self._trajectories

    @property
    def orientation(self) -> Literal["held", "learned"]:
        """Learned if the demonstrated turn is, in part or in full; otherwise held."""
        return "learned" if self.turning in ("geodesic", "full") else "held"

    @property
    def turns_in_full(self) -> bool:
        """Whether the demonstrated turn is learned in full."""
        return self.turning == "full"

    @property
    def demonstrated_middle(self) -> None:
        """Nothing: the start region was made from the demonstrations."""
        return None

    @property
    def unfolds(self) -> bool:
        """Whether the path passes itself."""
        return self.passes_itself

    @property
    def rule(self) -> str:
        """The orientation rule, or ``none``."""
        if self.turning == "held":
            return f"orientation stays within {np.degrees(self.held_limit_rad):.3g}° of the goal's"
        return "none"

    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return whether the orientation of each pose (N, 7) leaves its limit where it is held, as booleans (N,)."""
        if self.turning != "held":
            return np.zeros(len(poses), dtype=bool)
        return np.asarray(pose.rotation_distance(poses, self.goal) > self.held_limit_rad)

    def furnish(self, scene: "SceneBuilder") -> None:
        """Add nothing: demonstrations do not show what surrounds the arm."""

    @cached_property
    def nominal_path(self) -> SmoothPath:
        """The positions of the training demonstration that begins at the nominal start."""
        nearest = min(self.trajectories, key=lambda each: float(pose.position_distance(each[0], self.nominal_start)))
        return SmoothPath.along(nearest[:, pose.POSITION])

    @cached_property
    def person_frame(self) -> StartFrame:
        """The start frame, chosen by leaving one demonstration out at a time."""
        if self.follows_start:
            return StartFrame.following(self.trajectories, self.nominal_start, self.goal)
        unfolding = self._unfolding
        if self.passes_itself and unfolding is None:
            unfolding = Unfolding.of(self.trajectories, self.step_m, LEAST_WAY * self.goal_tolerance_m)
        start, goal = self.nominal_start[pose.POSITION], self.goal[pose.POSITION]
        return StartFrame(start, goal, follows=False, unfolding=unfolding)

    @cached_property
    def reference_path(self) -> ReferencePath:
        """The mean of the training demonstrations in the start frame: it was found nearest to those left out."""
        longest = max(len(rows) for rows in self.trajectories)
        return ReferencePath.along(mean_poses(self.person_frame.each(self.trajectories), longest))

    def with_starts_scaled(self, scale: float) -> Self:
        """Return the task with ``start_margin_m`` scaled by ``scale``."""
        return self.model_copy(update={"start_margin_m": scale * self.start_margin_m})

    def draw_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7), each beside the start of a random training demonstration.

        Orientation is that start's. Where the goal moves, they are told as seen from it. Draws too near to the goal are
        drawn again.
        """
        starts = np.array([trajectory[0] for trajectory in self.trajectories])
        drawn: list[Array] = []
        while len(drawn) < count:
            start = starts[rng.integers(len(starts))].copy()
            start[pose.POSITION] += rng.uniform(-self.start_margin_m, self.start_margin_m, 3)
            if self.goal_half_range_m is not None:
                half = np.array(self.goal_half_range_m)
                start[pose.POSITION] -= rng.uniform(-half, half)
            # A path that passes itself may begin where it ends.
            if self.unfolds or pose.position_distance(start, self.goal) > CLEAR_OF_GOAL * self.goal_tolerance_m:
                drawn.append(start)
        return np.array(drawn)
