"""``koopdqn export run=DIR``: the path that a run learned, written as a checked robot program."""

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from koopdqn import console, pose
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.eval import near_person, step_limit_of
from koopdqn.app.commands.pipeline import POLICY
from koopdqn.app.commands.train import REPORT
from koopdqn.app.result import CommandResult
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.files import write_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.storage import read_intent
from koopdqn.paths import arc_lengths
from koopdqn.programs.bag import write_bag
from koopdqn.programs.program import Program, make_program
from koopdqn.programs.ros import write_json_trajectory, write_yaml_trajectory
from koopdqn.programs.rtde import write_rtde
from koopdqn.programs.schema import LimitsUsed, ProgramDynamics, ProgramFile
from koopdqn.programs.settings import ProgramSettings
from koopdqn.programs.urscript import write_movep, write_servoj
from koopdqn.robot.ur import URArm
from koopdqn.safety.guard import Guard
from koopdqn.safety.schema import SeparationReport, separation_report
from koopdqn.safety.separation import separation
from koopdqn.tasks.demonstrated import DemonstratedTask
from koopdqn.tasks.workcell import Workcell

REPORT_NAME = "program.json"
PICTURE = "program.png"
_OF_THE_FAMILY = ("urscript", "rtde")


def export_program(config: Configuration, run: Path, folder: Path) -> CommandResult:
    """Write the program of the policy in a run's folder and ``program.json``.

    Raises:
        BadInputError: the run holds no policy of this task, or the start breaks a rule.
        WorkFailedError: there is no program that keeps every limit and touches nothing.
    """
    settings = config.program
    _check_formats(config)
    workcell = pipeline.open_scene(config)
    program = program_of(config, run, workcell)
    files: dict[str, str] = {}
    for name in settings.formats:
        file, write = _WRITERS["movep" if name == "urscript" and settings.urscript == "movep" else name]
        write(folder / file, program)
        files[name] = file
    report = _report(program, files, run / POLICY, settings, _near(workcell, program, config)).model_dump(mode="json")
    write_json(folder / REPORT_NAME, report)
    from koopdqn.plots.program import plot_program

    title = (
        f"{program.task}: {report['seconds']:.2f} s for {1e3 * report['path_length_m']:.0f} mm on {program.arm.name}"
    )
    plot_program(folder / PICTURE, title, program, workcell.scene)
    used, dynamics = report["limits_used"], report["dynamics"]
    lines = [
        f"{report['seconds']:.2f} s for {1e3 * report['path_length_m']:.0f} mm, {report['samples']} samples,"
        f" smoothed by at most {report['smoothing_mm']:.2f} mm and {report['smoothing_deg']:.2f}°",
        f"limits used     joint speed {used['joint_speed']:.0%}, acceleration {used['joint_acceleration']:.0%},"
        f" jerk {used['joint_jerk']:.0%}, tool speed {used['tool_speed']:.0%}",
        f"in dynamics     nothing touches, {dynamics['tracking_error_mm']:.2f} mm off at most,"
        f" {dynamics['peak_joint_torque_ratio']:.0%} of the torque",
        *([near_person(report["separation"])] if report["separation"] else []),
        *(f"{name:<14}  {console.shown_path(folder / file)}" for name, file in files.items()),
        f"picture         {console.shown_path(folder / PICTURE)}",
        f"report          {console.shown_path(folder / REPORT_NAME)}",
    ]
    return CommandResult(report, lines)


