"""Executing a joint path in MuJoCo dynamics, through the arm's position actuators."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.evaluation.metrics import summary
from koopdqn.evaluation.schema import Contacts, DynamicsReport
from koopdqn.pose import Array
from koopdqn.robot.scene import Scene
from koopdqn.tasks.workcell import Workcell

REST_SECONDS = 0.5
"""How long the arm is held at the end of a path before its sag is measured: 25 times the UR5's lag."""

_MILLIMETRES = 1e3


@dataclass(frozen=True)
class Execution:
    """What became of a joint path in dynamics.

    Attributes:
        tracking_error_mm: (S,) distance [mm] of the flange from the commanded position at the same moment, after
            every physics step of the motion.
        rotation_error_deg: (S,) angle [deg] of the flange to the commanded orientation at the same moments.
        speed_ratio: largest joint speed over that joint's limit.
        torque_ratio: largest joint torque over that joint's limit: what the actuator gives and what
            compensates gravity, as the motor of the real joint supplies both.
        contact_steps: physics steps with a contact.
        first_contact: the first pair that touched, as "a with b", or an empty string.
        contact_index: the row of ``joints`` at which it touched; S if nothing did.
        sag_mm: distance [mm] of the flange from the path's end after :data:`REST_SECONDS` at rest.
        joints: (S, 6) joint angles [rad] after every physics step of the motion.
        physics_seconds: time between two rows of ``joints`` [s].
    """

    tracking_error_mm: Array
    rotation_error_deg: Array
    speed_ratio: float
    torque_ratio: float
    contact_steps: int
    first_contact: str
    contact_index: int
    sag_mm: float
    joints: Array
    physics_seconds: float


def play(
    workcell: Workcell, joints: Array, durations: Array, received: Callable[[Array], Array] = lambda sent: sent
) -> Execution:
    """Execute a path of joint angles (T, 6) [rad] whose steps take ``durations`` (T − 1,) [s].

    A cubic spline through the rows, at rest at both ends, is sampled at every physics step, whatever the ratio of the
    two time steps is; the last physics step may reach past the path's end, where the end is commanded. A position
    actuator with stiffness kp and damping kd follows kd/kp behind, so its set point leads by that: q + (kd/kp)·q̇.

    Args:
        workcell: arm and scene; the scene's own state is left alone.
        joints: at least two rows.
        durations: of the steps.
        received: gives what the arm gets of the set points (S + 1, 6) [rad] that are sent to it.

    Raises:
        BadInputError: the path has fewer than two rows, or an actuator is no position actuator.
    """
    arm = workcell.arm
    if joints.ndim != 2 or joints.shape[1] != len(arm.joint_names) or len(joints) < 2:
        raise BadInputError(
            f"a joint path must have shape (T, {len(arm.joint_names)}) with T >= 2, found {joints.shape}"
        )
    scene = copy.copy(workcell.scene)
    scene.data = mujoco.MjData(scene.model)
    seconds = float(scene.model.opt.timestep)
    commanded, speed = _set_points(joints, durations, seconds)
    led = received(commanded + _lag(scene) * speed)
    made, speeds, torques = (np.empty((len(led) - 1, joints.shape[1])) for _ in range(3))
    touched: list[str] = []
    first = len(made)
    data = scene.data
    data.qpos[scene.joint_index] = joints[0]
    # Where motors are said to compensate gravity, MuJoCo counts that among what they do.
    beside = scene.model.jnt_actgravcomp[scene.model.dof_jntid] == 0
    for index in range(len(led) - 1):
        data.ctrl[scene.actuator_index] = led[index]
        mujoco.mj_step(scene.model, data)
        made[index], speeds[index] = data.qpos[scene.joint_index], data.qvel[scene.velocity_index]
        torques[index] = (data.qfrc_actuator + beside * data.qfrc_gravcomp)[scene.velocity_index]
        if contact := scene.current_contact():
            touched.append(contact)
            first = min(first, index)
    data.ctrl[scene.actuator_index] = joints[-1]
    mujoco.mj_step(scene.model, data, nstep=math.ceil(REST_SECONDS / seconds))
    at_rest = arm.forward(data.qpos[scene.joint_index])
    reached, wanted = arm.forward(made), arm.forward(commanded[1:])
    return Execution(
        tracking_error_mm=pose.position_distance(reached, wanted) * _MILLIMETRES,
        rotation_error_deg=np.degrees(pose.rotation_distance(reached, wanted)),
        speed_ratio=float((np.abs(speeds) / np.array(arm.velocity_limits)).max()),
        torque_ratio=float((np.abs(torques) / np.array(arm.torque_limits)).max()),
        contact_steps=len(touched),
        first_contact=touched[0] if touched else "",
        contact_index=first,
        sag_mm=float(pose.position_distance(at_rest, arm.forward(joints[-1]))) * _MILLIMETRES,
        joints=made,
        physics_seconds=seconds,
    )


def summarise(executions: list[Execution], time_scale: float, step_seconds: float) -> DynamicsReport:
    """Return the report of executions whose steps took ``time_scale`` times ``step_seconds`` [s]; there may be none."""
    touched = [execution for execution in executions if execution.contact_steps]
    errors = [execution.tracking_error_mm for execution in executions]
    tracking = summary(np.array([error.mean() for error in errors])).model_copy(
        update={"max": max((float(error.max()) for error in errors), default=None)}
    )
    return DynamicsReport(
        episodes=len(executions),
        time_scale=time_scale,
        step_seconds=time_scale * step_seconds,
        tracking_error_mm=tracking,
        peak_joint_speed_ratio=max((execution.speed_ratio for execution in executions), default=None),
        peak_joint_torque_ratio=max((execution.torque_ratio for execution in executions), default=None),
        contacts=Contacts(
            episodes=len(touched),
            steps=sum(execution.contact_steps for execution in touched),
            first=touched[0].first_contact if touched else None,
        ),
        sag_mm=summary(np.array([execution.sag_mm for execution in executions])),
    )


def _set_points(joints: Array, durations: Array, physics_seconds: float) -> tuple[Array, Array]:
    """Return joint angles (S + 1, 6) [rad] and speeds [rad/s] at every physics step, up to or just past the end.

    The steps from row to row of ``joints`` (T, 6) [rad] take ``durations`` (T − 1,) [s].
    """
    from scipy.interpolate import CubicSpline

    knots = np.concatenate([[0.0], np.cumsum(durations)])
    spline = CubicSpline(knots, joints, bc_type="clamped")
    # 1e-9: an end that falls on a physics step must not gain another one by rounding.
    count = math.ceil(knots[-1] / physics_seconds - 1e-9)
    times = np.minimum(physics_seconds * np.arange(count + 1), knots[-1])
    return spline(times), spline(times, 1)


def _lag(scene: Scene) -> Array:
    """Return kd/kp (6,) [s] of the arm's position actuators, whose force is kp·(ctrl − q) − kd·q̇."""
    bias = scene.model.actuator_biasprm[scene.actuator_index]
    if np.any(bias[:, 1] >= 0):
        worst = int((bias[:, 1] >= 0).argmax())
        raise BadInputError(
            f"the actuator of {scene.arm.joint_names[worst]} must be a position actuator (biasprm[1] = -kp < 0),"
            f" found biasprm[1] = {bias[worst, 1]:g}"
        )
    return np.asarray(bias[:, 2] / bias[:, 1])
