"""Derives a task from demonstrations: start region, goal, step, rotation type."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.demonstrations import preprocess
from koopdqn.demonstrations.cleaning import jump_of
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.inspection import compare
from koopdqn.demonstrations.preprocess import Trimmed, largest_turn_from, rotation_type_of, smooth, trim_idle_each
from koopdqn.errors import BadInputError
from koopdqn.paths import arc_lengths, at_arc_lengths, to_count
from koopdqn.pose import Array
from koopdqn.settings import Fraction, Positive
from koopdqn.tasks.demonstrated import LEAST_WAY, DemonstratedTask, RotationType
from koopdqn.tasks.person import AnyPerson
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.step import TURNS_PER_STEP
from koopdqn.tasks.task import TaskChoice
from koopdqn.tasks.unfolding import Unfolding

# The default step [m], and its bounds: it is shorter where a demonstration would have too few steps, longer where it
# would have too many.
_STEP_M, _LEAST_STEP_M, _LARGEST_STEP_M = 0.0021, 0.0005, 0.005
_FEWEST_STEPS, _MOST_STEPS = 50, 500
_STEP_PER_TOLERANCE = 1.05
# Turning away by less is how people turn: up to 7° in the sets at hand.
_AWAY_RAD = np.radians(15)


@dataclass(frozen=True)
class Derived:
    """A task and the demonstrations it was made from.

    Attributes:
        task: the task.
        training: without idle ends and sensor noise, each bent to end at the goal.
        held_out: kept for evaluation, without idle ends and sensor noise, with their own ends and orientation; with the
            goal's orientation where that is free, or held because it was asked for.
        notes: lines for people about the result.
    """

    task: DemonstratedTask
    training: Demonstrations
    held_out: tuple[Demonstration, ...]
    notes: tuple[str, ...]


class Derivation(TaskChoice):
    """How a task is made from demonstrations; null takes the value from them."""

    holdout: int | None = Field(
        ge=0, description="demonstrations kept for evaluation, the last ones; null: one, or none if there is only one"
    )
    place: Literal["auto"] | None = Field(
        description="auto: move all demonstrations rigidly to where the arm can follow them; null: leave them"
    )
    turning: RotationType | None = Field(description="how orientation is treated")
    step_m: float | None = Field(ge=1e-4, le=0.05, description="distance of one action [m]")
    rotation_tolerance_rad: float = Field(ge=1e-4, description="to compare poses [rad]")
    goal_tolerance_m: Positive = Field(description="within it the goal counts as reached [m]")
    goal_rotation_tolerance_rad: Positive
    person: AnyPerson = Field(description="who answers: goes along the demonstrations' mean")
    start_margin_m: Positive = Field(description="how far a start lies from a demonstrated one, along each axis [m]")
    end_spread: Fraction = Field(
        description="largest distance of an end from the mean of all ends, as a share of how far demonstrations go from"
        " their start, by the median"
    )
    end_spread_rad: Positive = Field(description="the same for its orientation, unless turning=free [rad]")
    held_limit_rad: Positive = Field(
        description="rotation distance from the goal up to which orientation counts as held [rad]"
    )

    def derive(self, demonstrations: Demonstrations, *, continuous: bool = False, unfolds: bool = True) -> Derived:
        """Return the task of demonstrations.

        The last ``holdout`` of them are held out. The others are preprocessed: idle ends trimmed, noise smoothed, and
        bent to end at the goal, the mean of their ends (:mod:`koopdqn.demonstrations.preprocess`). The nominal start is
        that of the demonstration nearest to all; starts are drawn beside all of theirs. What is turned is learned in
        full where actions are ``continuous``. A path that passes itself is unfolded if the intent ``unfolds`` it.

        Raises:
            BadInputError: too many are held out, one does not move, the ends are too far apart, or a start is at the
                goal.
        """
        kept = self.kept_of(len(demonstrations))
        cut = trim_idle_each(demonstrations.items)
        smoothed = [smooth(each.item) for each in cut]
        learned, aside = smoothed[: len(smoothed) - kept], smoothed[len(smoothed) - kept :]
        goal = preprocess.goal_of(learned)
        spread = preprocess.check_position(learned, goal, self.end_spread)
        shown = [item.poses for item in learned]
        turning = self.turning or rotation_type_of(shown, goal, self.held_limit_rad, continuous=continuous)
        if turning == "full" and not continuous:
            raise BadInputError(
                "task.turning: full must go with actions=continuous, found the ten actions, which turn to the"
                " goal alone"
            )
        if turning != "free":
            preprocess.check_orientation(learned, goal, self.end_spread_rad)
        moved = [_oriented(preprocess.align_goal(item, goal), goal, turning) for item in learned]
        training = Demonstrations(self.name, demonstrations.arm, moved, placement=demonstrations.placement)
        task = self._task(training, goal, turning, kept, unfolds=unfolds)
        notes = (
            _about_recordings(cut, smoothed, kept),
            *_about_jumps([each.item for each in cut[: len(learned)]]),
            _about_ends(task, spread),
            _about_motion(task, largest_turn_from(shown, goal)),
            *_about_passages(task),
            *_about_turns_away(task),
            *_about_together(learned),
            *self._about_held_out(aside, learned, goal, turning),
        )
        # What the task asks for, which may be less than was demonstrated.
        if turning == "free" or self.turning == "held":
            aside = [_oriented(item, goal, turning) for item in aside]
        return Derived(task, training, tuple(aside), notes)

    def kept_of(self, count: int) -> int:
        """Return how many of ``count`` demonstrations are held out.

        Raises:
            BadInputError: none is left to learn from.
        """
        kept = min(1, count - 1) if self.holdout is None else self.holdout
        if kept >= count:
            raise BadInputError(
                f"task.holdout must leave a demonstration to learn from, found {kept} of {count} held out"
            )
        return kept

    def _about_held_out(
        self, aside: Sequence[Demonstration], learned: Sequence[Demonstration], goal: Array, turning: RotationType
    ) -> Iterator[str]:
        """Yield what would be an error in a demonstration learned from; of one kept for evaluation it is a remark."""
        most = self.end_spread * preprocess.way_of(learned)
        for index, item in enumerate(aside, len(learned)):
            apart = float(pose.position_distance(item.poses[-1], goal))
            turned = float(pose.rotation_distance(item.poses[-1], goal))
            found = [f"{apart * 1e3:.0f} mm from the goal"] if apart > most else []
            if turning != "free" and turned > self.end_spread_rad:
                found.append(f"turned {np.degrees(turned):.0f}° from the goal's orientation")
            if found:
                yield (
                    f"demonstration {index}, kept for evaluation, ends {' and '.join(found)}, unlike those learned"
                    " from: what is measured against it says little"
                )

    def _task(
        self, training: Demonstrations, goal: Array, turning: RotationType, kept: int, *, unfolds: bool
    ) -> DemonstratedTask:
        step = self.step_m or _step([item.poses for item in training.items])
        trajectories = training.resampled(step, TURNS_PER_STEP * self.rotation_tolerance_rad)
        starts = np.array([trajectory[0] for trajectory in trajectories])
        way = pose.position_distance(starts, goal)
        least = LEAST_WAY * self.goal_tolerance_m
        unfolded = unfolds and Unfolding.of(trajectories, step, least) is not None
        if not unfolded and way.min() < least:
            raise BadInputError(
                f"demonstration {int(way.argmin())} must start at least {least:g} m from"
                f" the goal, found {way.min():.4f} m: within task.goal_tolerance_m of it the task has ended"
            )
        if unfolded and self.obstacles:
            raise BadInputError(f"task {self.name}: a path among obstacles must not pass itself, found one that does")
        middle = trajectories[_middle_one(trajectories)]
        start = middle[0]
        # A closed path is one by what lies between its ends.
        away = np.minimum(pose.position_distance(middle, start), pose.position_distance(middle, goal))
        between = [middle[away.argmax()]] if way.min() < least else []
        half = np.abs(starts - start)[:, pose.POSITION].max(axis=0) + self.start_margin_m
        follows = not unfolded and StartFrame.chosen(trajectories, start, goal).follows
        return DemonstratedTask.shown(
            trajectories,
            name=self.name,
            waypoints=tuple(tuple(each[pose.POSITION].tolist()) for each in (start, *between, goal)),
            start_quaternion=tuple(start[pose.QUATERNION].tolist()),
            goal_quaternion=tuple(goal[pose.QUATERNION].tolist()),
            start_half_range_m=tuple(half.tolist()),
            start_tilt_rad=0.0,
            step_m=step,
            position_tolerance_m=step / _STEP_PER_TOLERANCE,
            rotation_tolerance_rad=self.rotation_tolerance_rad,
            goal_tolerance_m=self.goal_tolerance_m,
            goal_rotation_tolerance_rad=self.goal_rotation_tolerance_rad,
            person=self.person,
            obstacles=self.obstacles,
            goal_half_range_m=self.goal_half_range_m,
            variation_m=0.0,
            least_clearance_m=0.0,
            turning=turning,
            held_limit_rad=self.held_limit_rad,
            follows_start=follows,
            passes_itself=unfolded,
            start_margin_m=self.start_margin_m,
            holdout=kept,
            training=training.digest(),
        )


def _oriented(item: Demonstration, goal: Array, turning: RotationType) -> Demonstration:
    """Return a demonstration with the goal's orientation throughout, unless the turn is learned."""
    if turning in ("geodesic", "full"):
        return item
    return Demonstration(item.times, pose.make(item.poses[:, pose.POSITION], goal[pose.QUATERNION]))


