"""The terminal as a device: keys one at a time, a screen of its own, and the state before it always restored."""

import atexit
import contextlib
import os
import re
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from types import FrameType
from typing import Any, Final, Literal

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import PauseRequested

_ENTER: Final = "\x1b[?1049h\x1b[?25l\x1b[2J\x1b[H"
_LEAVE: Final = "\x1b[0m\x1b[2J\x1b[?25h\x1b[?1049l"
# CSI and SS3 sequences end with a letter or ~; anything else after ESC is one character.
_KEY: Final = re.compile(r"\x1b(?:[\[O][^a-zA-Z~]*[a-zA-Z~]?|.)?|.", re.DOTALL)
_CUT: Final = re.compile(r"\x1b(?:[\[O][^a-zA-Z~]*)?$")
"""A sequence that is not over."""
_REST_SECONDS: Final = 0.02
"""How long the rest of a sequence may take."""
_NAMED: Final = {"\x1b[C": "→", "\x1bOC": "→", "\x1b[D": "←", "\x1bOD": "←", "\x1b": "Esc"}
_END_OF_INPUT: Final = "\x04"
_SMALLEST: Final = (20, 8)
"""Width and height that a terminal which does not know its size is taken to have at least."""


def require_terminal(what: str, others: str) -> None:
    """Raise BadInputError unless a person can be asked here; it names the setting ``what`` and ``others`` to use."""
    try:
        import termios  # noqa: F401 (absent on Windows)
    except ImportError:
        raise BadInputError(f"{what}: needs a POSIX terminal, found {sys.platform}; {others}") from None
    for name, stream in (("input", sys.stdin), ("error", sys.stderr)):
        if stream is None or not stream.isatty():
            raise BadInputError(f"{what}: standard {name} must be a terminal, found a pipe or file; {others}")
    kind = os.environ.get("TERM", "")
    if kind in ("", "dumb", "unknown"):
        raise BadInputError(f"{what}: TERM must name a terminal to draw on, found {kind!r}; {others}")


class Device:
    """The terminal on standard input and standard error.

    Between `enter` and `leave` it shows a screen of its own and gives every key at once and unseen. Whatever
    ends the process meanwhile, SIGKILL excepted, what was before is restored.
    """

    def __init__(self, on_return: Callable[[], None] = lambda: None) -> None:
        """Prepare; ``on_return`` is called when the process comes back after Ctrl-Z."""
        self._in, self._out = sys.stdin.fileno(), sys.stderr.fileno()
        self._on_return = on_return
        self._before: list[Any] | None = None
        self._handlers: dict[int, Any] = {}

    @property
    def entered(self) -> bool:
        """Whether it shows the screen of its own."""
        return self._before is not None

    def size(self) -> tuple[int, int]:
        """Return width and height [characters]."""
        with contextlib.suppress(OSError):
            width, height = os.get_terminal_size(self._out)
            return max(width, _SMALLEST[0]), max(height, _SMALLEST[1])
        return 80, 24

    def cell(self) -> tuple[int, int]:
        """Return width and height of a character [pixels]; where the terminal does not say, those of a small one."""
        import fcntl
        import struct
        import termios

        with contextlib.suppress(OSError):
            answer = fcntl.ioctl(self._out, termios.TIOCGWINSZ, bytes(8))
            rows, columns, width, height = struct.unpack("HHHH", answer)
            if rows and columns and width >= columns and height >= rows:
                return width // columns, height // rows
        return 8, 16

    def enter(self) -> None:
        """Show a screen of its own and take the keys."""
        import termios
        import tty

        if self.entered:
            return
        self._before = termios.tcgetattr(self._in)
        atexit.register(self.leave)
        # Only the main thread may set handlers.
        if not self._handlers and threading.current_thread() is threading.main_thread():
            self._handlers = {
                signal.SIGTSTP: signal.signal(signal.SIGTSTP, self._suspend),
                signal.SIGQUIT: signal.signal(signal.SIGQUIT, self._yield),
            }
            # Unless whoever runs this ends it in an orderly way already.
            if signal.getsignal(signal.SIGHUP) is signal.SIG_DFL:
                self._handlers[signal.SIGHUP] = signal.signal(signal.SIGHUP, self._yield)
        tty.setcbreak(self._in)
        self.write(_ENTER)

    def leave(self) -> None:
        """Restore the terminal; more than once does no harm."""
        self._restore()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}

    def write(self, text: str) -> None:
        """Write to the screen at once; PauseRequested if the terminal is gone."""
        data = text.encode("utf-8", errors="replace")
        try:
            while data:
                data = data[os.write(self._out, data) :]
        except OSError as error:
            raise _gone() from error

    def keys(self, seconds: float) -> list[str]:
        """Return the keys pressed, waiting at most ``seconds`` for one; PauseRequested if Ctrl-D ends the input.

        Arrows to the left and to the right are ``←`` and ``→``, Escape is ``Esc``.
        """
        text = self.raw(seconds)
        while _CUT.search(text) and (rest := self.raw(_REST_SECONDS)):
            text += rest
        if _END_OF_INPUT in text:
            raise PauseRequested("paused: the input ended")
        return _single(text)

    def waits(self, seconds: float) -> bool:
        """Return whether something was pressed within ``seconds``, and leave it to be read."""
        return bool(select.select([self._in], [], [], seconds)[0])

    def raw(self, seconds: float) -> str:
        """Return all that the terminal sent, waiting at most ``seconds``; PauseRequested if the terminal is gone."""
        try:
            if not self.waits(seconds):
                return ""
            data = os.read(self._in, 4096)
        except OSError as error:
            raise _gone() from error
        if not data:
            raise _gone()
        return data.decode("utf-8", errors="replace")

    def ask(self, query: str, end: str, seconds: float) -> str:
        """Write a query and return what comes until ``end`` or the time is over."""
        self.write(query)
        answer, until = "", time.monotonic() + seconds
        while end not in answer and (left := until - time.monotonic()) > 0:
            answer += self.raw(left)
        return answer

    def _restore(self) -> None:
        import termios

        if self._before is None:
            return
        before, self._before = self._before, None
        atexit.unregister(self.leave)
        with contextlib.suppress(PauseRequested):
            self.write(_LEAVE)
        main = threading.current_thread() is threading.main_thread()
        # What this was started by may have stopped first, and the terminal be the shell's: setting it stops this too.
        held = signal.signal(signal.SIGTTOU, signal.SIG_IGN) if main else None
        try:
            with contextlib.suppress(termios.error):
                termios.tcsetattr(self._in, termios.TCSANOW, before)
        finally:
            if held is not None:
                signal.signal(signal.SIGTTOU, held)

    def _suspend(self, number: int, frame: FrameType | None) -> None:
        """Stop as Ctrl-Z asks, with the shell's own screen, and come back to this one."""
        self._yield(number, frame)
        signal.signal(number, self._suspend)
        self.enter()
        self._on_return()

    def _yield(self, number: int, frame: FrameType | None) -> None:
        """Do what the signal does by itself, with the terminal restored; every answer is on disk already."""
        self._restore()
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)


