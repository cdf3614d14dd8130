"""Comparing a reached pose with a wished one: the ``dist`` of Algorithm 1 (Eqs. 15, 16)."""

import numpy as np

from koopdqn import pose
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