def _step(trajectories: list[Array]) -> float:
    length = float(np.median([arc_lengths(poses[:, pose.POSITION])[-1] for poses in trajectories]))
    step = float(np.clip(_STEP_M, length / _MOST_STEPS, length / _FEWEST_STEPS))
    return float(np.clip(step, _LEAST_STEP_M, _LARGEST_STEP_M))


def _middle_one(trajectories: list[Array]) -> int:
    """Return the index of the trajectory (N, 7) with the least mean distance from all, aligned by share of the path."""
    even = np.array([to_count(trajectory, 100)[:, pose.POSITION] for trajectory in trajectories])
    apart = np.linalg.norm(even[:, None] - even[None], axis=3).mean(axis=(1, 2))
    return int(apart.argmin())


def _about_recordings(cut: list[Trimmed], smoothed: list[Demonstration], kept: int) -> str:
    noise = max(_taken_out(each.item, item) for each, item in zip(cut, smoothed, strict=True))
    before, after = (max(values) for values in zip(*((each.before, each.after) for each in cut), strict=True))
    learned = len(smoothed) - kept
    return (
        f"made from {learned} demonstration{'s' if learned > 1 else ''}, {kept or 'none'} kept for evaluation; idle"
        f" ends cut off: up to {before:.2f} s before and {after:.2f} s after the motion; noise smoothed: up to"
        f" {noise * 1e3:.2g} mm"
    )