def _single(text: str) -> list[str]:
    """Return the keys that are one character, in lower case, and those with a name; other sequences are left out."""
    keys = _KEY.findall(text)
    return [_NAMED.get(key, key.lower()) for key in keys if key in _NAMED or not key.startswith("\x1b")]


def _gone() -> PauseRequested:
    return PauseRequested("paused: the terminal is gone")


Graphics = Literal["auto", "blocks", "kitty", "sixel", "none"]
Drawn = Literal["blocks", "kitty", "sixel", "none"]

_WAIT_SECONDS: Final = 0.5
"""How long a terminal may take to say what it is: over SSH a round trip takes up to a few tenths."""
_KITTY_QUERY: Final = "\x1b_Gi=31,s=1,v=1,a=q,t=d,f=24;AAAA\x1b\\"
_KITTY_KNOWN: Final = "\x1b_Gi=31;OK"
# Every terminal answers this one, so that no one waits for an answer that never comes.
_DEVICE_QUERY: Final = "\x1b[c"
_DEVICE_ANSWER: Final = re.compile(r"\x1b\[\?([\d;]*)c")
_SIXEL_ATTRIBUTE: Final = "4"


def check_graphics(wanted: Graphics, key: str, environment: Mapping[str, str] = os.environ) -> None:
    """Raise BadInputError, which names the setting's key, if pictures cannot be drawn the wanted way here."""
    if wanted == "kitty" and _multiplexed(environment):
        raise BadInputError(
            f"{key}: must be auto, blocks, sixel or none inside tmux or screen, which pass no kitty"
            " pictures on, found kitty"
        )


def choose_graphics(wanted: Graphics, device: Device, environment: Mapping[str, str] = os.environ) -> Drawn:
    """Return how to draw on a terminal; for ``auto`` it is asked, on the screen of its own, and blocks are the rest."""
    if wanted != "auto":
        return wanted
    # tmux and screen would take kitty's query for the title of their window.
    query = _DEVICE_QUERY if _multiplexed(environment) else _KITTY_QUERY + _DEVICE_QUERY
    answer = device.ask(query, "c", _WAIT_SECONDS)
    if _KITTY_KNOWN in answer:
        return "kitty"
    device_answer = _DEVICE_ANSWER.search(answer)
    if device_answer and _SIXEL_ATTRIBUTE in device_answer[1].split(";"):
        return "sixel"
    return "blocks"


def _multiplexed(environment: Mapping[str, str]) -> bool:
    kind = environment.get("TERM", "")
    return bool(environment.get("TMUX") or environment.get("STY")) or kind.startswith(("tmux", "screen"))
