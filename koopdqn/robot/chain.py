"""A chain of hinges: forward kinematics, the inverse by damped least squares, and in closed form where there is one."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array

CLOSE_M: Final = 1e-8
CLOSE_RAD: Final = 1e-8
"""What an inverse may be off; the damped steps converge quadratically, so that it mostly is far less."""
_ITERATIONS: Final = 25
_DAMPING: Final = 0.5
"""Of the squared error, as the damping of a step (Sugihara, IEEE Trans. Robotics 27(5), 2011, Eq. 38)."""
_LEAST_DAMPING: Final = 1e-12
_RESTARTS: Final = 8
_PULL_RAD: Final = 0.02
"""Most that a joint at its limit is drawn to the middle of its range, where others can make up for it."""
_STRAIGHT: Final = 1e-12
"""Sine of a turn below which it has no direction."""


@dataclass(frozen=True)
class Chain:
    """Hinges one after the other, from the base to the flange, in the base's frame at joint angles of zero.

    Attributes:
        anchors: a point (n, 3) [m] on the axis of each hinge.
        axes: unit vectors (n, 3) along them.
        tip: pose (7,) of the flange.
        lower: lower joint limits (n,) [rad].
        upper: upper joint limits (n,) [rad].
    """

    anchors: Array
    axes: Array
    tip: Array
    lower: Array
    upper: Array

    def forward(self, joints: Array) -> Array:
        """Return the flange's poses (..., 7) at joint angles (..., n) [rad]: the product of exponentials."""
        rows = joints.reshape(-1, len(self.axes))
        position, rotation, _, _ = self._turned(rows)
        return pose.make(position, pose.from_matrix(rotation)).reshape(*joints.shape[:-1], 7)

    def inverse(self, poses: Array, seeds: Array) -> Array:
        """Return joint angles (N, n) [rad] within the limits at poses (N, 7), reached from seeds (N, n); else NaN.

        Each step is J'(J J' + w)⁻¹ e with the pose's error e in m and rad and a damping w that vanishes with it, cut to
        the limits; joints at a limit leave the rest to the others. Of more than six joints those near their limits
        are drawn away a little first, as far as the others can make up for it; else the arm stays near the seed.
        """
        matrices = pose.to_matrix(pose.normalized(poses[:, pose.QUATERNION]))
        joints, done = np.clip(seeds, self.lower, self.upper), np.zeros(len(poses), dtype=bool)
        rows = np.arange(len(poses))
        for iteration in range(_ITERATIONS):
            position, rotation, anchors, axes = self._turned(joints[rows])
            off = poses[rows, :3] - position
            turn = _rotation_vectors(matrices[rows] @ rotation.transpose(0, 2, 1))
            close = (pose.norm(off) <= CLOSE_M) & (pose.norm(turn) <= CLOSE_RAD)
            done[rows[close]] = True
            rows, off, turn = rows[~close], off[~close], turn[~close]
            if not len(rows):
                break
            anchors, axes = anchors[~close], axes[~close]
            levers = np.cross(axes, position[~close, None] - anchors)
            transposed = np.concatenate([levers, axes], axis=2)
            error = np.concatenate([off, turn], axis=1)
            step, here = _step(transposed, error), joints[rows]
            if iteration == 0 and joints.shape[1] > 6:
                middle, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
                pull = _PULL_RAD * (middle - here) / half
                step += pull - _step(transposed, (pull[:, None] @ transposed)[:, 0])
            stuck = ((here <= self.lower) & (step < 0.0)) | ((here >= self.upper) & (step > 0.0))
            if stuck.any():
                step = _step(np.where(stuck[..., None], 0.0, transposed), error)
            joints[rows] = np.clip(here + step, self.lower, self.upper)
        return np.where(done[:, None], joints, np.nan)

    @cached_property
    def restarts(self) -> Array:
        """Joint angles (8, n) [rad] from all over the ranges, the same ones always."""
        lower, upper = np.maximum(self.lower, -np.pi), np.minimum(self.upper, np.pi)
        return np.random.default_rng(0).uniform(lower, upper, (_RESTARTS, len(lower)))

    def _turned(self, joints: Array) -> tuple[Array, Array, Array, Array]:
        """Return position (N, 3) and rotation (N, 3, 3) of the flange, anchors (N, n, 3) and axes (N, n, 3) there."""
        count = len(joints)
        turns = _turns(self.axes, joints)
        anchors, axes = np.empty((2, count, len(self.axes), 3))
        rotation, moved = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3))
        for index, (anchor, axis) in enumerate(zip(self.anchors, self.axes, strict=True)):
            axes[:, index] = rotation @ axis
            anchors[:, index] = rotation @ anchor + moved
            rotation = rotation @ turns[:, index]
            moved = anchors[:, index] - rotation @ anchor
        tip = self.tip[pose.POSITION]
        return rotation @ tip + moved, rotation @ self._tip_matrix, anchors, axes

    @cached_property
    def _tip_matrix(self) -> Array:
        return pose.to_matrix(self.tip[pose.QUATERNION])


