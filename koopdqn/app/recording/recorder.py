"""Recording by keys: what is under way, what is kept, and what each key makes of it."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.app.recording import DemoSettings
from koopdqn.app.recording.playing import play, sample_count
from koopdqn.console import counted
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import WorkFailedError
from koopdqn.paths import arc_lengths, between
from koopdqn.pose import Array
from koopdqn.tasks.task import Task, breaks_rule
from koopdqn.tasks.workcell import Motion, Reachability, Workcell

AXES: Final = {"w": (0, 1.0), "s": (0, -1.0), "a": (1, 1.0), "d": (1, -1.0), "r": (2, 1.0), "f": (2, -1.0)}
"""Axis of the base and sense of each key that moves along one."""
_TURNS: Final = {"i": (0, 1.0), "k": (0, -1.0), "j": (1, 1.0), "l": (1, -1.0), "t": (2, 1.0), "h": (2, -1.0)}
"""Axis of the tool and sense of each key that turns about one."""
_STRAIGHT: Final = "g"
_TOWARD: Final = "o"
MOVES: Final = (*AXES, *_TURNS, _STRAIGHT, _TOWARD)
"""The keys that move the arm."""
_TURNS_PER_ACTION: Final = 2.0
"""How far an action turns on the spot, in rotation tolerances (Table 1's third)."""
_SAME_M: Final = 1e-9
_SAME_RAD: Final = 1e-9


def target(key: str, here: Array, goal: Array, step: float, turn: float) -> Array:
    """Return the pose (7,) to which a key of :data:`MOVES` moves the flange from ``here`` (7,).

    It moves by ``step`` [m] or turns by ``turn`` [rad]; toward the goal (7,) no farther than the goal.
    """
    moved = here.copy()
    if key in AXES:
        axis, sense = AXES[key]
        moved[axis] += sense * step
    elif key == _STRAIGHT:
        moved[pose.POSITION] = pose.moved_toward(here[pose.POSITION], goal[pose.POSITION], step)
    elif key == _TOWARD:
        moved[pose.QUATERNION] = pose.turned_toward(here[pose.QUATERNION], goal[pose.QUATERNION], turn)
    else:
        axis, sense = _TURNS[key]
        about = pose.from_rotation_vector(sense * turn * np.eye(3)[axis])
        moved[pose.QUATERNION] = pose.normalized(pose.multiply(here[pose.QUATERNION], about))
    return moved


def same(a: Array, b: Array) -> bool:
    """Return whether two poses (7,) are equal up to rounding."""
    return bool(pose.position_distance(a, b) < _SAME_M and pose.rotation_distance(a, b) < _SAME_RAD)


def drive(here: Array, there: Array, joints: Array, task: Task, reachability: Reachability) -> Motion:
    """Return the motion of the flange from one pose (7,) straight to another, from joints (6,) [rad].

    The path is checked at every step that the agent would take along it.
    """
    steps = float(pose.position_distance(here, there)) / task.step_m
    turns = float(pose.rotation_distance(here, there)) / (_TURNS_PER_ACTION * task.rotation_tolerance_rad)
    count = max(1, int(np.ceil(max(steps, turns) - 1e-9)))
    motion = Motion(joints)
    for index in range(1, count + 1):
        if motion.joints is not None:
            motion = reachability.move(between(here, there, index / count), motion.joints)
    return motion


_SCALES: Final = (-5, 3)
"""Least and largest power of two by which the step is scaled."""
_LARGEST_TURN: Final = 0.8
"""More [rad] no key turns."""


@dataclass(frozen=True)
class Reply:
    """What a key did, in one line, and whether anything changed."""

    text: str
    changed: bool


@dataclass(frozen=True)
class State:
    """Everything that an undo brings back.

    Attributes:
        start: number of the start that was drawn, from 0.
        path: poses (N, 7) that the keys reached, the start first; the arm is at the last.
        joints: joint angles (N, 6) [rad] there.
        kept: the demonstrations that are done.
    """

    start: int
    path: tuple[Array, ...]
    joints: tuple[Array, ...]
    kept: tuple[Demonstration, ...] = ()

    @property
    def moves(self) -> int:
        """How many moves were made since the start."""
        return len(self.path) - 1


class Recorder:
    """Records demonstrations of one task from keys. The same keys make the same demonstrations."""

    def __init__(self, workcell: Workcell, settings: DemoSettings, seed: int) -> None:
        """Begin at the first drawn start."""
        self._workcell = workcell
        self._settings = settings
        self._seed = seed
        self._scale = 0
        self._earlier: list[State] = []
        self._doubted: State | None = None
        self.state = self._begun(0, ())

    @property
    def task(self) -> Task:
        """The task that is shown."""
        return self._workcell.task

    @property
    def step(self) -> float:
        """How far a key moves now [m]."""
        return float(self._settings.keyboard.step_m * 2.0**self._scale)

    @property
    def turn(self) -> float:
        """How far a key turns now [rad]."""
        return min(float(self._settings.keyboard.turn_rad * 2.0**self._scale), _LARGEST_TURN)

    @property
    def here(self) -> Array:
        """Where the flange is (7,)."""
        return self.state.path[-1]

    @property
    def joints(self) -> Array:
        """Where the joints are (6,) [rad]."""
        return self.state.joints[-1]

    @property
    def length(self) -> float:
        """How long the path under way is [m]."""
        return float(arc_lengths(np.array(self.state.path)[:, pose.POSITION])[-1])

    @property
    def samples(self) -> int:
        """How many samples the path under way has when it is played."""
        return sample_count(np.array(self.state.path), self._settings) if self.state.moves else 1

    @property
    def _moves(self) -> str:
        return counted(self.state.moves, "move")

    def press(self, key: str, *, sure: bool = False) -> Reply:
        """Apply a key and return what it did; ``sure`` keeps an end away from the goal without asking once more."""
        if key in MOVES:
            return self._move(key)
        if key in "+=-_":
            return self._rescale(1 if key in "+=" else -1)
        if key == "e":
            return self._mark_end(sure=sure)
        others = {"u": self._undo, "b": self._mark_start, "x": self._discard, "n": self._renew}
        if key not in others:
            return Reply(f"{key!r} is no key here; ? lists them", changed=False)
        return others[key]()

    def _move(self, key: str) -> Reply:
        there = target(key, self.here, self.task.goal, self.step, self.turn)
        if same(self.here, there):
            return Reply("Nothing to move: that is as the goal has it already", changed=False)
        motion = drive(self.here, there, self.joints, self.task, self._workcell.reachability)
        if motion.joints is None:
            return Reply(f"Refused: {motion.reason.replace('_', ' ')}: {motion.detail}", changed=False)
        state = replace(
            self.state, path=(*self.state.path, there), joints=(*self.state.joints, np.array(motion.joints))
        )
        return self._become(state, "")

    def _rescale(self, by: int) -> Reply:
        scale = int(np.clip(self._scale + by, *_SCALES))
        changed, self._scale = scale != self._scale, scale
        limit = "" if changed else ", the limit"
        return Reply(f"A key moves {self.step * 1e3:.4g} mm and turns {np.degrees(self.turn):.3g}°{limit}", changed)

    def _undo(self) -> Reply:
        if not self._earlier:
            return Reply("Nothing is left to undo", changed=False)
        taken_back = len(self._earlier[-1].kept) < len(self.state.kept)
        self.state = self._earlier.pop()
        text = "The demonstration kept last is under way again" if taken_back else "Undone"
        return Reply(f"{text}; {self._moves} recorded", changed=True)

    def _mark_start(self) -> Reply:
        if not self.state.moves:
            return Reply("The start is here already", changed=False)
        state = replace(self.state, path=self.state.path[-1:], joints=self.state.joints[-1:])
        return self._become(state, f"The start is here; {self._moves} dropped (u brings them back)")

    def _discard(self) -> Reply:
        state = self._begun(self.state.start, self.state.kept)
        if not self.state.moves and same(self.here, state.path[0]):
            return Reply("Nothing to discard", changed=False)
        return self._become(state, f"Discarded: {self._moves}; back at the start (u brings them back)")

    def _renew(self) -> Reply:
        state = self._begun(self.state.start + 1, self.state.kept)
        return self._become(state, f"New start; {self._moves} dropped (u brings them back)")

    def _mark_end(self, *, sure: bool) -> Reply:
        task, state = self.task, self.state
        if self.length < task.step_m:
            least = f"at least one step of {task.step_m * 1e3:g} mm"
            return Reply(f"Not kept: a path must be {least} long, found {self.length * 1e3:.2g} mm", changed=False)
        if not sure and not task.reached(self.here[None])[0] and self._doubted is not state:
            self._doubted = state
            return Reply(f"{self.off_goal()}; e again keeps it", changed=False)
        try:
            item, reason = play(np.array(state.path), state.joints[0], self._settings, self._workcell.reachability)
        except WorkFailedError as error:
            return Reply(f"Not kept: the arm cannot follow at {self._settings.speed_m_s:g} m/s: {error}", changed=False)
        text = f"Kept: demonstration {len(state.kept)}, {len(item)} samples, {item.times[-1]:.1f} s"
        if reason:
            text += f"; rounded off less: {reason}"
        if breaks_rule(task, item.poses).any():
            text += f"; it breaks the rule: {task.rule}"
        return self._become(self._begun(state.start + 1, (*state.kept, item)), f"{text}; a new start")

    def off_goal(self) -> str:
        """Return in one line how far the goal is, and within what distance ``fit`` and ``train`` accept it."""
        task = self.task
        apart = float(pose.position_distance(self.here, task.goal)) * 1e3
        turned = np.degrees(float(pose.rotation_distance(self.here, task.goal)))
        within = f"{task.goal_tolerance_m * 1e3:g} mm, {np.degrees(task.goal_rotation_tolerance_rad):.2g}°"
        return f"{apart:.1f} mm, {turned:.1f}° off the goal: fit and train refuse over {within}"

    def _become(self, state: State, text: str) -> Reply:
        self._earlier.append(self.state)
        self.state = state
        return Reply(text, changed=True)

    def _begun(self, start: int, kept: tuple[Demonstration, ...]) -> State:
        # Each start has a stream of its own, whatever was drawn before.
        rng = np.random.default_rng([self._seed, 1, start])
        poses, joints, _ = self._workcell.reachability.draw_starts(self.task, rng, 1, demonstrated=True)
        return State(start, (poses[0],), (joints[0],), kept)
