from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import Clerk
from questions import Reader, question, written

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import Answer
from koopdqn.oracles.journal import read_lines, read_records
from koopdqn.oracles.replay import JournalledOracle, ReplayOracle

YES, NO, SKIP = (Answer(right, "anna", 0.5) for right in (True, False, None))


@settings(max_examples=40)
@given(data=st.data())
def test_undoing_withdraws_the_latest_answers_that_stand(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("journal") / "feedback.jsonl"
    standing: list[int] = []
    answers: list[Answer] = []
    given_answers = 0
    for _ in range(data.draw(st.integers(1, 8))):
        undo = data.draw(st.integers(0, len(standing)))
        again = data.draw(st.booleans())
        del standing[len(standing) - undo :]
        answers.append(Answer(None if again else True, "anna", undo=undo, again=again))
        if not again:
            standing.append(given_answers)
            given_answers += 1
    standing.append(given_answers)
    told = written(path, [*answers, YES])
    records = read_records(path)
    assert [item.line.number for item in records.standing] == standing
    assert [item.answer for item in records.items] == told
    assert sum(answer.undo for answer in told) == sum(answer.undo for answer in answers)
    assert not any(answer.again for answer in told)


@settings(max_examples=30)
@given(undos=st.lists(st.integers(0, 2), min_size=1, max_size=6), position=st.integers(0, 6))
def test_a_run_that_goes_on_and_a_replay_are_told_the_same(
    tmp_path_factory: pytest.TempPathFactory, undos: list[int], position: int
) -> None:
    path = tmp_path_factory.mktemp("journal") / "feedback.jsonl"
    standing, answers = 0, []
    for undo in undos:
        possible = min(undo, standing)
        standing += 1 - possible
        answers.append(Answer(True, "anna", undo=possible))
    told = written(path, answers)
    position = min(position, len(told))
    again = JournalledOracle(Clerk(), path, position)
    assert [again.answer(question(number)) for number in range(position, len(told))] == told[position:]
    again.close()
    other = path.with_name("other.jsonl")
    replayed = JournalledOracle(ReplayOracle(path), other, 0)
    assert [replayed.answer(question(number)) for number in range(len(told))] == told
    replayed.close()
    assert other.read_bytes() == path.read_bytes()


def test_an_undo_is_on_disk_before_the_question_is_asked_again(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [YES, NO])
    reader = Reader([Answer(None, "anna", undo=1, again=True), Answer(None, "anna", undo=1, again=True), NO])
    oracle = JournalledOracle(reader, path, 2)
    assert oracle.answer(question(2)) == Answer(False, "anna", 0.5, undo=2)
    assert [len(asked.earlier) for asked in reader.asked] == [2, 1, 0]
    assert [line["kind"] for line in read_lines(path)] == ["answer", "answer", "undo", "undo", "answer"]
    assert [line["number"] for line in read_lines(path) if line["kind"] == "undo"] == [1, 0]


def test_an_undo_before_an_interruption_counts_when_the_run_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    told = written(path, [YES, NO, Answer(None, "anna", undo=1, again=True)][:2])
    reader = Reader([Answer(None, "anna", undo=1, again=True)])
    oracle = JournalledOracle(reader, path, 2)
    with pytest.raises(IndexError):
        oracle.answer(question(2))
    oracle.close()
    rest = JournalledOracle(Reader([YES]), path, 0)
    assert [rest.answer(question(number)) for number in range(3)] == [*told, Answer(True, "anna", 0.5, undo=1)]


def test_a_skipped_question_is_not_undone(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [YES, SKIP, Answer(False, "anna", undo=1)])
    assert [line["number"] for line in read_lines(path) if line["kind"] == "undo"] == [0]
    assert [item.withdrawn for item in read_records(path).items] == [True, False, False]


def test_no_more_can_be_undone_than_stands(tmp_path: Path) -> None:
    oracle = JournalledOracle(Reader([YES, Answer(True, "anna", undo=2)]), tmp_path / "feedback.jsonl", 0)
    oracle.answer(question(0))
    with pytest.raises(BadInputError, match="undo: must be 0 to 1, the answers that stand, found 2"):
        oracle.answer(question(1))


@pytest.mark.parametrize(("right", "better"), [(True, 3), (False, 0), (None, 0), (None, None), (True, None)])
def test_a_better_action_and_the_answer_must_agree(tmp_path: Path, right: bool | None, better: int | None) -> None:
    answer = Answer(right, "anna", better=better)
    oracle = JournalledOracle(Reader([answer]), tmp_path / "feedback.jsonl", 0)
    if better is None:
        assert oracle.answer(question(0)) == answer
        return
    with pytest.raises(BadInputError, match="right: must be true exactly if the better action is the one asked about"):
        oracle.answer(question(0))


def test_a_replay_that_is_asked_more_or_other_than_it_holds_says_so(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [YES, NO])
    oracle = JournalledOracle(ReplayOracle(path), tmp_path / "other.jsonl", 0)
    with pytest.raises(BadInputError, match="answer 0 must be to the question the run asks"):
        oracle.answer(question(1))
    for number in range(2):
        oracle.answer(question(number))
    with pytest.raises(BadInputError, match="must hold an answer to every question of the run, found 2 answers"):
        oracle.answer(question(2))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"kind":"undo","number":0,"before":2,"episode":0,"step":2}', "withdraw the latest answer that stands, 1"),
        ('{"kind":"edit","number":2,"right":true,"better":null,"source":"a","learned":false}', "0 to 1, found 2"),
        ('{"kind":"drop","number":5}', "0 to 1, found 5"),
        ('{"kind":"undo","number":-1,"before":2,"episode":0,"step":2}', "number: Input should be greater"),
        ('{"kind":"opinion","number":0}', "right: Field required"),
    ],
)
def test_a_line_that_cannot_be_is_refused(tmp_path: Path, line: str, message: str) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [YES, NO])
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(BadInputError, match=message) as caught:
        read_records(path)
    assert "line 3" in str(caught.value)


def test_answers_out_of_order_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [YES, NO, SKIP])
    lines = path.read_text().splitlines(keepends=True)
    path.write_text(lines[0] + lines[2])
    with pytest.raises(BadInputError, match="line 2: answers must be numbered in order, so 1 here, found 2"):
        read_records(path)


def test_an_action_that_is_never_right_is_no_better_one(tmp_path: Path) -> None:
    allowed = np.array([number > 3 for number in range(10)])
    asked = replace(question(0), number=0, choosable=allowed)
    oracle = JournalledOracle(Reader([Answer(False, "anna", 1.0, 2)]), tmp_path / "new.jsonl", 0)
    with pytest.raises(BadInputError, match=r"better: must be an action that can be right there, 4, 5, .*, found 2"):
        oracle.answer(asked)
    oracle.close()
    # Nor one that was edited in, or written by an earlier release.
    written(tmp_path / "old.jsonl", [Answer(False, "anna", 1.0, 2)])
    replayed = ReplayOracle(tmp_path / "old.jsonl")
    with pytest.raises(BadInputError, match=r"old\.jsonl: answer 0: better: must be an action that can be right"):
        replayed.answer(asked)
