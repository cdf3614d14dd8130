"""Streaming to a UR's controller, played by a stand-in on this machine that speaks the protocol."""

import os
import pty
import select
import sys
import termios
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest
from parts import as_demonstrations
from ur_controller import HOST, STOP_SCRIPT, controller

from koopdqn.app import cli
from koopdqn.app.api import load_config
from koopdqn.app.commands import program as command
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.overrides import prepare
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.programs.schema import StreamFile
from koopdqn.programs.streaming import _ASKED, Streamed, _watched, read_state, stream
from koopdqn.programs.timing import Motion
from koopdqn.robot.ur import URArm

ARM = load_config().robot
assert isinstance(ARM, URArm)
SHARES = np.linspace(0.0, 1.0, 60)[:, None]
JOINTS = np.array(ARM.home) + 0.1 * SHARES**2 * (3.0 - 2.0 * SHARES) * np.array([1.0, -1.0, 1.0, 0.5, 0.0, 1.0])
MOTION = Motion(0.02, JOINTS, ARM.forward(JOINTS), np.arange(60.0))


def after(calls: int) -> Callable[[], bool]:
    """Return a stop key that is pressed at that call."""
    calling = count()
    return lambda: next(calling) >= calls


@pytest.fixture(autouse=True)
def _library() -> None:
    pytest.importorskip("rtde_control")


def test_every_sample_is_sent_in_order_and_time_and_the_arm_is_stopped() -> None:
    with controller(ARM.home) as told:
        read_state(HOST, MOTION, moves=True)
        made = stream(HOST, MOTION, lambda: False)
    assert made.stopped == ""
    assert made.sent == len(told.streamed) == 59
    np.testing.assert_allclose(told.streamed, MOTION.joints[1:], atol=1e-12)
    times = [time for time, _, _ in told.commands][: made.sent]
    assert times[-1] - times[0] >= 58 * MOTION.period - 0.01
    assert len(told.kinds) == 2
    assert told.kinds[-1] == STOP_SCRIPT


@pytest.mark.parametrize(("robot", "period", "own"), [("ur5e", 0.003, 0.002), ("ur5", 0.002, 0.008)])
def test_the_period_is_one_that_the_controller_can_keep(robot: str, period: float, own: float, tmp_path: Path) -> None:
    config = config_of(Path("somewhere"), f"robot={robot}", f"program.period_s={period}")
    with pytest.raises(BadInputError, match=f"must be a multiple of {own} s, .* found {period}"):
        command.stream_path(config, tmp_path)


def test_a_key_stops_the_arm_at_once() -> None:
    with controller(ARM.home) as told:
        made = stream(HOST, MOTION, after(7))
    assert made.sent == len(told.streamed) == 7
    assert made.stopped == "a key was pressed"
    assert told.kinds[-1] == STOP_SCRIPT


def test_an_interruption_stops_the_arm_too() -> None:
    def interrupt() -> bool:
        raise KeyboardInterrupt

    with controller(ARM.home) as told, pytest.raises(KeyboardInterrupt):
        stream(HOST, MOTION, interrupt)
    assert not told.streamed
    assert told.kinds[-1] == STOP_SCRIPT


def test_a_protective_stop_ends_it_with_its_name() -> None:
    with controller(ARM.home, fault_after=20) as told:
        made = stream(HOST, MOTION, lambda: False)
    assert 20 <= made.sent < 59
    assert made.stopped == "a protective stop"
    assert len(told.streamed) == made.sent


def test_a_controller_that_is_gone_ends_it() -> None:
    with controller(ARM.home, vanish_after=12):
        made = stream(HOST, MOTION, lambda: False)
    assert 11 <= made.sent < 59
    assert made.stopped.startswith("the connection lost")


def test_reading_sends_nothing_and_an_arm_that_stands_elsewhere_is_told_where() -> None:
    elsewhere = (np.array(ARM.home) + np.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0])).tolist()
    off = pytest.raises(WorkFailedError, match=r"joint 3 0\.300 rad off; 'start=\[3\.1166,")
    with controller(elsewhere) as told, off:
        read_state(HOST, MOTION, moves=False)
    assert not told.commands
    assert not told.scripts
    assert told.connections == 1


def test_no_controller_is_one_line() -> None:
    with pytest.raises(WorkFailedError, match="a UR's controller must answer at 127"):
        read_state(HOST, MOTION, moves=False)


