"""Smoothing a recording, so that resampling it to millimetre steps follows the motion and not the sensor."""

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.pose import Array

MOST_SAMPLES = 1000
"""A longer recording is first averaged over runs of samples, down to about so many."""
_FEWEST_SAMPLES = 10
# A component that varies less than this is constant as far as its sensor can tell [m, 1].
_CONSTANT = 1e-6
# Logarithms of the penalties λ looked among: from none to what leaves waves of some hundred samples.
_LOG_PENALTIES = (-12.0, 18.0)


def smoothed(item: Demonstration) -> Demonstration:
    """Return a demonstration whose sensor noise is smoothed out.

    Each component of position and quaternion is the minimiser of ‖y − z‖² + λ‖Δ²z‖² (Whittaker 1923), with the λ that
    generalised cross-validation chooses (Craven & Wahba 1979): from a recording without noise that is the recording
    itself, and noise is taken out as far as it can be told from the motion. Fewer than 10 samples stay
    as they are. Joint angles, which would no longer belong to the poses, are left out.
    """
    times, poses = _thinned(item.times, item.poses)
    if len(times) < _FEWEST_SAMPLES:
        return item
    values = np.stack([_even(poses[:, i]) for i in range(poses.shape[1])], axis=1)
    return Demonstration(times, pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION]))


def _even(values: Array) -> Array:
    from scipy.linalg import solveh_banded
    from scipy.optimize import minimize_scalar

    if np.ptp(values) < _CONSTANT:
        return values
    count = len(values)
    # Δ²ᵀΔ², whose upper diagonals are its convolution kernel but for the ends.
    second = np.zeros((3, count))
    for offset, product in ((0, (1.0, 4.0, 1.0)), (1, (-2.0, -2.0)), (2, (1.0,))):
        for shift, value in enumerate(product):
            second[2 - offset, offset + shift : count - len(product) + 1 + shift] += value
    # Their eigenvalues are near those with mirrored ends, which cosines give (Garcia 2010).
    roughness = (2.0 - 2.0 * np.cos(np.pi * np.arange(count) / count)) ** 2

    def even(log_penalty: float) -> Array:
        bands = np.exp(log_penalty) * second
        bands[2] += 1.0
        return np.asarray(solveh_banded(bands, values))

    def score(log_penalty: float) -> float:
        penalty = np.exp(log_penalty)
        lost = float((penalty * roughness / (1.0 + penalty * roughness)).sum())
        return float(((values - even(log_penalty)) ** 2).sum()) / lost**2

    return even(float(minimize_scalar(score, bounds=_LOG_PENALTIES, method="bounded").x))


def _thinned(times: Array, poses: Array) -> tuple[Array, Array]:
    """Return times (M,) and poses (M, 7) averaged over equal runs of samples; first and last sample stay."""
    run = -(-len(times) // MOST_SAMPLES)
    if run == 1:
        return times, poses
    begins = np.arange(1, len(times) - 1, run)
    counts = np.diff([*begins, len(times) - 1])
    inner = [np.add.reduceat(values[:-1], begins, axis=0) for values in (times[:, None], poses)]
    mean_times, mean_poses = (values / counts[:, None] for values in inner)
    return (
        np.concatenate([times[:1], mean_times[:, 0], times[-1:]]),
        np.concatenate([poses[:1], mean_poses, poses[-1:]]),
    )