def _about_jumps(items: Sequence[Demonstration]) -> Iterator[str]:
    for index, jump in enumerate(map(jump_of, items)):
        if jump:
            yield (
                f"demonstration {index} jumps by {jump * 1e3:.0f} mm from one sample to the next, far faster than the"
                " rest of it, and the jump is learned; was it meant so?"
            )


def _taken_out(recorded: Demonstration, smoothed: Demonstration) -> float:
    """Return the RMS distance [m] between a recording and its smoothed version."""
    there = at_arc_lengths(smoothed.poses[:, pose.POSITION], smoothed.times, recorded.times)
    return float(np.sqrt(((recorded.poses[:, pose.POSITION] - there) ** 2).sum(axis=1).mean()))


def _about_ends(task: DemonstratedTask, spread: float) -> str:
    start, goal = (np.round(each[pose.POSITION], 4).tolist() for each in (task.nominal_start, task.goal))
    follows = "keep their offset, fading toward the goal" if task.follows_start else "meet the others"
    half = [round(1e3 * value) for value in task.start_half_range_m]
    return (
        f"start: around {start} m, within ±{task.start_margin_m * 1e3:g} mm of a demonstrated one, together ±{half} mm;"
        f" goal: {goal} m, the mean of ends up to {spread * 1e3:.1f} mm from it;"
        f" paths from other starts {follows}"
    )


def _about_motion(task: DemonstratedTask, turned: float) -> str:
    left = turned > task.held_limit_rad
    meaning = {
        "held": "held, the goal's is kept and what was demonstrated left out" if left else "held, as demonstrated",
        "geodesic": "geodesic, the demonstrated turn to the goal is learned",
        "full": "full, the demonstrated turn is learned about whatever axis",
        "free": "free, the goal's is kept and what was demonstrated left out",
    }
    steps = [len(trajectory) - 1 for trajectory in task.trajectories]
    return (
        f"step: {task.step_m * 1e3:.3g} mm, {min(steps)} to {max(steps)} a demonstration; orientation:"
        f" {meaning[task.turning]} (demonstrated up to {np.degrees(turned):.1f}° from the goal's)"
    )


def _about_passages(task: DemonstratedTask) -> list[str]:
    unfolding = task.person_frame.unfolding
    if unfolding is None:
        return []
    legs = len(unfolding.cuts) + 1
    return [
        f"the path passes itself: it has {legs} legs, all of them are learned, and which one a pose is on is known from"
        " where it was"
    ]


def _about_turns_away(task: DemonstratedTask) -> list[str]:
    left = [pose.rotation_distance(trajectory, task.goal) for trajectory in task.trajectories]
    away = max(float(each.max() - each[0]) for each in left)
    if task.turning != "geodesic" or away <= _AWAY_RAD:
        return []
    return [
        f"demonstrations turn up to {np.degrees(away):.0f}° farther from the goal's orientation on their way than they"
        " begin; the ten actions only turn toward it and leave that out, actions=continuous may turn in full"
    ]


def _about_together(items: Sequence[Demonstration]) -> list[str]:
    if len(items) == 1:
        return ["one demonstration: the trust domain is a tube of fixed width around it, and no coverage is calibrated"]
    beside = compare(items)
    return [
        *filter(None, [beside.parted]),
        *(
            f"demonstration {index} is {beside.deviation_mm[index]:.0f} mm off the others' mean, over three times as"
            " far as they are, and the trust domain reaches as far; was it meant so?"
            for index in beside.odd
        ),
    ]
