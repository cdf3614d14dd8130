"""A person's law: from any pose, where the person would be one step later."""

from typing import Protocol, runtime_checkable

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array

# Nearer to the goal than this [m, rad] a law has come to rest; it is far under any tolerance.
_REST = 1e-6


@runtime_checkable
class Law(Protocol):
    """What answers for the person: the scripted oracle, agreement figures and references all ask it.

    Attributes:
        goal: pose (7,) at which it comes to rest.
    """

    @property
    def goal(self) -> Array:
        """The pose (7,) at the end."""

    def next_pose(self, poses: Array) -> Array:
        """Return where the person would be after one step from poses (N, 7), as poses (N, 7)."""

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) of the law from a start (7,) until the goal, at most ``limit`` steps."""


def roll_out(law: Law, start: Array, limit: int) -> Array:
    """Return the poses (T, 7) of a law from a start (7,) until its goal, at most ``limit`` steps."""
    poses = [start]
    for _ in range(limit):
        reached = law.next_pose(poses[-1][None])[0]
        poses.append(reached)
        if max(pose.position_distance(reached, law.goal), pose.rotation_distance(reached, law.goal)) < _REST:
            break
    return np.array(poses)
