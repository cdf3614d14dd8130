"""A program as ROS 2 has it: a ``trajectory_msgs/JointTrajectory`` in YAML and in JSON, and a bag in MCAP."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from koopdqn.errors import BadInputError
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
    # One list a line, as `ros2 topic echo` prints it.
    look: dict[str, Any] = {"default_flow_style": None, "sort_keys": False, "width": 10_000}
    write_text(path, yaml.dump(joint_trajectory(program), Dumper=yaml.CSafeDumper, **look))


def write_bag(folder: Path, program: Program) -> None:
    """Write a bag folder, as if the program had been recorded.

    It holds ``/joint_trajectory`` once, ``/joint_states`` and ``/tool0_pose`` at every sample.

    Raises:
        BadInputError: the extra ``ros`` is not installed, or there is something at the path.
    """
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer, WriterError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise BadInputError("program.formats: mcap needs rosbags: pip install 'koopdqn[ros]'") from error
    store = get_typestore(Stores.ROS2_HUMBLE)

    def made(kind: str, **fields: Any) -> Any:
        return store.types[kind](**fields)

    def header(time: float) -> Any:
        return made("std_msgs/msg/Header", stamp=made("builtin_interfaces/msg/Time", **stamp(time)), frame_id=FRAME)

    motion = program.motion
    message = joint_trajectory(program)
    points = [
        made(
            "trajectory_msgs/msg/JointTrajectoryPoint",
            **{name: np.array(point[name]) for name in ("positions", "velocities", "accelerations", "effort")},
            time_from_start=made("builtin_interfaces/msg/Duration", **point["time_from_start"]),
        )
        for point in message["points"]
    ]
    names = message["joint_names"]
    whole = made("trajectory_msgs/msg/JointTrajectory", header=header(0.0), joint_names=names, points=points)
    states = zip(motion.times.tolist(), motion.joints, motion.velocities, motion.poses.tolist(), strict=True)
    try:
        with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:

            def channel(topic: str, kind: str) -> Any:
                connection = bag.add_connection(topic, kind, typestore=store)
                return lambda time, told: bag.write(connection, round(time * 1e9), store.serialize_cdr(told, kind))

            channel("/joint_trajectory", "trajectory_msgs/msg/JointTrajectory")(0.0, whole)
            tell_joints = channel("/joint_states", "sensor_msgs/msg/JointState")
            tell_pose = channel("/tool0_pose", "geometry_msgs/msg/PoseStamped")
            for time, joints, velocities, place in states:
                x, y, z, qw, qx, qy, qz = place
                state = made(
                    "sensor_msgs/msg/JointState",
                    header=header(time),
                    name=names,
                    position=joints,
                    velocity=velocities,
                    effort=np.zeros(0),
                )
                position = made("geometry_msgs/msg/Point", x=x, y=y, z=z)
                orientation = made("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
                at = made("geometry_msgs/msg/Pose", position=position, orientation=orientation)
                tell_joints(time, state)
                tell_pose(time, made("geometry_msgs/msg/PoseStamped", header=header(time), pose=at))
    except WriterError as error:
        raise BadInputError(f"{folder} must be new, the writer says: {error}") from error
