"""A koopdqn in a terminal of its own, with keys to press and a screen to read."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import pexpect
import pyte

from koopdqn.app import cli

CHECKOUT = str(Path(cli.__file__).resolve().parent.parent.parent)
QUESTION = "Was this right?"


def error_without_terminal(*arguments: str) -> str:
    """Return the last line that ``koopdqn`` says where it has no terminal but needs one, having ended with status 2."""
    ended = subprocess.run(
        [sys.executable, "-m", "koopdqn", *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env={**os.environ, "TERM": "xterm", "PYTHONPATH": CHECKOUT},
        check=False,
    )
    assert ended.returncode == 2, ended.stderr
    return ended.stderr.strip().splitlines()[-1]


class Session:
    """Runs ``koopdqn`` at a terminal of some size until closed."""

    def __init__(self, *arguments: str, size: tuple[int, int] = (80, 24), environment: dict[str, str] | None = None):
        width, height = size
        path = os.pathsep.join(filter(None, [CHECKOUT, os.environ.get("PYTHONPATH")]))
        outer = {name: value for name, value in os.environ.items() if name not in ("NO_COLOR", "TMUX", "STY")}
        base = {"TERM": "xterm-256color", "COLORTERM": "truecolor", "LANG": "C.UTF-8", "PYTHONPATH": path}
        self.screen = pyte.Screen(width, height)
        self._stream = pyte.ByteStream(self.screen)
        self.raw = b""
        self.child = pexpect.spawn(
            sys.executable,
            ["-m", "koopdqn", *arguments],
            dimensions=(height, width),
            env={**outer, **base, **(environment or {})},
            timeout=60,
        )
        self.child.delaybeforesend = None

    def __enter__(self) -> "Session":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.child.close(force=True)

    @property
    def lines(self) -> list[str]:
        return list(self.screen.display)

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    def press(self, keys: str) -> None:
        self.child.send(keys)

    def resize(self, width: int, height: int) -> None:
        self.child.setwinsize(height, width)
        self.screen.resize(height, width)
        self.screen.erase_in_display(2)

    def read(self, seconds: float = 0.02) -> bool:
        """Take in what the terminal was sent; return whether the process still runs."""
        try:
            data = self.child.read_nonblocking(1 << 16, timeout=seconds)
        except pexpect.TIMEOUT:
            return True
        except pexpect.EOF:
            return False
        self.raw += data
        self._stream.feed(data)
        return True

    def wait(self, ready: str | Callable[[str], bool], seconds: float = 60.0) -> str:
        """Return the screen's text as soon as it holds a text, or a predicate is true of it."""
        until = time.monotonic() + seconds
        is_ready = (lambda text: ready in text) if isinstance(ready, str) else ready
        while time.monotonic() < until:
            if is_ready(self.text):
                return self.text
            if not self.read() and not is_ready(self.text):
                raise AssertionError(f"it ended before {ready!r} came:\n{self.text}")
        raise AssertionError(f"{ready!r} did not come:\n{self.text}")

    def number(self) -> int | None:
        """Return the number of the question on the screen, or None."""
        head = self.lines[0].split("question ")
        if QUESTION not in self.text or len(head) < 2:
            return None
        return int(head[1].split()[0].strip(","))

    def finish(self, seconds: float = 90.0) -> int:
        """Wait for the end and return the exit status, negative for a signal."""
        until = time.monotonic() + seconds
        while self.read() and time.monotonic() < until:
            pass
        self.child.wait()
        return int(-self.child.signalstatus if self.child.signalstatus else self.child.exitstatus)
