"""A program as a ROS 2 bag in MCAP: the trajectory, and joint states and flange poses as if it had been recorded."""

from pathlib import Path
from typing import Any

import numpy as np

from koopdqn.errors import BadInputError
from koopdqn.programs.program import Program
from koopdqn.programs.ros import FRAME, joint_trajectory, stamp


def write_bag(folder: Path, program: Program) -> None:
    """Write a bag folder: ``/joint_trajectory`` once, ``/joint_states`` and ``/tool0_pose`` at every sample.

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
