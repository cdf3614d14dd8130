"""``koopdqn stream run=DIR``: a learned path, checked and sent to a UR's controller while the arm moves."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.pipeline import POLICY
from koopdqn.app.commands.program import program_of
from koopdqn.app.hydra.application import CommandResult
from koopdqn.errors import BadInputError
from koopdqn.files import sha256_of, write_json
from koopdqn.oracles.terminal.device import require_terminal
from koopdqn.programs.schema import StreamFile
from koopdqn.programs.streaming import Streamed, read_state, stream
from koopdqn.robot.ur import URArm

REPORT_NAME = "stream.json"
# Periods of the controllers of both series [s].
_CB_SERIES_S, _E_SERIES_S, _SAME_PERIOD = 0.008, 0.002, 1e-6


def run(config: Configuration, folder: Path) -> CommandResult:
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
    write_json(folder / REPORT_NAME, report)
    found = "not asked" if settings.host is None else "stands at the start" if not settings.move else "moved"
    lines = [
        f"{report['seconds']:.2f} s, {report['samples']} samples, checked as koopdqn export does",
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
        f"report          {console.shown_path(folder / REPORT_NAME)}",
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
    # What was typed ahead stops nothing.
    termios.tcflush(terminal, termios.TCIFLUSH)
    try:
        yield lambda: bool(select.select([terminal], [], [], 0.0)[0])
    finally:
        # The key is not left to the shell.
        termios.tcsetattr(terminal, termios.TCSAFLUSH, before)
