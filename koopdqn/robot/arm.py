"""What an arm is for the rest of the program: its names, its limits and its kinematics; whole turns of its joints."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from koopdqn.pose import Array


@dataclass(frozen=True, slots=True)
class InverseResult:
    """The answer of an inverse kinematics call; check ``success`` before using ``joints``.

    Attributes:
        joints: joint angles (n,) [rad], read-only: the solution, or the seed as given if there is none.
        success: whether ``joints`` reach the pose within the joint limits.
        reason: empty on success, otherwise a sentence that names the quantity, the rule and the value.
    """

    joints: Array
    success: bool
    reason: str


@runtime_checkable
class Arm(Protocol):
    """An arm of n joints, six or more. Poses are of the flange in the arm's base frame, as in :mod:`koopdqn.pose`."""

    @property
    def name(self) -> str:
        """Name of the arm, for people."""

    @property
    def asset(self) -> str:
        """Name of the arm's MJCF file, for people."""

    @property
    def mjcf(self) -> Path:
        """Path of the arm's MJCF file."""

    @property
    def joint_names(self) -> Sequence[str]:
        """Names (n,) of the joints in the MJCF file, from the base outward; its actuators bear the same names."""

    @property
    def flange_site(self) -> str:
        """Name of the MJCF site whose frame is the flange."""

    @property
    def joint_lower(self) -> Sequence[float]:
        """Lower joint limits (n,) [rad]."""

    @property
    def joint_upper(self) -> Sequence[float]:
        """Upper joint limits (n,) [rad]."""

    @property
    def velocity_limits(self) -> Sequence[float]:
        """Largest joint speeds (n,) [rad/s]."""

    @property
    def torque_limits(self) -> Sequence[float]:
        """Largest joint torques (n,) [Nm]."""

    @property
    def step_seconds(self) -> float:
        """How long one step of the agent takes [s]; gives every speed."""

    @property
    def task_scale(self) -> float:
        """Size of this arm beside a UR5, for which tasks are made; they scale by it.

        :meth:`koopdqn.tasks.task.Task.scaled` does so.
        """

    @property
    def home(self) -> Sequence[float]:
        """Joint angles (n,) [rad] of the resting pose."""

    def forward(self, joints: ArrayLike) -> Array:
        """Return the flange poses (..., 7) of joint angles (..., n) [rad]."""

    def inverse(self, pose: ArrayLike, seed: ArrayLike) -> InverseResult:
        """Return the joint angles nearest ``seed`` (n,) [rad] that bring the flange to ``pose`` (7,)."""

    def inverse_batch(self, poses: ArrayLike, seeds: ArrayLike) -> Array:
        """Return the joint angles (N, n) that :meth:`inverse` finds for poses (N, 7) from seeds (N, n).

        Rows are NaN where it has no success.
        """

    def solutions(self, pose: ArrayLike, seed: ArrayLike | None = None) -> Array:
        """Return all solutions (k, n) [rad] for ``pose`` (7,), unwrapped to lie nearest ``seed`` (home if None).

        The nearest to it comes first, by the largest difference of a joint.
        """


def check_limits(arm: Arm) -> None:
    """Raise ValueError if a joint's range is empty or without home, or a speed or torque limit is not above 0."""
    limits = arm.joint_lower, arm.joint_upper, arm.home, arm.velocity_limits, arm.torque_limits
    for name, low, high, home, speed, torque in zip(arm.joint_names, *limits, strict=True):
        if not low < high:
            raise ValueError(f"joint_lower: must be below joint_upper for {name}, found {low} and {high} rad")
        if not low <= home <= high:
            raise ValueError(f"home: must lie within {low}…{high} rad for {name}, found {home}")
        if speed <= 0.0:
            raise ValueError(f"velocity_limits: must be above 0 rad/s for {name}, found {speed}")
        if torque <= 0.0:
            raise ValueError(f"torque_limits: must be above 0 Nm for {name}, found {torque:g}")


TURN: Final = 2.0 * math.pi
"""A whole turn [rad]."""
_LIMIT_SLACK: Final = 1e-9
"""How far [rad] rounding may push an angle beyond its limit; it is then set onto the limit."""


def unwrapped(angle: float, near: float, lower: float, upper: float) -> float | None:
    """Return ``angle``, whole turns added, within the limits and nearest ``near``, or None where that is impossible."""
    angle += TURN * round((near - angle) / TURN)
    if angle > upper + _LIMIT_SLACK:
        angle -= TURN * math.ceil((angle - upper - _LIMIT_SLACK) / TURN)
    elif angle < lower - _LIMIT_SLACK:
        angle += TURN * math.ceil((lower - _LIMIT_SLACK - angle) / TURN)
    if not lower - _LIMIT_SLACK <= angle <= upper + _LIMIT_SLACK:
        return None
    return min(max(angle, lower), upper)


def unwrapped_batch(
    angles: Array, near: Array, lower: Sequence[float], upper: Sequence[float]
) -> tuple[Array, np.ndarray]:
    """Return :func:`unwrapped` of joint angles (n, ..., N) [rad] near others that broadcast to them, and where it is.

    The second is False where :func:`unwrapped` gives None; the angle is then one beyond the limits.
    """
    shape = (len(lower),) + (1,) * (angles.ndim - 1)
    low, high = np.reshape(lower, shape), np.reshape(upper, shape)
    angles = angles + TURN * np.rint((near - angles) / TURN)
    angles -= TURN * np.maximum(np.ceil((angles - high - _LIMIT_SLACK) / TURN), 0.0)
    angles += TURN * np.maximum(np.ceil((low - _LIMIT_SLACK - angles) / TURN), 0.0)
    within = (angles >= low - _LIMIT_SLACK) & (angles <= high + _LIMIT_SLACK)
    return np.clip(angles, low, high), within
