"""Comparing a reached pose with a wished one: the ``dist`` of Algorithm 1 (Eqs. 15, 16)."""

import numpy as np

from koopdqn import pose
from koopdqn.environment.actions import legal_actions, reached_poses
from koopdqn.pose import Array
from koopdqn.tasks.task import Task


def excess(reached: Array, wished: Array, task: Task) -> Array:
    """Return the larger of the two distances (...), each in units of its tolerance: metres and radians stay apart."""
    position = pose.position_distance(reached, wished) / task.position_tolerance_m
    rotation = pose.rotation_distance(reached, wished) / task.rotation_tolerance_rad
    return np.maximum(position, rotation)


def within_tolerance(reached: Array, wished: Array, task: Task) -> np.ndarray:
    """Return whether both distances are within their tolerances, as booleans (...)."""
    return np.asarray(excess(reached, wished, task) <= 1.0)


def nearest_actions(poses: Array, wished: Array, task: Task) -> np.ndarray:
    """Return the legal actions (N,) that lead from poses (N, 7) nearest to wished poses (N, 7).

    Nearest is by the larger of the two distances in units of their tolerances, as the reward compares.
    """
    far = excess(reached_poses(poses, task), wished[:, None], task)
    return np.asarray(np.where(legal_actions(task), far, np.inf).argmin(axis=1))
