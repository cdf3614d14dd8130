"""A path of the agent's steps made smooth, every pose within a stated tolerance of where the policy put it."""

from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.errors import WorkFailedError
from koopdqn.pose import Array

# Weight of third differences against distances: left alone it smooths waves of up to some forty steps away.
_PENALTY: Final = 1e6
# Both ends are held by this weight and then set exactly.
_HELD: Final = 1e9
_ROUNDS: Final = 400
# What a pose may use of its tolerance before its weight grows, and the least that its weight then grows by.
_USED, _GROWTH = 0.9, 1.05


def smoothed(poses: Array, tolerance: float, rotation_tolerance: float) -> Array:
    """Return poses (N, 7) smoothed, each within ``tolerance`` [m] and ``rotation_tolerance`` [rad] of its own.

    Positions and rotation vectors z minimise Σ w‖z − y‖² + λ‖Δ³z‖² (Whittaker 1923); the weight w of a pose grows
    until it is within tolerance. The first and the last pose stay.

    Raises:
        WorkFailedError: the tolerance is too small to be reached.
    """
    if len(poses) < 4:
        return poses.copy()
    position = _within(poses[:, pose.POSITION], tolerance, "m")
    # Rotation vectors are smooth as long as no pose is half a turn from the middle one.
    middle = poses[len(poses) // 2, pose.QUATERNION]
    turns = pose.to_rotation_vector(pose.multiply(pose.conjugate(middle), poses[:, pose.QUATERNION]))
    turns = _within(turns, rotation_tolerance, "rad")
    quaternion = pose.multiply(middle, pose.from_rotation_vector(turns))
    sign = np.sign((quaternion * poses[:, pose.QUATERNION]).sum(axis=1, keepdims=True))
    made = pose.make(position, sign * quaternion)
    made[[0, -1]] = poses[[0, -1]]
    return made


def _within(values: Array, tolerance: float, unit: str) -> Array:
    """Return rows (N, 3) smoothed, each within the tolerance of its own."""
    from scipy.linalg import solveh_banded

    count = len(values)
    third = np.diff(np.eye(count), n=3, axis=0)
    bands = np.zeros((4, count))
    for offset in range(4):
        bands[3 - offset, offset:] = _PENALTY * (third[:, : count - offset] * third[:, offset:]).sum(axis=0)
    weights = np.ones(count)
    weights[[0, -1]] = _HELD
    for _ in range(_ROUNDS):
        bands_now = bands.copy()
        bands_now[3] += weights
        # Relative to the first row, so that nothing is lost to the size of the held weights.
        made = values[0] + solveh_banded(bands_now, weights[:, None] * (values - values[0]))
        made[[0, -1]] = values[[0, -1]]
        used = pose.norm(made - values) / tolerance
        if used.max() <= 1.0:
            return np.asarray(made)
        # A tight bend must not be left to one pose alone, so that those near their tolerance are held too.
        weights *= np.where(used > _USED, np.maximum((used / _USED) ** 2, _GROWTH), 1.0)
        weights = np.minimum(weights, _HELD)
    raise WorkFailedError(
        f"the path must be smoothed within {tolerance:g} {unit} of the learned one, found {used.max() * tolerance:g}"
        f" {unit} after {_ROUNDS} rounds: allow more with program.tolerance_m or program.tolerance_rad"
    )
