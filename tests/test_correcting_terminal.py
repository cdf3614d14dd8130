"""A person corrects a learned path at the terminal, through its keys, and is interrupted in every way."""

import json
import os
import re
import shlex
import signal
import sys
from pathlib import Path

import numpy as np
import pytest
from small_run import SMALL
from terminal_session import Session, error_without_terminal

from koopdqn.app import cli
from koopdqn.app.commands.correct import NAME, SHOWN
from koopdqn.app.recording.showing import ADD, BACK
from koopdqn.evaluation.correction import read_waypoints

if sys.platform == "win32":
    pytest.skip("needs a POSIX terminal", allow_module_level=True)

RESTORED = re.compile(rb"\x1b\[\?25h\x1b\[\?1049l")
LEFT, RIGHT = "\x1b[D", "\x1bOC"


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that learned the small path."""
    run = tmp_path_factory.mktemp("learned") / "run"
    assert cli.main(["train", *SMALL, f"out={run}"]) == 0
    return run


def begin(learned: Path, folder: Path, **options: object) -> Session:
    """Open the screen and lead the path back to its start, where it stands still."""
    session = Session("correct", f"run={learned}", f"out={folder}", **options)  # type: ignore[arg-type]
    session.wait("from above")
    session.press(LEFT * 40)
    session.wait("0.000 of 0.1")
    return session


def press(session: Session, keys: str, then: str) -> None:
    session.press(keys)
    session.wait(then)


def test_keys_correct_as_the_waypoints_do_that_they_show(learned: Path, tmp_path: Path) -> None:
    with begin(learned, tmp_path / "keys") as session:
        session.resize(110, 40)
        session.wait(lambda text: "q quit" in session.lines[38])
        press(session, "?", "Stop the path where you would go otherwise")
        press(session, "q", "0 waypoints")
        press(session, RIGHT * 10, "0.050 of")
        press(session, "e", "No waypoint is added yet")
        # On the path itself nothing is corrected, which is told; the screen stays.
        press(session, ADD + "e", "Not corrected: waypoints: must lie beside the learned path")
        press(session, "u", "0 waypoints")
        press(session, "rr", "+10.0 mm")
        press(session, "e", "is not added: Enter adds it")
        press(session, ADD, "1 waypoint")
        press(session, RIGHT * 2 + "d" + ADD, "2 waypoints")
        press(session, ADD, "Refused: waypoints: must be in the order")
        session.press("e")
        assert session.finish() == 0
        said = session.raw.decode()
    assert RESTORED.search(session.raw)
    made = json.loads((tmp_path / "keys" / NAME).read_text(encoding="utf-8"))
    assert [list(row) for row in read_waypoints(tmp_path / "keys" / SHOWN)] == made["waypoints"]
    again = next(line for line in said.splitlines() if "the same again" in line).partition("koopdqn ")[2]
    assert cli.main([*shlex.split(again), f"out={tmp_path / 'again'}"]) == 0
    assert cli.main(["correct", f"run={learned}", f"waypoints={tmp_path}/keys/{SHOWN}", f"out={tmp_path}/file"]) == 0
    for other in ("again", "file"):
        policies = [(tmp_path / name / "policy.safetensors").read_bytes() for name in ("keys", other)]
        assert policies[0] == policies[1]
        assert {**json.loads((tmp_path / other / NAME).read_text()), "seconds": 0} == {**made, "seconds": 0}
    assert (learned / "policy.safetensors").read_bytes() != policies[0]


@pytest.mark.parametrize("way", ["q", "ctrl-c", "hangup"])
def test_however_it_ends_the_waypoints_shown_are_kept_and_named(learned: Path, tmp_path: Path, way: str) -> None:
    folder = tmp_path / "run"
    with begin(learned, folder) as session:
        press(session, RIGHT * 10 + "r" + ADD, "1 waypoint")
        if way == "hangup":
            os.kill(session.child.pid, signal.SIGHUP)
        else:
            session.press({"q": "q", "ctrl-c": "\x03"}[way])
        assert session.finish() == 130
        said = session.raw.decode()
    assert np.array(read_waypoints(folder / SHOWN)).shape == (1, 3)
    assert not (folder / "policy.safetensors").exists()
    assert RESTORED.search(session.raw)
    assert f"koopdqn correct run={learned} waypoints={folder / SHOWN}" in said


def test_leaving_without_a_waypoint_leaves_nothing(learned: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with begin(learned, folder, environment={"NO_COLOR": "1"}) as session:
        session.press(BACK + "q")
        assert session.finish() == 130
        assert "left without correcting" in session.raw.decode()
    assert not [path.name for path in folder.glob("*") if not path.name.startswith(".")]


def test_without_a_terminal_waypoints_must_be_given(learned: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    error = error_without_terminal("correct", f"run={learned}", f"out={folder}")
    assert "waypoints: standard input must be a terminal" in error
    assert "give waypoints=[[x,y,z],…] or waypoints=FILE" in error
    assert not [path.name for path in folder.glob("*") if not path.name.startswith(".")]
