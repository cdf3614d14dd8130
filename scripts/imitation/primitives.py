"""Movement primitives of demonstrated poses, from the package movement_primitives: a DMP of their mean and a ProMP."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.paths import mean_poses, to_count
from koopdqn.pose import Array

PRIMITIVES: Final = ("dmp", "promp")

_SAMPLES: Final = 200
_WEIGHTS: Final = {"dmp": 50, "promp": 30}
# Variance with which a ProMP goes through start and goal: a millimetre, a tenth of a degree.
_SURE: Final = 1e-6

Primitive = Callable[[Array, Array], Array]
"""Gives the poses (T, 7) of a path from a start (7,) to a goal (7,)."""


def learn(name: str, trajectories: Sequence[Array]) -> Primitive:
    """Return the movement primitive of that name, learned from demonstrated poses (N, 7) by their arc length.

    The DMP is one of poses (Ude et al. 2014) of the mean demonstration; the ProMP (Paraschos et al. 2013) is of
    positions and quaternions together, which are normalised afterwards.
    """
    return dmp(trajectories) if name == "dmp" else _promp(trajectories)


def dmp(trajectories: Sequence[Array], obstacle: Array | None = None) -> Primitive:
    """Return the DMP of demonstrated poses (N, 7), led around the center (3,) of an obstacle if there is one.

    The coupling term is that of Ijspeert et al. 2013 with the package's defaults: it knows a point, and turns nothing.
    """
    from movement_primitives.dmp import CartesianDMP, CouplingTermObstacleAvoidance3D

    class Around(CouplingTermObstacleAvoidance3D):  # type: ignore[misc]  # movement_primitives is untyped
        """Leads the position around and leaves the rotation, which the package steps with the same term."""

        def coupling(self, y: Array, yd: Array) -> tuple[Array, Array]:
            if len(y) == pose.QUATERNION.stop - pose.QUATERNION.start:
                return np.zeros(3), np.zeros(3)
            change, acceleration = super().coupling(y, yd)
            return change, acceleration

    times = np.linspace(0.0, 1.0, _SAMPLES)
    made = CartesianDMP(execution_time=1.0, dt=1.0 / (_SAMPLES - 1), n_weights_per_dim=_WEIGHTS["dmp"])
    made.imitate(times, mean_poses(list(trajectories), _SAMPLES))

    def path(start: Array, goal: Array) -> Array:
        made.configure(start_y=start, goal_y=goal)
        return np.asarray(made.open_loop(coupling_term=None if obstacle is None else Around(obstacle))[1])

    return path


def _promp(trajectories: Sequence[Array]) -> Primitive:
    from movement_primitives.promp import ProMP

    times = np.linspace(0.0, 1.0, _SAMPLES)
    mean = mean_poses(list(trajectories), _SAMPLES)
    like_mean = partial(_same_hemisphere, mean)
    promp = ProMP(n_dims=7, n_weights_per_dim=_WEIGHTS["promp"])
    shown = np.array([like_mean(to_count(rows, _SAMPLES)) for rows in trajectories])
    promp.imitate(np.tile(times, (len(shown), 1)), shown)
    sure = _SURE * np.eye(7)

    def path(start: Array, goal: Array) -> Array:
        first, last = _same_hemisphere(mean[0], start), _same_hemisphere(mean[-1], goal)
        through = promp.condition_position(first, y_cov=sure, t=0.0).condition_position(last, y_cov=sure, t=1.0)
        found = np.asarray(through.mean_trajectory(times))
        return pose.make(found[:, pose.POSITION], found[:, pose.QUATERNION])

    return path


def _same_hemisphere(like: Array, poses: Array) -> Array:
    """Return poses (..., 7) with the sign of each quaternion as ``like`` (..., 7) has it: q and −q are one rotation."""
    opposite = (poses[..., pose.QUATERNION] * like[..., pose.QUATERNION]).sum(axis=-1, keepdims=True) < 0
    return pose.make(poses[..., pose.POSITION], np.where(opposite, -1.0, 1.0) * poses[..., pose.QUATERNION])
