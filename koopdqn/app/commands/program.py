"""``koopdqn export run=DIR`` and ``stream``: a learned path, checked, as a robot program or sent to a controller."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from koopdqn import console, pose
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.eval import near_person
from koopdqn.app.commands.trained import read_trained
from koopdqn.app.hydra.application import CommandResult
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.files import sha256_of, write_json
from koopdqn.oracles.terminal.device import require_terminal
from koopdqn.paths import arc_lengths
from koopdqn.programs.program import Program, make_program
from koopdqn.programs.ros import write_bag, write_json_trajectory, write_yaml_trajectory
from koopdqn.programs.schema import LimitsUsed, ProgramDynamics, ProgramFile, StreamFile
from koopdqn.programs.settings import ProgramSettings
from koopdqn.programs.streaming import Streamed, read_state, stream
from koopdqn.programs.urscript import MOVEP_UNCHECKED, write_movep, write_rtde, write_servoj
from koopdqn.rl.policy import tube_of
from koopdqn.robot.scene import Scene
from koopdqn.robot.ur import URArm
from koopdqn.run_folder import POLICY
from koopdqn.safety.guard import Guard
from koopdqn.safety.separation import SeparationReport, separation, separation_report
from koopdqn.tasks.demonstrated import DemonstratedTask

REPORT = "program.json"
PICTURE = "program.png"
STREAMED = "stream.json"
_OF_THE_FAMILY = ("urscript", "rtde")
# Periods of the controllers of both series [s].
_CB_SERIES_S, _E_SERIES_S, _SAME_PERIOD = 0.008, 0.002, 1e-6


def export_program(config: Configuration, run: Path, folder: Path) -> CommandResult:
    """Write the program of the policy in a run's folder (:func:`program_of`) and ``program.json``."""
    settings = config.program
    _check_formats(config)
    program, scene = program_of(config, run)
    files: dict[str, str] = {}
    # All or none: what one writer refuses leaves nothing of the others.
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix=".", dir=folder) as unfinished:
        for name in settings.formats:
            file, write = _WRITERS["movep" if name == "urscript" and settings.urscript == "movep" else name]
            write(Path(unfinished) / file, program)
            files[name] = file
        for file in files.values():
            (Path(unfinished) / file).rename(folder / file)
    report = _report(program, files, run / POLICY, settings, _near(scene, program, config)).model_dump(mode="json")
    write_json(folder / REPORT, report)
    from koopdqn.plots.program import plot_program

    title = (
        f"{program.task}: {report['seconds']:.2f} s for {1e3 * report['path_length_m']:.0f} mm on {program.arm.name}"
    )
    plot_program(folder / PICTURE, title, program, scene)
    used, dynamics = report["limits_used"], report["dynamics"]
    lines = [
        f"{report['seconds']:.2f} s for {1e3 * report['path_length_m']:.0f} mm, {report['samples']} samples,"
        f" smoothed by at most {report['smoothing_mm']:.2f} mm and {report['smoothing_deg']:.2f}°",
        f"limits used     joint speed {used['joint_speed']:.0%}, acceleration {used['joint_acceleration']:.0%},"
        f" jerk {used['joint_jerk']:.0%}, tool speed {used['tool_speed']:.0%}",
        *([MOVEP_UNCHECKED] if "urscript" in settings.formats and settings.urscript == "movep" else []),
        f"in dynamics     nothing touches, {dynamics['tracking_error_mm']:.2f} mm off at most,"
        f" {dynamics['peak_joint_torque_ratio']:.0%} of the torque",
        *([near_person(report["separation"])] if report["separation"] else []),
        *(f"{name:<14}  {console.shown_path(folder / file)}" for name, file in files.items()),
        f"picture         {console.shown_path(folder / PICTURE)}",
        f"report          {console.shown_path(folder / REPORT)}",
    ]
    return CommandResult(report, lines)


def program_of(config: Configuration, run: Path) -> tuple[Program, Scene]:
    """Return the checked program of the policy in a run's folder, and the scene in which it was checked.

    Raises:
        BadInputError: the run holds no policy of this task, or the start breaks a rule.
        WorkFailedError: there is no program that keeps every limit and touches nothing.
    """
    settings, trained = config.program, read_trained(config, run)
    placement = trained.demonstrations.placement if settings.frame == "recorded" else None
    if placement is not None:
        console.note(f"moved back to where demonstrations were recorded: they had been {placement}")
    if isinstance(config.task, DemonstratedTask):
        console.warn(
            "collisions are checked with the arm, the floor below its pedestal and obstacles= alone: the task knows"
            " neither a gripper nor furniture"
        )
    if placement is not None and config.task.obstacles:
        raise BadInputError(
            "program.frame: must be placed where obstacles stand in the scene, found recorded: they were not there"
        )
    policy, workcell, reward = trained.policy, trained.workcell, trained.reward
    guard = Guard(workcell, config.guard, tube_of(policy, reward.trust), reward.model.start_frame, time_scale=None)
    return make_program(workcell, policy, settings, trained.step_limit, placement, guard), workcell.scene


