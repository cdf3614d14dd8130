"""Speed of the inverse kinematics and of moves: beside dm_control, EAIK, ur-analytic-ik and bare ``mj_forward``."""

from collections.abc import Callable
from math import pi
from typing import Any

import mujoco
import numpy as np

from benchmarks.rows import NOT_INSTALLED, Row, compared, installed
from koopdqn.pose import Array, to_matrix
from koopdqn.resources import asset_path
from koopdqn.robot.arm import Arm
from koopdqn.robot.ur import URArm
from koopdqn.tasks.workcell import Workcell

BATCH = 64
# DH twists of the UR family.
_TWISTS = (0.5 * pi, 0.0, 0.0, 0.5 * pi, -0.5 * pi, 0.0)
_MICRO = 1e6


def rows(workcell: Workcell) -> list[Row]:
    """Return the rows of inverse kinematics and moves along the path of the workcell's person."""
    arm, task = workcell.arm, workcell.task
    poses = task.demonstrator.roll_out(task.nominal_start, 1000)[: 4 * BATCH]
    joints = [workcell.reachability.posture]
    for pose in poses:
        joints.append(arm.inverse(pose, joints[-1]).joints)
    seeds = np.array(joints[:-1])
    return [*_alone(arm, poses, seeds), *_together(arm, poses, seeds), *_moves(workcell, poses, seeds)]


def _alone(arm: Arm, poses: Array, seeds: Array) -> list[Row]:
    def ours() -> None:
        for pose, seed in zip(poses, seeds, strict=True):
            arm.inverse(pose, seed)

    found = []
    peers = {
        "dm_control `qpos_from_site_pose`": (_dm_control(arm, poses, seeds), "along a path of 2 mm steps"),
        "ur-analytic-ik, nearest solution": (_ur_analytic(arm, poses, seeds), "a compiled library; no joint limits"),
        "EAIK, all solutions": (_eaik(arm, poses, batch=False), "a compiled library; no joint limits, no choice"),
    }
    for name, (work, note) in peers.items():
        mine, theirs = compared(ours, work)
        other = NOT_INSTALLED if theirs is None else theirs / len(poses) * _MICRO
        found.append(
            Row("inverse kinematics, a pose at a time", mine / len(poses) * _MICRO, "µs", name, other, note=note)
        )
    return found


def _together(arm: Arm, poses: Array, seeds: Array) -> list[Row]:
    def ours() -> None:
        for first in range(0, len(poses), BATCH):
            arm.inverse_batch(poses[first : first + BATCH], seeds[first : first + BATCH])

    mine, theirs = compared(ours, _eaik(arm, poses, batch=True))
    other = NOT_INSTALLED if theirs is None else theirs / len(poses) * _MICRO
    note = "ours chooses the nearest solution within the limits"
    peer = "EAIK `IK_batched`, one thread"
    return [
        Row(f"inverse kinematics, {BATCH} poses at once", mine / len(poses) * _MICRO, "µs", peer, other, 8.0, note=note)
    ]


def _moves(workcell: Workcell, poses: Array, seeds: Array) -> list[Row]:
    scene, move = workcell.scene, workcell.reachability.move_batch
    model, data = scene.model, scene.data

    def ours() -> None:
        for first in range(0, len(poses), BATCH):
            move(poses[first : first + BATCH], seeds[first : first + BATCH])

    def limit() -> None:
        for joints in seeds:
            data.qpos[scene.joint_index] = joints
            mujoco.mj_forward(model, data)

    mine, theirs = compared(ours, limit)
    assert theirs is not None
    times = mine / len(poses) * _MICRO, theirs / len(poses) * _MICRO
    note = (
        f"{1e6 / times[0]:,.0f} a second: inverse kinematics and collisions; `mj_forward` has collisions and dynamics"
    )
    return [Row(f"a move, {BATCH} at once", times[0], "µs", "bare `mj_forward`", times[1], 25.0, note=note)]


def _dm_control(arm: Arm, poses: Array, seeds: Array) -> Callable[[], None]:
    from dm_control import mjcf
    from dm_control.utils.inverse_kinematics import qpos_from_site_pose

    physics = mjcf.Physics.from_xml_string(asset_path(arm.asset).read_text(encoding="utf-8"))

    def work() -> None:
        for pose, seed in zip(poses, seeds, strict=True):
            physics.data.qpos[:] = seed
            qpos_from_site_pose(physics, arm.flange_site, pose[:3], pose[3:], inplace=True, tol=1e-9)

    return work


def _ur_analytic(arm: Arm, poses: Array, seeds: Array) -> Callable[[], None] | None:
    if not installed("ur_analytic_ik") or arm.name.lower() != "ur5":
        return None
    from ur_analytic_ik import ur5

    transforms, starts = _transforms(poses), seeds.tolist()

    def work() -> None:
        for transform, seed in zip(transforms, starts, strict=True):
            ur5.inverse_kinematics_closest(transform, *seed)

    return work


def _eaik(arm: Arm, poses: Array, *, batch: bool) -> Callable[[], Any] | None:
    if not installed("eaik") or not isinstance(arm, URArm):
        return None
    from eaik.IK_DH import DhRobot

    lengths = np.array([0.0, arm.a2, arm.a3, 0.0, 0.0, 0.0])
    robot = DhRobot(np.array(_TWISTS), lengths, np.array([arm.d1, 0.0, 0.0, arm.d4, arm.d5, arm.d6]))
    transforms = _transforms(poses)
    if batch:
        parts = [transforms[first : first + BATCH] for first in range(0, len(poses), BATCH)]
        return lambda: [robot.IK_batched(part, 1) for part in parts]
    return lambda: [robot.IK(transform) for transform in transforms]


def _transforms(poses: Array) -> Array:
    """Return homogeneous transforms (N, 4, 4) of poses (N, 7)."""
    transforms = np.tile(np.eye(4), (len(poses), 1, 1))
    transforms[:, :3, :3] = to_matrix(poses[:, 3:])
    transforms[:, :3, 3] = poses[:, :3]
    return transforms
