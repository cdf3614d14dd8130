import io
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr

import pytest

from koopdqn import console


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@contextmanager
def terminal(**environment: str) -> Iterator[Terminal]:
    """Let standard error pass for a colour terminal, and give what is written to it."""
    written = Terminal()
    with pytest.MonkeyPatch.context() as patch, redirect_stderr(written):
        for name in ("NO_COLOR", "FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
            patch.delenv(name, raising=False)
        for name, value in {"TERM": "xterm-256color", **environment}.items():
            patch.setenv(name, value)
        console.err.cache_clear()
        yield written
    console.err.cache_clear()


def test_messages_are_one_literal_line(capsys: pytest.CaptureFixture[str]) -> None:
    console.fail("a [bold]wide[/] message\nof " + "many words " * 40)
    console.warn("careful")
    console.note("[1/3]")
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("koopdqn: error: a [bold]wide[/] message of many words")
    assert lines[1:] == ["koopdqn: warning: careful", "[1/3]"]


def test_a_stage_off_a_terminal_is_a_line_at_either_end(capsys: pytest.CaptureFixture[str]) -> None:
    with console.stage("training [x]", total=3) as stage:
        for episode in range(3):
            stage.advance(note=f"episode {episode}")
    streams = capsys.readouterr()
    first, last = streams.err.splitlines()
    assert first == "training [x] ..."
    assert last.startswith("training [x]: done in ")
    assert last.endswith(", episode 2")
    assert streams.out == ""


def test_a_stage_that_fails_is_not_called_done(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError), console.stage("training"):
        raise RuntimeError
    assert capsys.readouterr().err == "training ...\n"


def test_on_a_terminal_a_bar_runs() -> None:
    with terminal() as shown:
        with console.stage("training [x]", total=2) as stage:
            stage.advance(note="[literal]")
            stage.advance()
        assert "[literal]" in shown.getvalue()
        assert "training [x]: done in" in shown.getvalue().splitlines()[-1]


def test_colour_follows_no_color() -> None:
    with terminal() as shown:
        console.fail("red")
        assert "\x1b[1;31merror" in shown.getvalue()
    with terminal(NO_COLOR="1") as shown:
        console.fail("plain")
        assert "31m" not in shown.getvalue()
