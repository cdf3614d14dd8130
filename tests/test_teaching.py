"""A person teaches a shelf training at the terminal, through its keys, and is interrupted in every way."""

import hashlib
import json
import os
import re
import signal
import sys
from pathlib import Path

import pytest
from small_run import SMALL
from terminal_session import QUESTION, Session, error_without_terminal

from koopdqn.app import cli

if sys.platform == "win32":
    pytest.skip("needs a POSIX terminal", allow_module_level=True)

# A narrow trust domain, and answers that hold close by only, leave some dozens of questions at most; from farther out
# than the start region there would be many more.
NARROW = ("trust=box", "trust.sigmas=0.8", "agent.exploring_scale=1.0")
ASKING = (*SMALL, *NARROW, "feedback.reach_m=0.006")
WHOLE = ("task=shelf", "seed=0")
RESTORED = re.compile(rb"\x1b\[\?25h\x1b\[\?1049l")


def lines(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "feedback.jsonl").read_text().splitlines()]


def answers(folder: Path) -> list[dict[str, object]]:
    return [line for line in lines(folder) if line["kind"] == "answer"]


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def begin(folder: Path, settings: tuple[str, ...] = ASKING, **options: object) -> Session:
    return Session("train", *settings, "oracle=terminal", "oracle.teacher=anna", f"out={folder}", **options)  # type: ignore[arg-type]


def answer(session: Session, key: str) -> bool:
    """Answer the question on the screen and wait for the next; return whether there is one."""
    number = session.number()
    session.press(key)
    while session.number() in (number, None):
        if not session.read():
            return False
    return True


@pytest.mark.slow
@pytest.mark.parametrize("settings", [ASKING, WHOLE], ids=["short", "whole"])
@pytest.mark.draws
def test_a_training_is_taught_through_the_keys(tmp_path: Path, settings: tuple[str, ...]) -> None:
    folder = tmp_path / "run"
    with begin(folder, settings) as session:
        session.wait(QUESTION)
        assert "anna" in session.lines[0]
        session.press("?")
        session.wait("Every answer is on disk before the next question")
        session.press("x")
        session.wait(lambda text: QUESTION in text)
        session.press("k")
        session.wait("'k' is no key here")
        session.press("r")
        session.wait("the motion once more")
        session.press("p")
        session.wait("saved ")
        assert (folder / "questions" / "0000.png").read_bytes().startswith(b"\x89PNG")
        session.press("0")
        session.wait("never right here")
        assert not answers(folder)
        answer(session, "s")
        assert answers(folder)[-1]["right"] is None
        answer(session, "y")
        assert answers(folder)[-1] | {"right": True, "source": "anna", "number": 1} == answers(folder)[-1]
        answer(session, "n")
        assert answers(folder)[-1]["right"] is False
        session.press("uu")
        session.wait("Withdrawn: answer 1")
        undone = [line["number"] for line in lines(folder) if line["kind"] == "undo"]
        assert undone == [2, 1], "an undo is on disk at once"
        session.resize(120, 40)
        session.wait(lambda text: len(session.lines) == 40 and "p big picture" in session.lines[38])
        asked = session.screen.buffer[0][0]
        assert asked.reverse
        answer(session, "y")
        session.press("q")
        assert session.finish() == 130
        assert RESTORED.search(session.raw)
        assert "everything so far is kept" in session.raw.decode()
    before = answers(folder)
    assert len(before) == 4
    with Session("train", f"run={folder}") as session:
        session.wait(QUESTION)
        assert session.number() == 4, "nothing is asked twice"
        session.press("y")
        session.wait(lambda text: len(answers(folder)) == 5)
        os.kill(session.child.pid, signal.SIGKILL)
        assert session.finish() == -signal.SIGKILL
    assert answers(folder)[:4] == before
    with Session("train", f"run={folder}", "oracle.teacher=bert") as session:
        session.wait(QUESTION)
        assert session.number() == 5
        while answer(session, "y"):
            pass
        assert session.finish() == 0, session.text
    report = json.loads((folder / "train.json").read_text())
    assert report["learned"]
    assert 5 < report["oracle_queries"] == len(answers(folder)) <= 100
    assert {line["source"] for line in answers(folder)} == {"anna", "bert"}
    replayed = tmp_path / "replayed"
    journal = folder / "feedback.jsonl"
    assert cli.main(["train", *settings, "oracle=replay", f"journal={journal}", f"out={replayed}", "--json"]) == 0
    assert digest(replayed / "policy.safetensors") == digest(folder / "policy.safetensors")
    assert (replayed / "feedback.jsonl").read_bytes() == journal.read_bytes()
    # A journal of another run fits no longer.
    other = ["train", *settings, "seed=1", "oracle=replay", f"journal={journal}", f"out={tmp_path / 'other'}"]
    assert cli.main(other) == 2


def test_keys_typed_ahead_answer_nothing_and_a_signal_loses_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with begin(folder) as session:
        session.wait(QUESTION)
        session.press("yyy")
        session.wait(lambda text: session.number() == 1 and "typed ahead" in text)
        assert len(answers(folder)) == 1
        os.kill(session.child.pid, signal.SIGTERM)
        assert session.finish() == 130
        assert RESTORED.search(session.raw)
    assert len(answers(folder)) == 1


def test_the_key_that_pauses_is_heeded_before_a_question_stands(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with begin(folder) as session:
        session.wait(QUESTION)
        session.press("nq")
        assert session.finish() == 130
        assert f"everything so far is kept; python -m koopdqn train run={folder} goes on" in session.raw.decode()
    assert len(answers(folder)) == 1


@pytest.mark.draws
def test_without_colour_the_screen_says_the_same(tmp_path: Path) -> None:
    with begin(tmp_path / "run", environment={"NO_COLOR": "1"}) as session:
        session.wait("m model")
        colours = {cell.fg for row in session.screen.buffer.values() for cell in row.values()}
        assert colours == {"default"}
        assert "▀" not in session.text
        for word in ("moved", "to go", "model", "Asked because", "question 0", "Better, by key"):
            assert word in session.text


def test_without_a_terminal_nothing_is_begun(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    error = error_without_terminal("train", *ASKING, "oracle=terminal", f"out={folder}")
    assert "oracle=terminal" in error
    assert all(word in error for word in ("oracle=scripted", "oracle=file", "oracle=replay"))
    assert not list(folder.glob("*.hdf5"))
