"""A program for Universal Robots' controllers: in URScript, their language, and as the CSV of their RTDE client."""

from pathlib import Path
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import continuous
from koopdqn.files import write_text
from koopdqn.paths import between
from koopdqn.pose import Array
from koopdqn.programs.program import Program
from koopdqn.programs.settings import GAIN, LOOKAHEAD_S
from koopdqn.programs.timing import steady

# The controller's own defaults for the move to the start [rad/s², rad/s].
_TO_START: Final = "a=1.4, v=0.5"
_STOP: Final = 2.0
# Most that the straight lines of movep leave the path; their blends leave it on the other side.
_OFF_M: Final = 0.0003
_OFF_RAD: Final = 0.001


MOVEP_UNCHECKED: Final = "movep           is timed by the controller: samples are checked, not its own motion"
"""What whoever exports a ``movep`` is told."""


def write_servoj(path: Path, program: Program) -> None:
    """Write ``movej`` to the first sample and one ``servoj`` a sample, joint angles in radians.

    The last is repeated for the time by which the arm follows behind, so that it is reached before the arm is stopped.
    """
    period, joints = program.motion.period, program.motion.joints
    held = np.repeat(joints[-1:], int(np.ceil(LOOKAHEAD_S / period)), axis=0)
    lines = [
        f"movej({_list(joints[0])}, {_TO_START})",
        *(
            f"servoj({_list(row)}, t={period:g}, lookahead_time={LOOKAHEAD_S:g}, gain={GAIN})"
            for row in np.concatenate([joints[1:], held])
        ),
        f"stopj({_STOP:g})",
    ]
    _write(path, program, lines)


def write_movep(path: Path, program: Program) -> None:
    """Write ``movej`` to the first sample and ``movep`` along straight lines with blends of at most half a line.

    The active TCP becomes the flange, whose poses these are, and stays it.
    The speed is the largest that keeps the joint limits everywhere on the path.

    Raises:
        WorkFailedError: the path turns in place, where a tool speed says nothing.
    """
    speed, acceleration = steady(program.followed, program.arm.forward, program.limits)
    corners = program.smooth[corners_of(program.smooth)]
    blends = np.append(_blends(corners[:, pose.POSITION]), 0.0)
    places = np.hstack([corners[1:, pose.POSITION], rotation_vectors(corners[1:, pose.QUATERNION])])
    lines = [
        # Poses are of the flange, and movep leads the active TCP along them.
        "set_tcp(p[0, 0, 0, 0, 0, 0])",
        f"movej({_list(program.motion.joints[0])}, {_TO_START})",
        *(
            f"movep(p{_list(place)}, a={acceleration:.6f}, v={speed:.6f}, r={np.floor(blend * 1e7) / 1e7:.7f})"
            for place, blend in zip(places, blends, strict=True)
        ),
    ]
    told = "# The controller times movep by itself: what was checked are samples along its path, not its own motion."
    _write(path, program, lines, told)


def _blends(corners: Array) -> Array:
    """Return the radii [m] of blends at the inner corners of a polyline (M, 3): half a line, less at sharp corners."""
    lines = np.diff(corners, axis=0)
    lengths = pose.norm(lines)
    half = 0.5 * np.minimum(lengths[1:], lengths[:-1])
    cosine = (lines[1:] * lines[:-1]).sum(axis=1) / (lengths[1:] * lengths[:-1])
    # An arc that touches both lines passes the corner at radius · tan(turn / 4).
    depth = np.tan(0.25 * np.arccos(cosine.clip(-1.0, 1.0)))
    return np.asarray(np.minimum(half, _OFF_M / np.maximum(depth, 1e-9)))


def corners_of(poses: Array) -> list[int]:
    """Return the rows of a path (N, 7) whose polyline stays near it (Douglas & Peucker 1973)."""
    kept, parts = {0, len(poses) - 1}, [(0, len(poses) - 1)]
    while parts:
        first, last = parts.pop()
        if last - first < 2:
            continue
        inner = poses[first + 1 : last]
        way = poses[last, pose.POSITION] - poses[first, pose.POSITION]
        share = ((inner[:, pose.POSITION] - poses[first, pose.POSITION]) @ way) / max(float(way @ way), 1e-18)
        share = share.clip(0.0, 1.0)
        line = between(poses[first], poses[last], share)
        off = np.maximum(pose.position_distance(line, inner) / _OFF_M, pose.rotation_distance(line, inner) / _OFF_RAD)
        if off.max() > 1.0:
            middle = first + 1 + int(off.argmax())
            kept.add(middle)
            parts += [(first, middle), (middle, last)]
    return sorted(kept)


def _list(values: Array) -> str:
    return "[" + ", ".join(f"{value:.10f}" for value in values) + "]"


def _write(path: Path, program: Program, lines: list[str], *told: str) -> None:
    start = pose.to_rotation_vector(program.motion.poses[0, pose.QUATERNION])
    head = [
        f"# Task {program.task} for {program.arm.name}: {program.motion.times[-1]:.3f} s. Made by koopdqn.",
        "# Checked in simulation from the first sample on; the movej to it is not checked.",
        *told,
        f"# It starts with the flange at {np.round(program.motion.poses[0, pose.POSITION], 6).tolist()} m,"
        f" rotation vector {np.round(start, 6).tolist()} rad, in Base.",
        f"def koopdqn_{program.task}():",
    ]
    write_text(path, "\n".join([*head, *(f"  {line}" for line in lines), "end", f"koopdqn_{program.task}()", ""]))


FIELDS: Final = ("target_q", "target_qd", "target_qdd", "target_TCP_pose")
"""Vectors of six: joint angles [rad], speeds [rad/s], accelerations [rad/s²]; x y z [m] and rotation vector [rad]."""


def write_rtde(path: Path, program: Program) -> None:
    """Write one sample a row, separated by blanks: ``timestamp`` [s], then :data:`FIELDS`; the tool is the flange."""
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
