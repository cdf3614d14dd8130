"""What the keys that move the arm do."""

from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.resample import between
from koopdqn.environment.reachability import Motion, Reachability
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

_AXES: Final = {"w": (0, 1.0), "s": (0, -1.0), "a": (1, 1.0), "d": (1, -1.0), "r": (2, 1.0), "f": (2, -1.0)}
"""Axis of the base and sense of each key that moves along one."""
_TURNS: Final = {"i": (0, 1.0), "k": (0, -1.0), "j": (1, 1.0), "l": (1, -1.0), "t": (2, 1.0), "h": (2, -1.0)}
"""Axis of the tool and sense of each key that turns about one."""
_STRAIGHT: Final = "g"
_TOWARD: Final = "o"
MOVES: Final = (*_AXES, *_TURNS, _STRAIGHT, _TOWARD)
"""The keys that move the arm."""
_TURNS_PER_ACTION: Final = 2.0
"""How far an action turns on the spot, in rotation tolerances (Table 1's third)."""
_SAME_M: Final = 1e-9
_SAME_RAD: Final = 1e-9


def target(key: str, here: Array, goal: Array, step: float, turn: float) -> Array:
    """Return the pose (7,) to which a key of :data:`MOVES` moves the flange.

    Args:
        key: which one.
        here: the flange's pose (7,).
        goal: the task's goal (7,).
        step: how far a key moves [m]; straight at the goal no farther than the goal.
        turn: how far a key turns [rad]; toward the goal's orientation no farther than that.
    """
    moved = here.copy()
    if key in _AXES:
        axis, sense = _AXES[key]
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
    """Return whether two poses (7,) are one."""
    return bool(pose.position_distance(a, b) < _SAME_M and pose.rotation_distance(a, b) < _SAME_RAD)


def driven(here: Array, there: Array, joints: Array, task: Task, reachability: Reachability) -> Motion:
    """Return what becomes of moving the flange from one pose (7,) straight to another, from joints (6,) [rad].

    The way is tested at every step that an action of the agent would make of it.
    """
    steps = float(pose.position_distance(here, there)) / task.step_m
    turns = float(pose.rotation_distance(here, there)) / (_TURNS_PER_ACTION * task.rotation_tolerance_rad)
    count = max(1, int(np.ceil(max(steps, turns) - 1e-9)))
    motion = Motion(joints)
    for index in range(1, count + 1):
        if motion.joints is not None:
            motion = reachability.move(between(here, there, index / count), motion.joints)
    return motion
