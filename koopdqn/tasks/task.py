"""The interface of a task: its poses, its scene, its person and its rule."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, ClassVar, Final, Literal, Self

import numpy as np
from pydantic import Field, Strict, model_validator

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.paths import SmoothPath
from koopdqn.pose import Array
from koopdqn.settings import Metres3, Settings, Vector3, Vector4
from koopdqn.tasks.obstacles import Obstacles
from koopdqn.tasks.person import AnyPerson, Expert, ReferencePath
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.step import IN_PLACE

if TYPE_CHECKING:
    from koopdqn.robot.scene import SceneBuilder

Waypoints = Annotated[tuple[Metres3, ...], Strict(False), Field(min_length=2)]

# No direction is farther than 54.7° from the nearest axis, an error of 2 sin(54.7°/2) = 0.92 steps; so the step may
# be at most 1/0.92 tolerances for some action to be right always.
MAX_STEP_PER_TOLERANCE = 1.087
_LEAST_CHORD_M = 1e-3
NO_MOTION: Final = 1e-9
"""A motion below this [m or rad] counts as none: far under any tolerance and above rounding."""
# A goal is told, and asked for, to a tenth of a millimetre.
_GOAL_ROUNDING_M = 1e-4
# The paper's lift has no constant observable; a constant yaw [rad] serves as one.
_CONSTANT_YAW = 1.0


class TaskChoice(Settings, ABC):
    """An option of the group ``task``: a task, or how one is made from demonstrations."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    obstacles: Obstacles = Field(default=(), description="what else stands in the scene and is kept clear of")
    goal_half_range_m: Vector3 | None = Field(
        default=None,
        description="half the region along each axis from which goals are drawn, around the goal; null: it stays [m]",
    )

    @model_validator(mode="after")
    def _check_goal_moves_alone(self) -> Self:
        if (half := self.goal_half_range_m) is not None and self.obstacles:
            raise ValueError(f"goal_half_range_m must be null where obstacles stand still, found {half}")
        return self


