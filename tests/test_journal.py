import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import Clerk
from questions import question

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.journal import read_lines, read_records
from koopdqn.oracles.replay import JournalledOracle


def thirds(asked: Question) -> bool | None:
    """Yes, no and skipped in turn."""
    return (True, False, None)[asked.step]


def filled(path: Path, count: int) -> list[Answer]:
    oracle = JournalledOracle(Clerk(thirds), path, 0)
    answers = [oracle.answer(question(number)) for number in range(count)]
    oracle.close()
    return answers


class _Reader(Oracle):
    """An oracle that looks at the journal while it is asked."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.seen: list[int] = []

    def answer(self, question: Question) -> Answer:
        self.seen.append(len(read_lines(self.path)))
        return Answer(True, "reader")


def test_every_answer_is_on_disk_before_it_is_given(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    reader = _Reader(path)
    oracle = JournalledOracle(reader, path, 0)
    for number in range(4):
        oracle.answer(question(number))
        assert len(path.read_bytes().split(b"\n")) == number + 2
    assert reader.seen == [0, 1, 2, 3]


def test_it_is_forced_to_disk_and_not_only_handed_to_the_system(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "feedback.jsonl"
    lengths: list[int] = []
    monkeypatch.setattr("os.fsync", lambda descriptor: lengths.append(path.stat().st_size))
    oracle = JournalledOracle(Clerk(), path, 0)
    oracle.answer(question(0))
    assert lengths == [path.stat().st_size]
    assert lengths[0] > 0


def test_a_withdrawal_and_its_answer_are_written_together_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "feedback.jsonl"
    oracle = JournalledOracle(Clerk(lambda asked: asked.number < 2), path, 0)
    for number in range(2):
        oracle.answer(question(number))
    before, synced = path.read_bytes(), os.fsync
    oracle._oracle.answer = lambda question: Answer(True, "clerk", undo=2)  # type: ignore[method-assign]

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "no space left")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="no space"):
        oracle.answer(question(2))
    assert path.read_bytes() == before
    monkeypatch.setattr("os.fsync", synced)
    oracle.close()
    rest = JournalledOracle(Clerk(), path, 2)
    rest._oracle.answer = lambda question: Answer(True, "clerk", undo=1)  # type: ignore[method-assign]
    rest.answer(question(2))
    assert [record.withdrawn for record in read_records(path).items] == [False, True, False]


def test_a_journal_may_be_larger_than_other_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "feedback.jsonl"
    filled(path, 3)
    monkeypatch.setattr("koopdqn.files.LARGEST_JSON", path.stat().st_size - 1)
    assert len(read_records(path).items) == 3
    monkeypatch.setattr("koopdqn.oracles.journal.LARGEST_JOURNAL", path.stat().st_size - 1)
    with pytest.raises(BadInputError, match="at most"):
        read_records(path)


def test_a_line_says_everything(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    filled(path, 2)
    asked = question(1)
    assert read_lines(path)[1] == {
        "kind": "answer",
        "number": 1,
        "episode": asked.episode,
        "step": asked.step,
        "pose": asked.pose.tolist(),
        "action": asked.action,
        "reached": asked.reached.tolist(),
        "predicted": asked.predicted.tolist(),
        "start": asked.start.tolist(),
        "reason": "far",
        "right": False,
        "better": None,
        "source": "clerk",
        "seconds": 0.25,
    }


@settings(max_examples=20)
@given(count=st.integers(0, 6), more=st.integers(0, 4))
def test_a_replay_gives_the_same_answers_and_asks_only_what_is_new(
    tmp_path_factory: pytest.TempPathFactory, count: int, more: int
) -> None:
    path = tmp_path_factory.mktemp("journal") / "feedback.jsonl"
    answers = filled(path, count)
    clerk = Clerk(thirds)
    oracle = JournalledOracle(clerk, path, 0)
    again = [oracle.answer(question(number)) for number in range(count + more)]
    assert again[:count] == answers
    assert [asked.pose.tolist() for asked in clerk.asked] == [
        question(number).pose.tolist() for number in range(count, count + more)
    ]
    assert oracle.questions == count + more
    entries = read_lines(path)
    assert [item["number"] for item in entries] == list(range(count + more))


def test_answers_that_a_checkpoint_holds_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    answers = filled(path, 5)
    clerk = Clerk(thirds)
    oracle = JournalledOracle(clerk, path, 3)
    assert oracle.questions == 3
    assert [oracle.answer(question(number)) for number in (3, 4)] == answers[3:]
    assert not clerk.asked
    oracle.answer(question(5))
    assert len(clerk.asked) == 1
    assert read_lines(path)[-1]["number"] == 5


def test_a_journal_shorter_than_the_checkpoint_says_is_refused(tmp_path: Path) -> None:
    filled(tmp_path / "feedback.jsonl", 2)
    with pytest.raises(BadInputError, match="must hold the 3 answers of the run, found 2"):
        JournalledOracle(Clerk(), tmp_path / "feedback.jsonl", 3)
    with pytest.raises(BadInputError, match="found 0"):
        JournalledOracle(Clerk(), tmp_path / "missing.jsonl", 1)


@pytest.mark.parametrize("field", ["episode", "step", "action", "pose"])
def test_a_replay_refuses_another_question(tmp_path: Path, field: str) -> None:
    path = tmp_path / "feedback.jsonl"
    filled(path, 3)
    asked = question(1)
    changed = {name: getattr(asked, name) for name in vars(asked)}
    changed[field] = np.nextafter(asked.pose, 9) if field == "pose" else changed[field] + 1
    clerk = Clerk()
    oracle = JournalledOracle(clerk, path, 1)
    with pytest.raises(BadInputError, match="answer 1 must be to the question the run asks") as caught:
        oracle.answer(Question(**changed))
    assert "\n" not in str(caught.value)
    assert not clerk.asked
    assert len(read_lines(path)) == 3


def test_a_last_line_torn_anywhere_is_dropped_and_asked_again(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    filled(path, 3)
    whole = path.read_bytes()
    start = whole[:-1].rfind(b"\n") + 1
    for end in (start, start + 1, start + 40, len(whole) - 2, len(whole) - 1):
        path.write_bytes(whole[:end])
        clerk = Clerk(thirds)
        oracle = JournalledOracle(clerk, path, 0)
        for number in range(3):
            oracle.answer(question(number))
        oracle.close()
        assert path.read_bytes() == whole, f"cut at {end - start} of {len(whole) - start}"
        assert len(clerk.asked) <= 1


def test_a_damaged_line_before_the_last_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    filled(path, 3)
    lines = path.read_text().splitlines()
    for damaged in ('{"kind": "ans', "[1, 2]", "7"):
        path.write_text("\n".join([lines[0], damaged, lines[2], ""]))
        with pytest.raises(BadInputError, match="line 2 must be a JSON object"):
            JournalledOracle(Clerk(), path, 0)


def test_a_journal_that_is_no_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    path.write_bytes(b"\xff\xfe\x00\n\x80\n")
    with pytest.raises(BadInputError, match="journal"):
        JournalledOracle(Clerk(), path, 0)


@pytest.mark.parametrize("missing", ["right", "source", "seconds"])
def test_an_answer_that_lacks_a_field_is_refused(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "feedback.jsonl"
    filled(path, 1)
    item = json.loads(path.read_text())
    del item[missing]
    path.write_text(json.dumps(item) + "\n")
    with pytest.raises(BadInputError, match="journal"):
        JournalledOracle(Clerk(), path, 0).answer(question(0))


def test_lines_of_other_kinds_are_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    answers = filled(path, 2)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], json.dumps({"kind": "note"}), lines[1], ""]))
    oracle = JournalledOracle(Clerk(), path, 0)
    assert [oracle.answer(question(number)) for number in range(2)] == answers


def test_a_journal_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="must be writable"):
        JournalledOracle(Clerk(), tmp_path / "no" / "such" / "feedback.jsonl", 0)


def test_closing_closes_the_oracle_too(tmp_path: Path) -> None:
    clerk = Clerk()
    JournalledOracle(clerk, tmp_path / "feedback.jsonl", 0).close()
    assert clerk.closed
