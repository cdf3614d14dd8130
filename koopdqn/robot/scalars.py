"""Poses and joint vectors as plain numbers: arithmetic on one pose at a time is fastest without arrays."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from koopdqn.pose import Array

TURN: Final = 2.0 * math.pi
"""A whole turn [rad]."""
_LIMIT_SLACK: Final = 1e-9
"""How far [rad] rounding may push an angle beyond its limit; it is then set onto the limit."""

Six = tuple[float, float, float, float, float, float]
"""Joint angles [rad]."""
Seven = tuple[float, float, float, float, float, float, float]
"""A pose: x, y, z [m] and the unit quaternion w, x, y, z."""


def pose_scalars(pose: ArrayLike) -> Seven:
    """Return the seven numbers of a pose, its quaternion scaled to unit length."""
    array = np.asarray(pose, dtype=float)
    if array.shape != (7,):
        raise ValueError(f"a pose must have shape (7,), found {array.shape}")
    x, y, z, qw, qx, qy, qz = array.tolist()
    length = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    if not (math.isfinite(x + y + z + length) and length > 1e-12):
        raise ValueError(f"a pose must be finite and its quaternion longer than 1e-12, found {array.tolist()}")
    return x, y, z, qw / length, qx / length, qy / length, qz / length


def joint_scalars(joints: ArrayLike) -> Six:
    """Return the six numbers of a joint vector."""
    array = np.asarray(joints, dtype=float)
    if array.shape != (6,):
        raise ValueError(f"joints must have shape (6,), found {array.shape}")
    q1, q2, q3, q4, q5, q6 = array.tolist()
    if not math.isfinite(q1 + q2 + q3 + q4 + q5 + q6):
        raise ValueError(f"joints must be finite, found {array.tolist()} rad")
    return q1, q2, q3, q4, q5, q6


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
    """Return :func:`unwrapped` of joint angles (6, ..., N) [rad] near others that broadcast to them, and where it is.

    The second is False where :func:`unwrapped` gives None; the angle is then one beyond the limits.
    """
    shape = (6,) + (1,) * (angles.ndim - 1)
    low, high = np.reshape(lower, shape), np.reshape(upper, shape)
    angles = angles + TURN * np.rint((near - angles) / TURN)
    angles -= TURN * np.maximum(np.ceil((angles - high - _LIMIT_SLACK) / TURN), 0.0)
    angles += TURN * np.maximum(np.ceil((low - _LIMIT_SLACK - angles) / TURN), 0.0)
    within = (angles >= low - _LIMIT_SLACK) & (angles <= high + _LIMIT_SLACK)
    return np.clip(angles, low, high), within


def residuals(reached: Seven, target: Seven) -> tuple[float, float]:
    """Return the distance [m] and the rotation angle [rad] between two poses, as in :mod:`koopdqn.pose`."""
    _, _, _, aw, ax, ay, az = reached
    _, _, _, bw, bx, by, bz = target
    w = aw * bw + ax * bx + ay * by + az * bz
    x = ax * bw - aw * bx - ay * bz + az * by
    y = ay * bw - aw * by - az * bx + ax * bz
    z = az * bw - aw * bz - ax * by + ay * bx
    return math.dist(reached[:3], target[:3]), 2.0 * math.atan2(math.sqrt(x * x + y * y + z * z), abs(w))
