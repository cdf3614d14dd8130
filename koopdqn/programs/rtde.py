"""A program as the CSV of Universal Robots' RTDE client: names of the controller's fields, separated by blanks."""

from pathlib import Path
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import continuous
from koopdqn.files import write_text
from koopdqn.pose import Array
from koopdqn.programs.program import Program

FIELDS: Final = ("target_q", "target_qd", "target_qdd", "target_TCP_pose")
"""Vectors of six: joint angles [rad], speeds [rad/s], accelerations [rad/s²]; x y z [m] and rotation vector [rad]."""


def write_rtde(path: Path, program: Program) -> None:
    """Write one sample a row: ``timestamp`` [s], then :data:`FIELDS`; the tool is the flange."""
    motion = program.motion
    header = ["timestamp", *(f"{name}_{index}" for name in FIELDS for index in range(6))]
    tool = np.hstack([motion.poses[:, pose.POSITION], rotation_vectors(motion.poses[:, pose.QUATERNION])])
    rows = np.hstack([motion.times[:, None], motion.joints, motion.velocities, motion.accelerations, tool])
    lines = [" ".join(header), *(" ".join(f"{value:.10f}" for value in row) for row in rows)]
    write_text(path, "\n".join([*lines, ""]))


def rotation_vectors(quaternions: Array) -> Array:
    """Return rotation vectors (N, 3) [rad] of quaternions (N, 4) that do not jump where a turn passes half a turn."""
    turned = continuous(quaternions)
    sine = pose.norm(turned[:, 1:], keepdims=True)
    angle = 2.0 * np.arctan2(sine, turned[:, :1])
    return np.asarray(turned[:, 1:] * np.where(sine < 1e-8, 2.0, angle / np.maximum(sine, 1e-8)))
