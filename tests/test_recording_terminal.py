"""A person demonstrates a task at the terminal, through its keys, and is interrupted in every way."""

import json
import os
import re
import signal
import sys
from pathlib import Path

import pytest
from keyboard_parts import shown_by_keys
from parts import load_parts
from small_run import SMALL
from terminal_session import Session, error_without_terminal

from koopdqn.app import cli
from koopdqn.app.recording.recorder import Recorder
from koopdqn.app.recording.session import LOG
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.tasks.workcell import open_workcell

if sys.platform == "win32":
    pytest.skip("needs a POSIX terminal", allow_module_level=True)

RESTORED = re.compile(rb"\x1b\[\?25h\x1b\[\?1049l")
FILE = "demos.hdf5"


@pytest.fixture(scope="module")
def one() -> str:
    """The keys that show the small task once, from its first start."""
    parts = load_parts(*SMALL)
    return shown_by_keys(Recorder(open_workcell(parts.task, parts.arm), parts.demo, 0))


def begin(folder: Path, **options: object) -> Session:
    return Session("demo", *SMALL, "source=keyboard", f"out={folder}", **options)  # type: ignore[arg-type]


def press(session: Session, keys: str) -> None:
    """Press keys that move the arm and wait until the screen counts them."""
    session.press(keys)
    session.wait(f"path   {len(keys)} move")


def test_a_person_records_is_stopped_and_goes_on(tmp_path: Path, one: str) -> None:
    folder = tmp_path / "run"
    with begin(folder) as session:
        session.wait("s start t tool g goal")
        session.press("?")
        session.wait("Show the task: drive the tool")
        session.press("q")
        session.wait("w s  +x -x")
        session.press("z")
        session.wait("'z' is no key here")
        press(session, one[:3])
        session.press("e")
        session.wait("off the goal: fit and train refuse over 5 mm, 1°")
        session.press(one[3:])
        session.wait(f"path   {len(one)} move")
        session.wait("goal   reached")
        session.press("e")
        session.wait("Kept: demonstration 0")
        assert len(read_hdf5(folder / FILE)) == 1, "a kept demonstration is on disk at once"
        session.resize(120, 40)
        session.wait(lambda text: "q finish" in session.lines[38])
        press(session, "ra")
        os.kill(session.child.pid, signal.SIGTERM)
        assert session.finish() == 130
        assert RESTORED.search(session.raw)
        assert "everything so far is kept" in session.raw.decode()
    kept = (folder / FILE).read_bytes()
    with Session("demo", f"run={folder}") as session:
        session.wait("path   2 moves")
        assert "1 kept" in session.lines[0]
        session.press("r")
        session.wait("path   3 moves")
        os.kill(session.child.pid, signal.SIGKILL)
        assert session.finish() == -signal.SIGKILL
    assert (folder / FILE).read_bytes() == kept
    with Session("demo", f"run={folder}") as session:
        session.wait("path   3 moves")
        session.press("q")
        assert session.finish() == 0
        assert RESTORED.search(session.raw)
        said = session.raw.decode()
        assert "1 demonstration of task shelf" in said
        assert "3 moves are under way" in said
    assert (folder / FILE).read_bytes() == kept
    assert (folder / "demos.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("way", ["ctrl-c", "ctrl-d", "hangup"])
def test_every_interruption_restores_the_terminal_and_keeps_the_moves(tmp_path: Path, way: str) -> None:
    folder = tmp_path / "run"
    with begin(folder, environment={"NO_COLOR": "1"}) as session:
        session.wait("s start t tool g goal")
        press(session, "ra")
        colours = {cell.fg for row in session.screen.buffer.values() for cell in row.values()}
        assert colours == {"default"}
        if way == "hangup":
            os.kill(session.child.pid, signal.SIGHUP)
            assert session.finish() == 130
        else:
            session.press({"ctrl-c": "\x03", "ctrl-d": "\x04"}[way])
            assert session.finish() == 130
        assert RESTORED.search(session.raw)
        said = " ".join(session.raw.decode().split())
        assert "everything so far is kept; python -m koopdqn demo" in said
        assert said.endswith("goes on")
    keys = [json.loads(line).get("key") for line in (folder / LOG).read_text().splitlines()]
    assert keys == [None, "r", "a"]


def test_finishing_without_a_demonstration_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with begin(folder) as session:
        session.wait("s start t tool g goal")
        session.press("q")
        assert session.finish() == 1
        assert "no demonstration was kept: e marks the end of one" in " ".join(session.raw.decode().split())
    assert not (folder / FILE).exists()


def test_without_a_terminal_nothing_is_begun(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    error = error_without_terminal("demo", *SMALL, "source=keyboard", f"out={folder}")
    assert all(word in error for word in ("source=keyboard", "source=scripted", "koopdqn import"))
    assert not [path.name for path in folder.glob("*") if not path.name.startswith(".")]


@pytest.fixture(scope="module")
def scripted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of demonstrations that no person recorded."""
    folder = tmp_path_factory.mktemp("demo") / "scripted"
    assert cli.main(["demo", *SMALL, "demo.count=1", f"out={folder}", "--json"]) == 0
    return folder


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("demo", "source=mouse"), "demo.source: must be 'scripted' or 'keyboard', found 'mouse'"),
        (("demo", "demo.keyboard.step_m=0"), "demo.keyboard.step_m: must be greater than or equal to 0.0001"),
        (
            ("train", *SMALL, "source=keyboard"),
            "demo.source: must be scripted where demonstrations are made by themselves",
        ),
        (("demo", "run=nowhere"), "run: must name the folder of a recording, found no folder 'nowhere'"),
        (("demo", "run={scripted}"), "run: must name a folder of demonstrations recorded with source=keyboard"),
        (("demo", "run={scripted}", "out=other"), "out: demo run=DIR goes on in DIR"),
        (("train", "run={scripted}"), "run: must name a run of 'train', found one of 'demo'"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    tmp_path: Path, scripted: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], expected: str
) -> None:
    before = (scripted / FILE).read_bytes()
    given = [argument.format(scripted=scripted) for argument in arguments]
    assert cli.main([*given, *([] if "run=" in " ".join(given) else [f"out={tmp_path / 'new'}"])]) == 2
    assert expected in " ".join(capsys.readouterr().err.split())
    assert (scripted / FILE).read_bytes() == before
