"""A learned path as a robot program: rolled out, smoothed, timed, and refused unless it can be played safely."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Placement
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.evaluation.dynamics import Execution, play
from koopdqn.pose import Array
from koopdqn.programs.settings import NOMINAL, ProgramSettings
from koopdqn.programs.timing import Limits, Motion, smoothed, timed
from koopdqn.robot.arm import Arm
from koopdqn.safety.guard import Guard
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, roll_out
from koopdqn.tasks.task import Task, breaks_rule
from koopdqn.tasks.workcell import Workcell

_SMOOTHING: Final = (1.0, 0.5, 0.25)
"""Shares of the tolerance that are tried: a path learned close to an edge may be smoothed into it."""


@dataclass(frozen=True)
class Program:
    """A checked motion.

    Attributes:
        task: name of the task.
        arm: the arm that makes it.
        motion: its samples.
        limits: what they keep.
        learned: (T, 7) the poses of the learned path, in the program's frame.
        smooth: (T, 7) the same, smoothed: the path of the motion.
        followed: (T, 6) the arm's joint angles there [rad].
        execution: what became of it in dynamics.
    """

    task: str
    arm: Arm
    motion: Motion
    limits: Limits
    learned: Array
    smooth: Array
    followed: Array
    execution: Execution


def make_program(
    workcell: Workcell,
    policy: Controller,
    settings: ProgramSettings,
    step_limit: int,
    placement: Placement | None = None,
    guard: Guard | None = None,
) -> Program:
    """Return the program of a policy's path from ``settings.start``.

    Args:
        workcell: task, arm and scene.
        policy: chooses the actions (N,) from poses (N, 7).
        settings: how it is made and what limits it keeps.
        step_limit: steps within which the goal must be reached.
        placement: how demonstrations were moved before they were learned; the program is made where they were recorded.
        guard: refuses steps of the learned path; None refuses only what the arm cannot do.

    Raises:
        BadInputError: the start given has a quaternion not of unit length, or a joint beyond its range.
        WorkFailedError: the start cannot be taken, the goal is not reached, the arm cannot follow the path, something
            touches, or dynamics breaks a limit; the message names place and reason.
    """
    arm = workcell.arm
    limits = Limits(
        settings.speed_share * np.array(arm.velocity_limits),
        np.full(len(arm.joint_names), settings.acceleration_rad_s2),
        np.full(len(arm.joint_names), settings.jerk_rad_s3),
        settings.tool_speed_m_s if guard is None else min(settings.tool_speed_m_s, guard.settings.tool_speed_m_s),
    )
    start, joints = _start(workcell, settings, placement)
    episode = _learned(workcell, policy, start, joints, step_limit, placement, guard)
    learned = episode.poses if placement is None else placement.restored(episode.poses)
    refused: WorkFailedError | None = None
    for share in _SMOOTHING:
        smooth = smoothed(learned, share * settings.tolerance_m, share * settings.tolerance_rad)
        try:
            return _checked(workcell, learned, smooth, joints, limits, settings, placement, guard)
        except WorkFailedError as error:
            refused = refused or error
    assert refused is not None
    raise refused


def _checked(
    workcell: Workcell,
    learned: Array,
    smooth: Array,
    joints: Array | None,
    limits: Limits,
    settings: ProgramSettings,
    placement: Placement | None,
    guard: Guard | None,
) -> Program:
    """Return the program along a smoothed path (T, 7); WorkFailedError unless it keeps all it must."""
    arm, task = workcell.arm, workcell.task
    try:
        followed = _followed(workcell, smooth, joints)
        motion = timed(followed, arm.forward, limits, settings.period_s)
        check_free(workcell, motion)
        if guard is not None:
            check_clear(guard, motion)
    except WorkFailedError as error:
        if placement is None:
            raise
        hint = "program.frame=placed leaves it where demonstrations were moved to"
        raise WorkFailedError(f"{error}; {hint}") from error
    check_rule(task, motion, placement)
    execution = check_dynamics(workcell, motion, settings)
    return Program(task.name, arm, motion, limits, learned, smooth, followed, execution)


def _start(workcell: Workcell, settings: ProgramSettings, placement: Placement | None) -> tuple[Array, Array | None]:
    """Return the pose (7,) at which the program starts, in its own frame, and the joint angles (n,) if given [rad]."""
    arm = workcell.arm
    if settings.start == NOMINAL:
        start = workcell.task.nominal_start
        return (start if placement is None else placement.restored(start)), None
    if isinstance(settings.start, tuple) and len(settings.start) == 7:
        given = np.array(settings.start)
        length = float(np.linalg.norm(given[pose.QUATERNION]))
        if abs(length - 1.0) > 1e-3:
            raise BadInputError(f"program.start: its quaternion must have length 1 within 0.001, found {length:g}")
        return pose.make(given[pose.POSITION], given[pose.QUATERNION]), None
    given = np.array(settings.start["joints"] if isinstance(settings.start, dict) else settings.start)
    if len(given) != len(arm.joint_names):
        raise BadInputError(
            f"program.start: must be {len(arm.joint_names)} joint angles of {arm.name}, found {len(given)}"
        )
    outside = (given < np.array(arm.joint_lower)) | (given > np.array(arm.joint_upper))
    if outside.any():
        worst = int(outside.argmax())
        raise BadInputError(
            f"program.start: {arm.joint_names[worst]} must lie within {arm.joint_lower[worst]:.4f}…"
            f"{arm.joint_upper[worst]:.4f} rad, found {given[worst]:g}"
        )
    return arm.forward(given), given


def _learned(
    workcell: Workcell,
    policy: Controller,
    start: Array,
    joints: Array | None,
    step_limit: int,
    placement: Placement | None,
    guard: Guard | None,
) -> Episode:
    """Return the policy's episode from a start in the program's frame; it must succeed."""
    reachability = workcell.reachability
    if placement is not None:
        # Learned where demonstrations were moved to: what the arm does there is not what the program does.
        start, joints = placement.poses(start), None
    if joints is None:
        motion = reachability.enter(start)
        if motion.joints is None:
            raise WorkFailedError(f"the start at {_place(start)} must be free, found {motion.reason}: {motion.detail}")
        joints = motion.joints
    elif contact := workcell.scene.contact(joints):
        raise WorkFailedError(f"the start at {_place(start)} must be free, found {contact} in contact")
    begin = start[None], joints[None]
    if guard is None:
        episode = roll_out(policy, workcell.task, reachability, *begin, step_limit)[0]
    else:
        episode = guard.roll_out(policy, *begin, step_limit)[0]
    if episode.outcome != SUCCESS:
        detail = f" ({episode.detail})" if episode.detail else ""
        raise WorkFailedError(
            f"the learned policy must reach the goal from {_place(start)}, found {episode.outcome} after"
            f" {episode.steps} steps at {_place(episode.poses[-1])}{detail}"
        )
    return episode


def _followed(workcell: Workcell, poses: Array, joints: Array | None) -> Array:
    """Return the joint angles (N, 6) [rad] along poses (N, 7), from given ones if there are any."""
    followed, motion = workcell.reachability.follow_as_far(poses, joints)
    if motion.joints is None:
        raise WorkFailedError(
            f"the arm must be able to follow the smoothed path, found {motion.reason} at"
            f" {_place(poses[min(len(followed), len(poses) - 1)])}: {motion.detail}"
        )
    return np.array(followed)


def check_free(workcell: Workcell, motion: Motion) -> None:
    """Raise WorkFailedError where something touches at a sample of the motion, or a joint is out of its range."""
    lower, upper = np.array(workcell.arm.joint_lower), np.array(workcell.arm.joint_upper)
    for time, joints, place in zip(motion.times, motion.joints, motion.poses, strict=True):
        if (joints < lower).any() or (joints > upper).any():
            worst = int(np.maximum(lower - joints, joints - upper).argmax())
            raise WorkFailedError(
                f"{workcell.arm.joint_names[worst]} must lie within {lower[worst]:.4f}…{upper[worst]:.4f} rad, found"
                f" {joints[worst]:.4f} rad after {time:.3f} s at {_place(place)}"
            )
        if contact := workcell.scene.contact(joints):
            raise WorkFailedError(f"nothing may touch, found {contact} after {time:.3f} s at {_place(place)}")


def check_clear(guard: Guard, motion: Motion) -> None:
    """Raise WorkFailedError at a sample that is nearer to what stands around than a guard allows."""
    for row in range(1, len(motion.joints)):
        if near := guard.too_near(motion.joints[row], motion.joints[row - 1]):
            raise WorkFailedError(f"{near} after {motion.times[row]:.3f} s at {_place(motion.poses[row])}")


def check_rule(task: Task, motion: Motion, placement: Placement | None) -> None:
    """Raise WorkFailedError where a sample breaks the task's own rule, which smoothing could bring about."""
    poses = motion.poses if placement is None else placement.poses(motion.poses)
    broken = breaks_rule(task, poses)
    if broken.any():
        row = int(broken.argmax())
        raise WorkFailedError(
            f"the task's rule must hold ({task.rule}), found it broken after {motion.times[row]:.3f} s at"
            f" {_place(motion.poses[row])}: less smoothing with program.tolerance_rad may keep it"
        )


