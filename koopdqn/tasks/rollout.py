"""Roll-outs: a controller moves the arm from given starts until each episode ends; wrong actions are not undone."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.actions import reached_by
from koopdqn.tasks.task import NO_MOTION, Task, breaks_rule
from koopdqn.tasks.workcell import REASONS, Motion, Reachability

SUCCESS: Final = "success"
STEP_LIMIT: Final = "step_limit"
STUCK: Final = "stuck"
OFF_GOAL: Final = "off_goal"
"""A given path ended away from the goal."""
RULE_BROKEN: Final = "rule_broken"
FAILURES: Final = (*REASONS, RULE_BROKEN, STUCK, STEP_LIMIT, OFF_GOAL)
"""Causes of failure."""

# Poses that differ by less [m, or in a quaternion's entries] are the same.
_SAME_PLACE: Final = 1e-7

# Within the goal's tolerance a step of a twist is made that brings the arm nearer to it by more than so many steps.
_LEAST_GAIN: Final = 0.1

Controller = Callable[[Array, Array], np.ndarray]
"""Chooses actions, indices (N,) or twists (N, 3 or 6), from poses (N, 7) of episodes that began at starts (N, 7)."""

Moves = Callable[[Array, Array, Array, Array, np.ndarray], list[Motion]]
"""What becomes of a step to poses (N, 7), from poses (N, 7) with joints (N, 6), of episodes that began at starts (N, 7)
and made (N,) steps. All poses are in the world."""


@dataclass(frozen=True)
class Episode:
    """One finished episode.

    Attributes:
        poses: (T + 1, 7) poses passed, the start first.
        joints: (T + 1, 6) joint angles [rad].
        outcome: :data:`SUCCESS` or one of :data:`FAILURES`.
        detail: more about a failure, in words.
        moved: (3,) [m] by which the goal was moved: poses are told as seen from it, so far off they are in the world.
    """

    poses: Array
    joints: Array
    outcome: str
    detail: str = ""
    moved: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def in_world(self) -> Array:
        """The poses (T + 1, 7) passed in the world."""
        return np.asarray(self.poses + np.concatenate([self.moved, np.zeros(4)]))

    @property
    def positions(self) -> Array:
        """Their positions (T + 1, 3) [m]."""
        return self.in_world[:, pose.POSITION]

    @property
    def steps(self) -> int:
        """Number of steps made."""
        return len(self.poses) - 1


def roll_out(
    controller: Controller,
    task: Task,
    reachability: Reachability,
    starts: Array,
    joints: Array,
    limit: int,
    *,
    cut_circles: bool = False,
    moves: Moves | None = None,
    moved: Array | None = None,
) -> list[Episode]:
    """Return the episodes of a controller from starts (N, 7) with joints (N, 6), at most ``limit`` steps each.

    An episode ends within the goal's tolerance; with twists, which can come to the goal itself, it goes on there while
    they bring the arm nearer. An action that the arm cannot carry out ends its episode as a failure. So does one that
    leaves the pose unchanged: a controller without memory would repeat it until the limit. With ``cut_circles`` an
    episode that returns to one of its poses ends there as a step limit, since it would go round in a circle until the
    limit. ``moves`` decides which steps are made; None makes those that the arm can make. Where goals are ``moved``
    (N, 3) [m], the starts are told as seen from them, and the arm is so far off in the world.
    """
    seen: list[set[bytes]] = [set() for _ in starts]
    moved = np.zeros((len(starts), 3)) if moved is None else moved
    runs = [_Run([start], [angles], each) for start, angles, each in zip(starts, joints, moved, strict=True)]
    starts = np.array(starts)
    for _ in range(limit):
        active = [i for i, run in enumerate(runs) if not run.outcome]
        if not active:
            break
        poses = np.array([runs[i].poses[-1] for i in active])
        actions = controller(poses, starts[active])
        reached = reached_by(poses, actions, task)
        if twists := actions.ndim > 1:
            active, reached = _nearer(runs, active, reached, task)
            if not active:
                continue
        _advance([runs[i] for i in active], reached, task, reachability, moves, starts[active], twists=twists)
        if task.unfolds:
            starts[active] = task.onward(np.array([runs[i].poses[-1] for i in active]), starts[active])
        if cut_circles:
            # A path that turns back comes to the same poses, on another leg.
            held = np.concatenate([np.array([runs[i].poses[-1] for i in active]), starts[active]], axis=1)
            places = np.round(held / _SAME_PLACE).astype(np.int64)
            for i, row in zip(active, places, strict=True):
                place = row.tobytes()
                if place in seen[i] and not runs[i].outcome:
                    runs[i].outcome = STEP_LIMIT
                seen[i].add(place)
    return [run.finished() for run in runs]


def follow(
    paths: list[Array], task: Task, reachability: Reachability, joints: Array, moved: Array | None = None
) -> list[Episode]:
    """Return the episodes of following given paths (T, 7), each from its joints (6,), to the end or a failure.

    Where goals are ``moved`` (N, 3) [m], the paths are told as seen from them.
    """
    moved = np.zeros((len(paths), 3)) if moved is None else moved
    runs = [_Run([path[0]], [angles], each) for path, angles, each in zip(paths, joints, moved, strict=True)]
    starts = [task.begun(path, hindsight=True) for path in paths]
    for t in range(1, max(map(len, paths), default=0)):
        active = [i for i, run in enumerate(runs) if not run.outcome and t < len(paths[i])]
        if active:
            reached, begun = (np.array([rows[i][at] for i in active]) for rows, at in ((paths, t), (starts, t - 1)))
            _advance([runs[i] for i in active], reached, task, reachability, None, begun)
    for run in runs:
        run.outcome = run.outcome or OFF_GOAL
    return [run.finished() for run in runs]


@dataclass
class _Run:
    poses: list[Array]
    joints: list[Array]
    moved: Array
    outcome: str = ""
    detail: str = ""
    there: bool = False

    def finished(self) -> Episode:
        outcome = self.outcome or (SUCCESS if self.there else STEP_LIMIT)
        return Episode(np.array(self.poses), np.array(self.joints), outcome, self.detail, self.moved)


def _nearer(runs: list[_Run], active: list[int], reached: Array, task: Task) -> tuple[list[int], Array]:
    """End those of the active runs that are at the goal and come no nearer to it; return the others and their poses."""
    before = np.array([runs[i].poses[-1] for i in active])
    gain = pose.position_distance(before, task.goal) - pose.position_distance(reached, task.goal)
    on = task.reached(reached) & ~breaks_rule(task, reached) & (gain > _LEAST_GAIN * task.step_m)
    on |= [not runs[i].there for i in active]
    for row in np.flatnonzero(~on):
        runs[active[row]].outcome = SUCCESS
    return [active[row] for row in np.flatnonzero(on)], reached[on]


def _advance(
    runs: list[_Run],
    reached: Array,
    task: Task,
    reachability: Reachability,
    moves: Moves | None,
    starts: Array,
    *,
    twists: bool = False,
) -> None:
    """Move runs from ``starts`` (N, 7) one step to the reached poses (N, 7), and set the outcome of those that end."""
    joints = np.array([run.joints[-1] for run in runs])
    away = np.array([[*run.moved, 0.0, 0.0, 0.0, 0.0] for run in runs])
    before = np.array([run.poses[-1] for run in runs])
    if moves is None:
        motions = reachability.move_batch(reached + away, joints)
    else:
        steps = np.array([len(run.poses) - 1 for run in runs])
        motions = moves(reached + away, before + away, joints, starts + away, steps)
    stuck = pose.position_distance(reached, before) < NO_MOTION
    if stuck.any():
        stuck[stuck] = pose.rotation_distance(reached[stuck], before[stuck]) < NO_MOTION
    there = task.arrived(reached, starts)
    ends = np.select([breaks_rule(task, reached), there, stuck], [RULE_BROKEN, SUCCESS, STUCK], "")
    for run, target, motion, end in zip(runs, reached, motions, ends.tolist(), strict=True):
        if motion.joints is None:
            run.outcome, run.detail = (SUCCESS, "") if run.there else (motion.reason, motion.detail)
            continue
        run.poses.append(target)
        run.joints.append(motion.joints)
        run.there = twists and end == SUCCESS
        run.outcome = "" if run.there else end
