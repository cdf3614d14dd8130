"""A person's law: from any pose, where the person would be one step later."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.shown_path import ShownPath
from koopdqn.tasks.step import one_step

Aim = Callable[[ShownPath, Array, Array, float], Array]
"""Returns the positions (N, 3) [m] that a person heads for: from the path meant, the positions (N, 3) [m] now, the arc
lengths (N,) [m] of the places that they go on from, and the step [m]."""

# Nearer to the goal than this [m, rad] a law has come to rest; it is far under any tolerance.
_REST = 1e-6
# Places of a path count as about as near up to this share of a step.
_AS_NEAR = 0.25


@dataclass(frozen=True)
class Law:
    """What answers for the person: the scripted oracle, agreement figures and references all ask it.

    It depends on the pose alone and knows nothing of the Koopman model. Each step goes straight to where the person
    aims, and turns as the path does a step ahead, scaled to what the ten actions can make.

    Attributes:
        path: the path that the person means; it ends at the goal.
        aim: where the person heads for.
        goal: pose (7,) at which it comes to rest.
        step: distance of one step [m].
        turn: turn of one step in place [rad]; 0 where the goal's orientation is held.
    """

    path: ShownPath
    aim: Aim
    goal: Array
    step: float
    turn: float

    def next_pose(self, poses: Array) -> Array:
        """Return where the person would be after one step from poses (N, 7), as poses (N, 7)."""
        position = poses[:, pose.POSITION]
        arc = self.path.nearest(position, _AS_NEAR * self.step)
        way = self.aim(self.path, position, arc, self.step) - position
        direction = way / np.maximum(np.linalg.norm(way, axis=1), 1e-12)[:, None]
        moved = position + np.minimum(self.step, pose.position_distance(poses, self.goal))[:, None] * direction
        if not self.turn:
            return pose.make(moved, np.tile(self.goal[pose.QUATERNION], (len(poses), 1)))
        wished = pose.make(moved, self.path.turned_at(arc + self.step))
        return one_step(poses, wished, self.goal, self.step, self.turn)

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) of the law from a start (7,) until the goal, at most ``limit`` steps."""
        poses = [start]
        for _ in range(limit):
            reached = self.next_pose(poses[-1][None])[0]
            poses.append(reached)
            left = pose.position_distance(reached, self.goal), pose.rotation_distance(reached, self.goal)
            if max(left) < _REST:
                break
        return np.array(poses)
