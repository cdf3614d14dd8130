import io
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.table import Table

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


@pytest.mark.parametrize(
    ("share", "shown"),
    [(1.0, "100%"), (0.999, "99.9%"), (0.99999, "99.9%"), (0.985, "98%"), (0.0, "0%"), (0.001, "0.1%"), (0.5, "50%")],
)
def test_nothing_is_called_all_or_none_that_is_not(share: float, shown: str) -> None:
    assert console.percent(share) == shown


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


NAMES = "an[bold red]na[/] :smile: \x1b[31mred\x1b]0;title\x07\u202egnp.exe\r\x9b2J"


def test_a_name_is_shown_and_not_obeyed_wherever_it_stands(capsys: pytest.CaptureFixture[str]) -> None:
    table = Table(title=NAMES)
    table.add_column(NAMES, no_wrap=True)
    table.add_row(NAMES)
    console.out.cache_clear()
    console.err.cache_clear()
    console.say(NAMES)
    console.out().width = 200
    console.say(table)
    console.warn(NAMES)
    console.note(NAMES)
    with console.stage(NAMES) as stage:
        stage.advance(note=NAMES)
    streams = capsys.readouterr()
    assert streams.out.count("an[bold red]na[/] :smile: \\x1b[31mred") == 4
    assert streams.err.count("an[bold red]na[/] :smile: \\x1b[31mred\\x1b]0;title\\x07\\u202egnp.exe") == 5
    assert not any(sign in streams.out + streams.err for sign in "\x1b\x07\u202e\r\x9b")


def test_no_word_of_a_table_is_cut_where_the_terminal_is_narrower(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [["nearest demonstration", "100% (57–100)", "195.3 / 337 mm", "none"]]
    for width in (20, 60):
        monkeypatch.setenv("COLUMNS", str(width))
        console.out.cache_clear()
        ways: tuple[Literal["words", "cells"], ...] = ("words", "cells")
        for whole in ways:
            console.say(console.table(["method", "success", "deviation", "failures"], rows, (), whole=whole))
            shown = capsys.readouterr().out
            assert "…" not in shown
            assert all(part in shown for cell in rows[0] for part in ([cell] if whole == "cells" else cell.split()))
    console.out.cache_clear()


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_borders_are_in_line_whatever_the_output_can_show(encoding: str) -> None:
    written = io.BytesIO()
    stream = io.TextIOWrapper(written, encoding=encoding, errors="backslashreplace")
    shown = console.LiteralConsole(file=stream, width=40)
    table = console.table(["a heading that is cut"], [["–"], ["1…2 °"], ["名ρ"], ["long" * 20]], (), title="−")
    table.columns[0].no_wrap = True
    shown.print(table)
    stream.flush()
    _, *lines = written.getvalue().decode(encoding).splitlines()
    assert {cell_len(line) for line in lines} == {40}
    if encoding == "ascii":
        cells = [line.strip("| ") for line in lines if line.startswith("|")]
        assert cells[2:5] == ["-", "1...2 deg", "\\u540d\\u03c1"]
        assert cells[5].endswith("longlon.")


def test_a_name_in_a_line_keeps_its_signs(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    stream = io.TextIOWrapper(written, encoding="ascii", errors="backslashreplace")
    monkeypatch.setattr(sys, "stdout", stream)
    console.out.cache_clear()
    console.say("page  a–b…/view.html")
    stream.flush()
    assert written.getvalue() == b"page  a\\u2013b\\u2026/view.html\n"
    console.out.cache_clear()


@given(st.text())
def test_what_is_shown_of_a_text_can_be_shown(text: str) -> None:
    shown = console.visible(text)
    assert console.visible(shown) == shown
    assert not any(sign in shown for sign in "\x1b\x07\b\r\x9b\u202e\u2028")
    if text.isprintable():
        assert shown == text


def test_a_closed_terminal_ends_with_status_130_and_under_nohup_not_at_all(tmp_path: Path) -> None:
    code = (
        "import sys, time\n"
        "from koopdqn.app import cli\n"
        "def work(*arguments, **options):\n"
        "    print('ready', flush=True)\n"
        # A signal that comes just before a sleep begins is handled when the sleep ends.
        "    for _ in range(int(sys.argv[1])):\n"
        "        time.sleep(0.1)\n"
        "    return 0\n"
        "cli._compose_and_run = work\n"
        "sys.exit(cli.main(['demo']))\n"
    )
    path = str(Path(console.__file__).resolve().parent.parent)
    for ignored, tenths, status in ((False, "600", 130), (True, "30", 0)):
        master, slave = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-c", code, tenths],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            env={**os.environ, "PYTHONPATH": path},
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN) if ignored else None,  # noqa: B023
        )
        os.close(slave)
        said = b""
        while b"ready\r\n" not in said:
            said += os.read(master, 1000)
        os.close(master)
        process.send_signal(signal.SIGHUP)
        assert process.wait(60) == status