def _step(transposed: Array, error: Array) -> Array:
    """Return the damped steps (N, n) [rad] by Jacobians, transposed (N, n, 6), that mend errors (N, 6)."""
    weight = _DAMPING * (error * error).sum(axis=1) + _LEAST_DAMPING
    squared = transposed.transpose(0, 2, 1) @ transposed + weight[:, None, None] * np.eye(6)
    return np.asarray((transposed @ np.linalg.solve(squared, error[..., None]))[..., 0])


def _turns(axes: Array, angles: Array) -> Array:
    """Return the rotations (N, n, 3, 3) about axes (n, 3) by angles (N, n) [rad] (Rodrigues)."""
    x, y, z = axes.T
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    sine, versine = np.sin(angles)[..., None, None], (1.0 - np.cos(angles))[..., None, None]
    return np.asarray(np.eye(3) + sine * skew + versine * (skew @ skew))


def _rotation_vectors(matrices: Array) -> Array:
    """Return the rotation vectors (N, 3) [rad] of rotation matrices (N, 3, 3); of a half turn any direction of it."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrices.reshape(-1, 9).T
    axis = 0.5 * np.stack([zy - yz, xz - zx, yx - xy], axis=1)
    sine, cosine = pose.norm(axis), 0.5 * (xx + yy + zz - 1.0)
    straight = sine < _STRAIGHT
    vectors = axis * np.where(straight, 1.0, np.arctan2(sine, cosine) / np.where(straight, 1.0, sine))[:, None]
    vectors[straight & (cosine < 0.0)] = (np.pi, 0.0, 0.0)
    return np.asarray(vectors)


_JOINTS = 6


class ClosedForm:
    """The inverse of a chain of six hinges by subproblem decomposition, as EAIK does (Ostermeier, Külz & Althoff 2024).

    It knows arms with a spherical wrist, or with parallel or intersecting axes.
    """

    def __init__(self, chain: Chain) -> None:
        """Find the decomposition.

        Raises:
            ValueError: there is none, or EAIK is not installed.
        """
        try:
            from eaik.IK_HP import HPRobot
        except ImportError as error:
            raise ValueError(
                "kinematics: analytic needs EAIK, found it not installed: pip install 'koopdqn[analytic]'"
            ) from error
        places = np.vstack([np.zeros(3), chain.anchors, chain.tip[pose.POSITION]])
        robot: Any = HPRobot(chain.axes, np.diff(places, axis=0)) if len(chain.axes) == _JOINTS else None
        if robot is None or not robot.hasKnownDecomposition():
            raise ValueError("kinematics: must be numeric, as EAIK knows no closed form of this arm, found 'analytic'")
        self._robot = robot
        self._back = pose.to_matrix(chain.tip[pose.QUATERNION]).T

    def solutions(self, targets: Array) -> Array:
        """Return solutions (S, N, 6) [rad] of poses (N, 7), not unwrapped; NaN where a pose has fewer than S."""
        matrices = np.tile(np.eye(4), (len(targets), 1, 1))
        matrices[:, :3, :3] = pose.to_matrix(pose.normalized(targets[:, pose.QUATERNION])) @ self._back
        matrices[:, :3, 3] = targets[:, pose.POSITION]
        # EAIK also returns the nearest that can be done where nothing reaches the pose.
        exact = [
            np.reshape(found.Q, (-1, _JOINTS))[~np.array(found.is_LS, dtype=bool)]
            for found in self._robot.IK_batched(matrices, 1)
        ]
        result = np.full((max(map(len, exact), default=1) or 1, len(targets), _JOINTS), np.nan)
        for row, angles in enumerate(exact):
            result[: len(angles), row] = angles
        return result