class Task(TaskChoice):
    """A motion from a start region to a goal, as a person would do it. Subclass it for a new task.

    All poses are of the flange in UR Base.
    """

    waypoints: Waypoints = Field(description="flange positions of the nominal path, start first, goal last [m]")
    start_quaternion: Vector4
    goal_quaternion: Vector4
    start_half_range_m: Vector3 = Field(description="half the start region along each axis [m]")
    start_tilt_rad: float = Field(
        ge=0, le=0.5, description="largest turn of a start, about the axis of the turn to the goal [rad]"
    )
    step_m: float = Field(ge=1e-4, le=0.05, description="distance of one action [m]")
    position_tolerance_m: float = Field(gt=0, description="to compare poses [m]")
    rotation_tolerance_rad: float = Field(ge=1e-4, description="to compare poses [rad]")
    goal_tolerance_m: float = Field(gt=0, description="within it the goal counts as reached [m]")
    goal_rotation_tolerance_rad: float = Field(gt=0)
    person: AnyPerson = Field(description="who demonstrates and answers")
    variation_m: float = Field(ge=0, le=0.05, description="largest sideways wander of a demonstration [m]")
    least_clearance_m: float = Field(ge=0, description="between payload and scene at start and goal [m]")

    goal_moves: ClassVar[bool] = False
    """Whether the goal may move; not where what the demonstrations pass stands still."""

    @model_validator(mode="after")
    def _check_step(self) -> "Task":
        ratio = self.step_m / self.position_tolerance_m
        if not 1.0 < ratio <= MAX_STEP_PER_TOLERANCE:
            raise ValueError(
                f"step_m must be over position_tolerance_m and at most {MAX_STEP_PER_TOLERANCE} times it"
                f" ({self.position_tolerance_m:g} < step_m <= {MAX_STEP_PER_TOLERANCE * self.position_tolerance_m:g}),"
                f" found {self.step_m:g}"
            )
        chords = np.linalg.norm(np.diff(np.array(self.waypoints), axis=0), axis=1)
        if chords.min() < _LEAST_CHORD_M:
            raise ValueError(
                f"waypoints must lie at least {_LEAST_CHORD_M:g} m from their neighbours, found {chords.min():g} m"
            )
        for name in ("start_quaternion", "goal_quaternion"):
            length = float(np.linalg.norm(getattr(self, name)))
            if abs(length - 1.0) > 1e-3:
                raise ValueError(f"{name} must have length 1 within 0.001, found {length:g}")
        if self.start_tilt_rad > 0 and pose.rotation_distance(self.nominal_start, self.goal) < NO_MOTION:
            raise ValueError(
                f"start_tilt_rad must be 0 where start and goal are turned alike, found {self.start_tilt_rad:g}"
            )
        self._check_goal_range()
        if min(self.start_half_range_m) < 0:
            raise ValueError(f"start_half_range_m must not be negative, found {self.start_half_range_m}")
        return self

    def _check_goal_range(self) -> None:
        half = self.goal_half_range_m
        if half is None:
            return
        if not self.goal_moves:
            raise ValueError(
                f"goal_half_range_m must be null for task {self.name}, whose demonstrations pass things that stand"
                f" still, found {half}"
            )
        if min(half) < 0 or max(half) == 0:
            raise ValueError(f"goal_half_range_m must not be negative, and above 0 along some axis, found {half}")

    @property
    @abstractmethod
    def orientation(self) -> Literal["held", "learned"]:
        """Whether orientation is held throughout or is part of what is learned."""

    def as_held(self, poses: Array) -> Array:
        """Return poses (N, 7) with the goal's orientation throughout, unless the turn is learned."""
        if self.orientation == "learned":
            return poses
        return pose.make(poses[:, pose.POSITION], self.goal[pose.QUATERNION])

    @property
    def turns_in_full(self) -> bool:
        """Whether turns about any axis are learned, as continuous actions make them, not those to the goal alone."""
        return False

    @property
    def unfolds(self) -> bool:
        """Whether the person's path passes itself and is unfolded in their frame."""
        return False

    def onward(self, poses: Array, starts: Array) -> Array:
        """Return the starts (N, 7) that count from poses (N, 7) on, of episodes from ``starts`` (N, 7).

        Where the path passes itself it has legs, and an episode that comes to one counts as begun there.
        """
        return self.person_frame.onward(poses, starts) if self.unfolds else starts

    def begun(self, poses: Array, *, hindsight: bool = False) -> Array:
        """Return the starts (N, 7) that count at poses (N, 7) of one episode; with ``hindsight``, of a whole path."""
        frame = self.person_frame if self.unfolds else STILL
        return frame.begun(poses, hindsight=hindsight)

    def legs(self, start: Array) -> Array:
        """Return the starts (K, 7) of all legs of an episode from a start (7,)."""
        unfolding = self.person_frame.unfolding if self.unfolds else None
        return start[None] if unfolding is None else np.concatenate([start[None], unfolding.starts])

    @property
    def demonstrated(self) -> Sequence[Array]:
        """The demonstrations that define the task, poses (N, 7) each; none where it is defined without."""
        return ()

    @abstractmethod
    def furnish(self, scene: "SceneBuilder") -> None:
        """Add the task's tool, payload and furniture to a scene."""

    @abstractmethod
    def rule_broken(self, poses: Array) -> np.ndarray:
        """Return whether each pose (N, 7) breaks the task's own rule, as booleans (N,)."""

    @property
    def person_frame(self) -> StartFrame:
        """The start frame of the expert; the identity unless the person's path follows its start."""
        return STILL

    def turned(self, share: Array) -> Array:
        """Return the share (N,) of the turn from start to goal made at shares (N,) of the reference path.

        It is 1 where orientation is held.
        """
        return np.ones_like(share)

    def measures(self, path: Array, step_seconds: float) -> dict[str, float]:
        """Return this task's own measures of a path (T, 7), which ``eval.json`` holds as ``task_measures``.

        Every path gives the same names. A step takes ``step_seconds`` [s].
        """
        return {}

    @property
    @abstractmethod
    def rule(self) -> str:
        """The task's own rule in a few words."""

    @cached_property
    def goal(self) -> Array:
        """The goal pose (7,)."""
        return pose.make(self.waypoints[-1], self.goal_quaternion)

    @cached_property
    def frame(self) -> Array:
        """Two quaternions (2, 4), left L and right R: roll, pitch and yaw of an orientation q are those of L⁻¹ q R.

        Where orientation is held, L is the goal's and R the identity. Otherwise the turn from start to goal is roll,
        from minus to plus half of it, with pitch near 0 and yaw near 1 rad: far from the singularity and from ±180°.
        """
        goal, start = self.goal[pose.QUATERNION], self.nominal_start[pose.QUATERNION]
        turn = pose.to_rotation_vector(pose.multiply(pose.conjugate(goal), start))
        angle = float(np.linalg.norm(turn))
        if angle < NO_MOTION:
            return np.array([goal, pose.IDENTITY[pose.QUATERNION]])
        axis = turn / angle
        # The right side takes the x axis to the axis of the turn.
        between = np.array([1.0 + axis[0], 0.0, -axis[2], axis[1]])
        right = pose.normalized(between) if axis[0] > -0.99 else np.array([0.0, 0.0, 0.0, 1.0])
        half_way = pose.multiply(goal, pose.from_rotation_vector(0.5 * turn))
        yaw = pose.from_rotation_vector([0.0, 0.0, -_CONSTANT_YAW])
        return np.array([pose.multiply(half_way, pose.multiply(right, yaw)), right])

    def angles(self, quaternions: Array) -> Array:
        """Return roll, pitch and yaw (N, 3) [rad] of quaternions (N, 4) in the task's :attr:`frame`."""
        return angles_in(self.frame, quaternions)

    @cached_property
    def nominal_start(self) -> Array:
        """The middle of the start region, a pose (7,)."""
        return pose.make(self.waypoints[0], self.start_quaternion)

    @property
    def demonstrated_middle(self) -> Array | None:
        """The middle (3,) [m] of where :meth:`draw_demonstrated_starts` draws; None if demonstrations alone tell it."""
        return np.asarray(self.nominal_start[pose.POSITION])

    @cached_property
    def reference_path(self) -> ReferencePath:
        """The path for the person to follow: :attr:`waypoint_path`, unless a task says otherwise."""
        return self.waypoint_path

    @cached_property
    def waypoint_path(self) -> ReferencePath:
        """The path through the waypoints, turned as :meth:`turned` says."""
        places = SmoothPath.through(self.waypoints)
        turn = pose.rotation_distance(self.nominal_start, self.goal)
        angle = turn * self.turned(np.linspace(0.0, 1.0, len(places.points)))
        start = np.tile(self.nominal_start[pose.QUATERNION], (len(angle), 1))
        return ReferencePath(places, pose.turned_toward(start, self.goal[pose.QUATERNION], angle))

    @cached_property
    def nominal_path(self) -> SmoothPath:
        """The positions of the demonstrator's path, without variation."""
        return self.demonstrator.path.places

    @cached_property
    def demonstrator(self) -> Expert:
        """The expert without variation, with the agent's step; the scripted oracle answers from it."""
        return self.expert()

    def expert(self, finer: int = 1) -> Expert:
        """Return the task's person as an expert, with steps ``finer`` times smaller than the agent's."""
        turn = IN_PLACE * self.rotation_tolerance_rad if self.orientation == "learned" else 0.0
        expert = self.person.expert(self.reference_path, self.goal, self.step_m / finer, turn / finer)
        return replace(expert, in_full=self.turns_in_full)

    def scaled(self, factor: float) -> Self:
        """Return the task for an arm ``factor`` times as large as the UR5 that its lengths are made for.

        It is the task as it is, unless a task says which of its lengths grow. Steps and tolerances never do.
        """
        return self

    def with_starts_scaled(self, scale: float) -> Self:
        """Return the task with its start region scaled by ``scale``; tilts stay."""
        x, y, z = self.start_half_range_m
        return self.model_copy(update={"start_half_range_m": (scale * x, scale * y, scale * z)})

    def without_obstacles(self) -> Self:
        """Return the task with nothing in its scene but its own furniture."""
        return self.model_copy(update={"obstacles": ()})

    def with_still_goal(self) -> Self:
        """Return the task with its goal where it is."""
        return self.model_copy(update={"goal_half_range_m": None})

    def goal_displacement(self, goal: Vector3) -> Array:
        """Return by how much (3,) [m] a goal is away from the task's own.

        Raises:
            BadInputError: the task's goal does not move, or not so far.
        """
        moved = np.array(goal) - self.goal[pose.POSITION]
        if self.goal_half_range_m is None:
            raise BadInputError(
                f"goal: needs a run of a task with goal_half_range_m, found task {self.name} without"
                " (task=demonstrated may have one, and a task of your own whose goal_moves is True)"
            )
        if (np.abs(moved) > np.array(self.goal_half_range_m) + _GOAL_ROUNDING_M).any():
            raise BadInputError(
                f"goal: must be at most {list(self.goal_half_range_m)} m along each axis from"
                f" {np.round(self.goal[pose.POSITION], 4).tolist()} m, found {list(goal)}"
            )
        return moved

    def draw_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7) drawn uniformly from the start region, tilts about the turn's axis.

        Where the goal moves, they are told as seen from it.
        """
        half = np.array(self.start_half_range_m)
        positions = self.nominal_start[pose.POSITION] + rng.uniform(-half, half, (count, 3))
        if self.goal_half_range_m is not None:
            moved = np.array(self.goal_half_range_m)
            positions -= rng.uniform(-moved, moved, (count, 3))
        poses = pose.make(positions, self.start_quaternion)
        if self.start_tilt_rad > 0:
            start = self.nominal_start[pose.QUATERNION]
            turn = pose.to_rotation_vector(pose.multiply(pose.conjugate(self.goal[pose.QUATERNION]), start))
            angle = rng.uniform(-self.start_tilt_rad, self.start_tilt_rad, (count, 1))
            tilt = pose.from_rotation_vector(angle * turn / np.linalg.norm(turn))
            poses[:, pose.QUATERNION] = pose.multiply(start, tilt)
        return poses

    def draw_demonstrated_starts(self, rng: np.random.Generator, count: int) -> Array:
        """Return ``count`` poses (count, 7) drawn from where demonstrations begin; tasks may begin elsewhere too."""
        return self.with_still_goal().draw_starts(rng, count)

    def reached(self, poses: Array) -> np.ndarray:
        """Return whether each pose (N, 7) counts as the goal, as booleans (N,)."""
        near = np.asarray(pose.position_distance(poses, self.goal) <= self.goal_tolerance_m)
        if near.any():
            near[near] = pose.rotation_distance(poses[near], self.goal) <= self.goal_rotation_tolerance_rad
        return near

    def arrived(self, poses: Array, starts: Array | None) -> np.ndarray:
        """Return whether poses (N, ..., 7) of episodes from ``starts`` (N, 7) end them at the goal, as booleans.

        A path that passes itself ends there on its last leg alone. Without starts poses are in the start frame already.
        """
        there = np.asarray(self.reached(poses.reshape(-1, 7)), dtype=bool).reshape(poses.shape[:-1])
        if starts is None or not self.unfolds or not there.any():
            return there
        return np.asarray((there.T & self.person_frame.on_last_leg(starts)).T)


def angles_in(frame: Array, quaternions: Array) -> Array:
    """Return roll, pitch and yaw (N, 3) [rad] of quaternions (N, 4) in a frame (2, 4) as :attr:`Task.frame` gives."""
    left, right = frame
    return pose.to_roll_pitch_yaw(pose.multiply(pose.conjugate(left), pose.multiply(quaternions, right)))


def quaternions_in(frame: Array, angles: Array) -> Array:
    """Return the quaternions (N, 4) of roll, pitch and yaw (N, 3) [rad] in a frame (2, 4)."""
    left, right = frame
    return pose.multiply(left, pose.multiply(pose.from_roll_pitch_yaw(angles), pose.conjugate(right)))


def breaks_rule(task: Task, poses: Array) -> np.ndarray:
    """Return :meth:`Task.rule_broken` of poses (N, 7) as booleans (N,), of a list or of 0 and 1 too."""
    return np.asarray(task.rule_broken(poses), dtype=bool)


def demonstrator_next_poses(task: Task, poses: Array, starts: Array) -> Array:
    """Return the demonstrator's next poses (N, 7) from poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
    frame = task.person_frame
    return frame.from_frame(task.demonstrator.next_pose(frame.to_frame(poses, starts)), starts, poses)