def check_dynamics(workcell: Workcell, motion: Motion, settings: ProgramSettings) -> Execution:
    """Return what becomes of the motion in MuJoCo's dynamics.

    Raises:
        WorkFailedError: something touches, a joint passes its torque or speed limit, or the flange strays.
    """
    made = play(workcell, motion.joints, np.diff(motion.times))

    def found(row: int) -> str:
        return (
            f"after {row * made.physics_seconds:.3f} s of dynamics at {_place(workcell.arm.forward(made.joints[row]))}"
        )

    if made.contact_steps:
        raise WorkFailedError(f"nothing may touch, found {made.first_contact} {found(made.contact_index)}")
    worst = int(made.tracking_error_mm.argmax())
    if made.tracking_error_mm[worst] > 1e3 * settings.tracking_m:
        raise WorkFailedError(
            f"the flange must stay within program.tracking_m = {settings.tracking_m:g} m of its sample, found"
            f" {1e-3 * made.tracking_error_mm[worst]:.4f} m {found(worst)}"
        )
    for name, ratio in (("torque", made.torque_ratio), ("speed", made.speed_ratio)):
        if ratio > 1.0:
            raise WorkFailedError(f"no joint may pass its {name} limit in dynamics, found {ratio:.3g} times the limit")
    return made


def _place(of: Array) -> str:
    return f"{np.round(of[pose.POSITION], 4).tolist()} m"
