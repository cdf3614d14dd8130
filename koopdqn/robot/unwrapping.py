"""Whole turns: joint angles brought within their limits, nearest to where the joints are."""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from koopdqn.pose import Array

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