def program_of(config: Configuration, run: Path, workcell: Workcell) -> Program:
    """Return the checked program of the policy in a run's folder, as :func:`export_program` writes it.

    Raises:
        BadInputError: the run holds no policy of this task, or the start breaks a rule.
        WorkFailedError: there is no program that keeps every limit and touches nothing.
    """
    from koopdqn.rl.policy import around, read_policy, tube_of

    settings = config.program
    policy, _ = read_policy(run / POLICY, config.task, anywhere=True)
    step_limit = step_limit_of(run / REPORT)
    demonstrations = pipeline.demonstrations_of(config, run)
    placement = demonstrations.placement if settings.frame == "recorded" else None
    if placement is not None:
        console.note(f"moved back to where demonstrations were recorded: they had been {placement}")
    if isinstance(config.task, DemonstratedTask):
        console.warn("collisions are checked with the arm, its tool and the floor alone: the task knows no furniture")
    if placement is not None and config.task.obstacles:
        raise BadInputError(
            "program.frame: must be placed where obstacles stand in the scene, found recorded: they were not there"
        )
    intent = read_intent(run / pipeline.INTENT, config.task)
    reward = pipeline.reward_of(config, workcell, intent, agent_steps(demonstrations, config.task))
    served = around(policy, reward.model)
    guard = Guard(workcell, config.guard, tube_of(served, reward.trust), reward.model.start_frame)
    try:
        return make_program(workcell, served, settings, step_limit, placement, guard)
    except WorkFailedError as error:
        if placement is None:
            raise
        raise WorkFailedError(f"{error}; program.frame=placed leaves it where demonstrations were moved to") from error


def _check_formats(config: Configuration) -> None:
    asked = config.program.formats
    if not isinstance(config.robot, URArm) and set(asked) & set(_OF_THE_FAMILY):
        possible = ", ".join(name for name in _WRITERS if name not in (*_OF_THE_FAMILY, "movep"))
        raise BadInputError(
            f"program.formats: {' and '.join(_OF_THE_FAMILY)} are for arms of the UR family, found them asked for"
            f" {config.robot.name}; valid: [{possible}]"
        )


def _write_robomimic(path: Path, program: Program) -> None:
    motion = program.motion
    item = Demonstration(motion.times, motion.poses, motion.joints)
    write_hdf5(path, Demonstrations(program.task, program.arm.name, [item]))


_WRITERS: dict[str, tuple[str, Callable[[Path, Program], None]]] = {
    "urscript": ("program.script", write_servoj),
    "movep": ("program.script", write_movep),
    "ros_yaml": ("trajectory.yaml", write_yaml_trajectory),
    "ros_json": ("trajectory.json", write_json_trajectory),
    "rtde": ("rtde.csv", write_rtde),
    "robomimic": ("program.hdf5", _write_robomimic),
    "mcap": ("bag", write_bag),
}
"""File name and writer of each format, and of the other kind of URScript."""


def _near(workcell: Workcell, program: Program, config: Configuration) -> SeparationReport | None:
    if config.guard.person is None:
        return None
    motion = program.motion
    found = separation(workcell.scene, motion.joints, motion.times, config.guard.person)
    return separation_report(found, motion.times.tolist())


def _report(
    program: Program, files: dict[str, str], policy: Path, settings: ProgramSettings, near: SeparationReport | None
) -> ProgramFile:
    motion, made = program.motion, program.execution
    used = {name: float(shares.max()) for name, shares in motion.used(program.limits).items()}
    turned = pose.rotation_distance(program.smooth, program.learned)
    return ProgramFile(
        task=program.task,
        arm=program.arm.name,
        policy=hashlib.sha256(policy.read_bytes()).hexdigest(),
        frame=settings.frame,
        start=motion.poses[0].tolist(),
        start_joints=motion.joints[0].tolist(),
        seconds=float(motion.times[-1]),
        period_seconds=motion.period,
        samples=len(motion.joints),
        steps=len(program.learned) - 1,
        path_length_m=float(arc_lengths(motion.poses[:, pose.POSITION])[-1]),
        smoothing_mm=float(pose.position_distance(program.smooth, program.learned).max()) * 1e3,
        smoothing_deg=float(np.degrees(turned.max())),
        limits_used=LimitsUsed(
            joint_speed=used["speed"],
            joint_acceleration=used["acceleration"],
            joint_jerk=used["jerk"],
            tool_speed=used["tool_speed"],
        ),
        dynamics=ProgramDynamics(
            tracking_error_mm=float(made.tracking_error_mm.max()),
            peak_joint_speed_ratio=made.speed_ratio,
            peak_joint_torque_ratio=made.torque_ratio,
            sag_mm=made.sag_mm,
        ),
        separation=near,
        files=files,
    )
