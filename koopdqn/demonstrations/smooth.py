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


def smoothed(item: Demonstration) -> Demonstration:
    """Return a demonstration whose poses lie on smoothing splines over time.

    Each component of position and quaternion gets the cubic smoothing spline that generalised cross-validation
    chooses (:func:`scipy.interpolate.make_smoothing_spline`): from a recording without noise that is the recording
    itself, and noise is taken out as far as it can be told from the motion. Fewer than 10 samples stay as they are.
    Joint angles, which would no longer belong to the poses, are left out.
    """
    times, poses = _thinned(item.times, item.poses)
    if len(times) < _FEWEST_SAMPLES:
        return item
    # In units of the usual interval, at which the spline's equations are well scaled.
    parameter = (times - times[0]) / float(np.median(np.diff(times)))
    values = np.stack([_spline(parameter, poses[:, i]) for i in range(poses.shape[1])], axis=1)
    return Demonstration(times, pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION]))


def _spline(parameter: Array, values: Array) -> Array:
    from scipy.interpolate import make_smoothing_spline

    if np.ptp(values) < _CONSTANT:
        return values
    return np.asarray(make_smoothing_spline(parameter, values)(parameter))


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