def _check_formats(config: Configuration) -> None:
    asked = config.program.formats
    if len(set(asked)) < len(asked):
        raise BadInputError(f"program.formats: must name each format once, found [{', '.join(asked)}]")
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


def _near(scene: Scene, program: Program, config: Configuration) -> SeparationReport | None:
    if config.guard.person is None:
        return None
    motion = program.motion
    found = separation(scene, motion.joints, motion.times, config.guard.person)
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
        policy=sha256_of(policy),
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


def stream_path(config: Configuration, folder: Path) -> CommandResult:
    """Make and check the program; with a host read where the arm stands; with ``stream.move`` move it.

    Raises:
        BadInputError: ``run=`` is missing, the arm is no UR, the start breaks a rule, or no key could stop the arm.
        WorkFailedError: there is no program that keeps every limit, or the arm is not where it starts.
    """
    settings, trained = config.stream, config.run
    if not isinstance(config.robot, URArm):
        raise BadInputError(f"robot: must be of the UR family to stream to its controller, found {config.robot.name}")
    own, period = _E_SERIES_S if config.robot.name.endswith("e") else _CB_SERIES_S, config.program.period_s
    if abs(period / own - round(period / own)) > _SAME_PERIOD:
        raise BadInputError(
            f"program.period_s: must be a multiple of {own:g} s, the period of a {config.robot.name}'s controller,"
            f" found {period:g}"
        )
    if settings.move and settings.host is None:
        raise BadInputError("stream.host: must be given to move the arm (host=ADDRESS), found none")
    if settings.move:
        require_terminal("stream.move", "a key must be able to stop the arm")
    program, _ = program_of(config, trained)
    motion, made = program.motion, Streamed(0, "", 0.0, 0.0)
    if settings.host is not None:
        read_state(settings.host, motion, moves=settings.move)
    if settings.move and settings.host is not None:
        console.note(f"the arm moves for {motion.times[-1]:.1f} s; any key stops it")
        with _any_key() as pressed:
            made = stream(settings.host, motion, pressed)
    report = StreamFile(
        task=program.task,
        arm=program.arm.name,
        policy=sha256_of(trained / POLICY),
        host=settings.host,
        moved=settings.move,
        seconds=float(motion.times[-1]),
        samples=len(motion.joints) - 1,
        sent=made.sent,
        stopped=made.stopped or None,
        late_seconds=made.late_s,
        joint_error_rad=made.off_rad,
        start_joints=motion.joints[0].tolist(),
    ).model_dump(mode="json")
    write_json(folder / STREAMED, report)
    found = "not asked" if settings.host is None else "stands at the start" if not settings.move else "moved"
    lines = [
        f"{report['seconds']:.2f} s, {report['samples']} samples after the first, checked as koopdqn export does",
        f"arm at {settings.host}: {found}" if settings.host else "no host given: nothing was asked",
        *(
            [
                f"sent            {made.sent} samples, {1e3 * made.late_s:.1f} ms late at most,"
                f" joints {made.off_rad:.4f} rad off at most"
            ]
            if settings.move
            else ["dry run         nothing was sent; --move moves the arm"]
        ),
        *([f"STOPPED         {made.stopped}"] if made.stopped else []),
        f"report          {console.shown_path(folder / STREAMED)}",
    ]
    return CommandResult(report, lines, exit_status=1 if made.stopped else 0)


@contextlib.contextmanager
def _any_key() -> Iterator[Callable[[], bool]]:
    """Yield whether a key was pressed, or the terminal closed, since the block began."""
    import select
    import termios
    import tty

    terminal = sys.stdin.fileno()
    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    # Ctrl-C, Ctrl-S, Ctrl-Z and others are keys then like any.
    mode = termios.tcgetattr(terminal)
    mode[0] &= ~termios.IXON
    mode[3] &= ~(termios.ISIG | termios.IEXTEN)
    termios.tcsetattr(terminal, termios.TCSANOW, mode)
    # What was typed ahead stops nothing.
    termios.tcflush(terminal, termios.TCIFLUSH)
    try:
        yield lambda: bool(select.select([terminal], [], [], 0.0)[0])
    finally:
        # The key is not left to the shell.
        termios.tcsetattr(terminal, termios.TCSAFLUSH, before)
