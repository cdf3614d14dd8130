"""The terminal as a device: whatever ends the process, the terminal is as it was."""

import os
import re
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from terminal_session import CHECKOUT

if sys.platform == "win32":
    pytest.skip("needs a POSIX terminal", allow_module_level=True)
import termios

from koopdqn.errors import BadInputError
from koopdqn.oracles.terminal.device import Device, _single, require_terminal

RESTORED = re.compile(rb"\x1b\[\?25h\x1b\[\?1049l")
PROGRAM = """
import sys
from koopdqn.app.exit_status import guard
from koopdqn.oracles.terminal.device import Device
device = Device(lambda: device.write("back"))
def work():
    device.enter()
    device.write("ready")
    try:
        while True:
            for key in device.keys(0.05):
                device.write(f"<{key}>")
                if key == "!":
                    raise RuntimeError("a fault")
    finally:
        if "close" in sys.argv:
            device.leave()
sys.exit(guard(work, debug=False))
"""


class Child:
    """The program at a terminal of its own, whose settings can be looked at."""

    def __init__(self, *arguments: str) -> None:
        self.master, self.slave = os.openpty()
        self.before = termios.tcgetattr(self.slave)
        self.seen = b""
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, *arguments],
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            env={**os.environ, "PYTHONPATH": CHECKOUT},
            start_new_session=True,
        )
        os.set_blocking(self.master, False)

    def wait(self, text: bytes, seconds: float = 30.0) -> None:
        until = time.monotonic() + seconds
        while text not in self.seen:
            assert time.monotonic() < until, (text, self.seen)
            self.read()

    def read(self) -> None:
        try:
            self.seen += os.read(self.master, 65536)
        except BlockingIOError:
            time.sleep(0.005)

    def end(self) -> int:
        status = self.process.wait(30)
        self.read()
        return status

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self.master)
        os.close(self.slave)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
@pytest.mark.parametrize("how", ["close", "leave it to the end"])
def test_a_signal_leaves_the_terminal_as_it_was(number: signal.Signals, how: str) -> None:
    child = Child(how)
    try:
        child.wait(b"ready")
        assert not termios.tcgetattr(child.slave)[3] & (termios.ECHO | termios.ICANON)
        child.process.send_signal(number)
        assert child.end() == (-number if number == signal.SIGQUIT else 130)
        assert RESTORED.search(child.seen)
        assert termios.tcgetattr(child.slave) == child.before
    finally:
        child.close()


def test_an_error_and_the_end_of_input_leave_it_as_it_was_too() -> None:
    for key, status in ((b"!", 1), (b"\x04", 130)):
        child = Child("close")
        try:
            child.wait(b"ready")
            os.write(child.master, key)
            assert child.end() == status
            assert RESTORED.search(child.seen)
            assert termios.tcgetattr(child.slave) == child.before
        finally:
            child.close()


def test_stopping_gives_the_terminal_back_and_going_on_takes_it_again() -> None:
    child = Child("close")
    try:
        child.wait(b"ready")
        child.process.send_signal(signal.SIGTSTP)
        # Without a shell that could let it go on, the system does not stop it for long.
        child.wait(b"back")
        assert re.search(RESTORED.pattern + rb".*\x1b\[\?1049h.*back", child.seen, re.DOTALL)
        os.write(child.master, b"k")
        child.wait(b"<k>")
    finally:
        child.close()


def test_keys_come_one_by_one_without_what_arrows_and_function_keys_send() -> None:
    assert _single("yN\x1b[Ay\x1bOPn\x1b[15~q\x1b[1;5Cu") == ["y", "n", "y", "n", "q", "u"]
    assert _single("\x1b") == ["Esc"]
    assert _single("a\x1b[C\x1bOCb\x1b[D\x1bODd") == ["a", "→", "→", "b", "←", "←", "d"]


class Pieces(Device):
    """Gives what a terminal sent, piece by piece."""

    def __init__(self, *pieces: str) -> None:
        self.pieces = list(pieces)

    def raw(self, seconds: float) -> str:
        return self.pieces.pop(0) if self.pieces else ""


def test_an_arrow_that_comes_in_pieces_is_one_key() -> None:
    device = Pieces("d\x1b", "[", "D", "k", "\x1b", "", "n")
    assert [device.keys(0.0) for _ in range(4)] == [["d", "←"], ["k"], ["Esc"], ["n"]]


@pytest.mark.parametrize("kind", ["", "dumb", "unknown"])
def test_a_terminal_that_cannot_draw_is_refused(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    tty = SimpleNamespace(isatty=lambda: True)
    monkeypatch.setattr(sys, "stdin", tty)
    monkeypatch.setattr(sys, "stderr", tty)
    monkeypatch.setenv("TERM", kind)
    with pytest.raises(BadInputError, match="TERM must name a terminal to draw on"):
        require_terminal("oracle=terminal", "answer otherwise")