def test_without_the_extra_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    with pytest.raises(BadInputError, match=r"koopdqn\[rtde\]"):
        read_state(HOST, MOTION, moves=False)


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A run whose program is :data:`MOTION`."""
    folder = tmp_path / "run"
    write_hdf5(folder / "demos.hdf5", as_demonstrations("shelf", [MOTION.poses]))
    (folder / "policy.safetensors").write_bytes(b"any")

    class Made:
        task, arm, motion = "shelf", ARM, MOTION

    monkeypatch.setattr(command, "program_of", lambda config, trained: (Made, None))
    return folder


def config_of(run: Path, *more: str) -> Configuration:
    config = load_config(*more)
    return replace(config, inputs=config.inputs.model_copy(update={"run": run}))


def test_without_the_flag_nothing_is_sent(run: Path, tmp_path: Path) -> None:
    with controller(ARM.home) as told:
        result = command.stream_path(config_of(run, f"stream.host={HOST}"), tmp_path / "out")
    assert not told.commands
    report = StreamFile.model_validate_json((tmp_path / "out" / "stream.json").read_text())
    assert report.model_dump(mode="json") == result.result
    assert (report.moved, report.sent, report.samples, report.host) == (False, 0, 59, HOST)
    assert result.exit_status == 0


@pytest.mark.parametrize("key", [b"a", b"\x03", b"\x11", b"\x13", b"\x16", b"\x1a", b"\x1c"])
def test_every_key_is_seen_and_the_terminal_is_as_before(monkeypatch: pytest.MonkeyPatch, key: bytes) -> None:
    ours, theirs = pty.openpty()
    with os.fdopen(theirs, "r") as terminal:
        before = termios.tcgetattr(theirs)
        monkeypatch.setattr(sys, "stdin", terminal)
        with command._any_key() as pressed:
            assert not pressed()
            os.write(ours, key)
            assert select.select([theirs], [], [], 5.0)[0]
            assert pressed()
        assert termios.tcgetattr(theirs) == before
    os.close(ours)


def test_with_the_flag_the_arm_moves_and_a_key_at_the_terminal_stops_it(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "require_terminal", lambda what, others: None)
    ours, theirs = pty.openpty()
    moving = config_of(run, "stream.move=true", f"stream.host={HOST}")
    with os.fdopen(theirs, "r") as terminal, controller(ARM.home) as told:
        monkeypatch.setattr(sys, "stdin", terminal)
        monkeypatch.setattr(command, "stream", pressing(stream, ours, 20))
        result = command.stream_path(moving, tmp_path / "out")
    os.close(ours)
    assert result.result["stopped"] == "a key was pressed"
    assert 20 <= result.result["sent"] == len(told.streamed) < 59
    assert result.exit_status == 1


def pressing(made: Callable[..., Streamed], terminal: int, calls: int) -> Callable[..., Streamed]:
    """Return streaming during which a key is pressed at a terminal, before that sample."""
    calling = count()

    def with_key(host: str, motion: Motion, stop: Callable[[], bool]) -> Streamed:
        def pressed() -> bool:
            if next(calling) == calls:
                os.write(terminal, b" ")
            return stop()

        return made(host, motion, pressed)

    return with_key


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["stream.move=true"], "stream.host: must be given to move the arm"),
        (["stream.move=true", f"stream.host={HOST}"], "stream.move: standard input must be a terminal"),
    ],
)
def test_what_is_missing_to_move_is_told(run: Path, tmp_path: Path, changes: list[str], words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        command.stream_path(config_of(run, *changes), tmp_path / "out")


def test_a_run_is_needed_and_one_arm_moves_once(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(BadInputError, match="run: must name the run"):
        command.stream_path(load_config(), Path())
    with pytest.raises(BadInputError, match="--multirun: koopdqn stream"):
        prepare("stream", ["run=a,b"], multirun=True)
    assert cli.main(["stream", "-m", "run=a"]) == 2
    assert "moves one arm once" in capsys.readouterr().err


def test_a_record_never_moves_an_arm(tmp_path: Path) -> None:
    record = tmp_path / ".hydra" / "overrides.yaml"
    record.parent.mkdir()
    record.write_text("- command=train\n- stream.move=true\n- stream.host=10.0.0.1\n", encoding="utf-8")
    given = prepare("stream", [f"run={tmp_path}"]).overrides
    assert not [each for each in given if each.startswith("stream.")]


def test_whoever_died_between_a_question_and_its_answer_is_a_connection_lost() -> None:
    ours, theirs = Pipe()
    theirs.send((_ASKED, Streamed(5, "", 0.0, 0.0)))
    theirs.close()
    made = _watched(ours, HOST, lambda: False)
    assert made.sent == 5
    assert made.stopped.startswith("the connection lost")
