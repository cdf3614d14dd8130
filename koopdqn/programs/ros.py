"""A program as a ROS 2 ``trajectory_msgs/JointTrajectory``, in YAML and in JSON."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn.files import write_text
from koopdqn.programs.program import Program

FRAME = "base"
"""The frame of UR's ROS driver that is the maker's Base."""
_DIGITS = 10


def stamp(seconds: float) -> dict[str, int]:
    """Return a time [s] as ROS writes it."""
    whole, rest = divmod(round(seconds * 1e9), 10**9)
    return {"sec": whole, "nanosec": rest}


def joint_trajectory(program: Program) -> dict[str, Any]:
    """Return the message: joint angles [rad], speeds [rad/s] and accelerations [rad/s²] at every sample."""
    motion = program.motion
    parts = {"positions": motion.joints, "velocities": motion.velocities, "accelerations": motion.accelerations}
    rounded = {name: np.round(values, _DIGITS).tolist() for name, values in parts.items()}
    return {
        "header": {"stamp": stamp(0.0), "frame_id": FRAME},
        "joint_names": list(program.arm.joint_names),
        "points": [
            {**{name: rows[index] for name, rows in rounded.items()}, "effort": [], "time_from_start": stamp(time)}
            for index, time in enumerate(motion.times.tolist())
        ],
    }


def write_json_trajectory(path: Path, program: Program) -> None:
    """Write the message as JSON."""
    write_text(path, json.dumps(joint_trajectory(program), indent=1) + "\n")


def write_yaml_trajectory(path: Path, program: Program) -> None:
    """Write the message as YAML, as ``ros2 topic echo`` prints it, one list a line."""
    message = joint_trajectory(program)
    head = message["header"]
    lines = [
        "header:",
        f"  stamp: {_mapping(head['stamp'])}",
        f"  frame_id: {head['frame_id']}",
        "joint_names:",
        *(f"- {name}" for name in message["joint_names"]),
        "points:",
    ]
    for point in message["points"]:
        rows = [f"{name}: {_row(point[name])}" for name in ("positions", "velocities", "accelerations", "effort")]
        rows.append(f"time_from_start: {_mapping(point['time_from_start'])}")
        lines += [f"{'- ' if index == 0 else '  '}{row}" for index, row in enumerate(rows)]
    write_text(path, "\n".join([*lines, ""]))


def _row(values: list[float]) -> str:
    # YAML 1.1 takes 1e-05 for a text.
    return "[" + ", ".join(f"{value:.{_DIGITS}f}" for value in values) + "]"


def _mapping(values: dict[str, int]) -> str:
    return "{" + ", ".join(f"{key}: {value}" for key, value in values.items()) + "}"
