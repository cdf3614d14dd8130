import json
import os
import threading
from pathlib import Path

import numpy as np
import pytest
from questions import question

from koopdqn.errors import BadInputError
from koopdqn.oracles.base import Answer, PauseRequested, Question
from koopdqn.oracles.file import FileOracle, FileOracleSettings


def numbered(number: int) -> Question:
    plain = question(number)
    return Question(**{**vars(plain), "number": number, "candidates": np.zeros((10, 7))})


def opened(folder: Path, answers: str = "") -> FileOracle:
    (folder / "answers").write_text(answers)
    return FileOracle(folder / "questions", folder / "answers", "gui")


def test_questions_and_answers_pass_through_pipes(tmp_path: Path) -> None:
    questions, answers = tmp_path / "questions", tmp_path / "answers"
    os.mkfifo(questions)
    os.mkfifo(answers)

    def program() -> None:
        with questions.open() as asked, answers.open("w") as said:
            for _ in range(3):
                item = json.loads(asked.readline())
                said.write(json.dumps({"number": item["number"], "right": item["number"] != 1}) + "\n")
                said.flush()

    other = threading.Thread(target=program)
    oracle = FileOracle(questions, answers, "gui")
    other.start()
    said = [oracle.answer(numbered(number)) for number in range(3)]
    other.join()
    oracle.close()
    assert [answer.right for answer in said] == [True, False, True]
    assert {answer.source for answer in said} == {"gui"}


def test_a_question_holds_all_that_a_program_needs(tmp_path: Path) -> None:
    oracle = opened(tmp_path, '{"number": 5, "right": null}\n')
    asked = numbered(5)
    assert oracle.answer(asked).right is None
    item = json.loads((tmp_path / "questions").read_text())
    assert item.pop("kind") == "question"
    assert np.array_equal(item.pop("candidates"), np.zeros((10, 7)))
    for key, value in item.items():
        assert np.array_equal(value, getattr(asked, key)) if isinstance(value, list) else value == getattr(asked, key)


def test_lines_of_earlier_questions_are_passed_over(tmp_path: Path) -> None:
    oracle = opened(tmp_path, "".join(f'{{"number": {n}, "right": false}}\n' for n in range(3)))
    assert oracle.answer(numbered(2)).right is False


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ({"right": True, "source": "anna"}, Answer(True, "anna")),
        ({"better": 0}, Answer(True, "gui", better=0)),
        ({"better": 4}, Answer(False, "gui", better=4)),
        ({"right": False, "undo": 2}, Answer(False, "gui", undo=2)),
        ({}, Answer(None, "gui")),
    ],
)
def test_what_a_line_says(tmp_path: Path, line: dict[str, object], expected: Answer) -> None:
    answer = opened(tmp_path, json.dumps({"number": 0, **line}) + "\n").answer(numbered(0))
    assert Answer(**{**vars(answer), "seconds": 0.0}) == expected


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("yes", "a line must be an answer as JSON"),
        ('{"right": true}', "number: Field required"),
        ('{"number": 0, "right": "yes"}', "right: Input should be a valid boolean"),
        ('{"number": 0, "wright": true}', "wright: Extra inputs"),
        ('{"number": 3, "right": true}', "number: must be at most 0, found 3"),
        ('{"number": 0, "better": 12}', "better: Input should be less than 12"),
    ],
)
def test_what_is_no_answer_is_refused(tmp_path: Path, line: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        opened(tmp_path, line + "\n").answer(numbered(0))


def test_the_other_program_may_pause_the_run(tmp_path: Path) -> None:
    with pytest.raises(PauseRequested):
        opened(tmp_path, '{"number": 0, "pause": true}\n').answer(numbered(0))


def test_a_pause_in_a_file_that_is_kept_does_not_pause_the_run_that_goes_on(tmp_path: Path) -> None:
    pause, right = '{"number": 2, "pause": true}\n', '{"number": 2, "right": true}\n'
    for _ in range(2):
        with pytest.raises(PauseRequested):
            opened(tmp_path, pause).answer(numbered(2))
        (tmp_path / "questions").write_text("")
    with pytest.raises(PauseRequested):
        opened(tmp_path, pause + right).answer(numbered(2))
    assert opened(tmp_path, pause + right).answer(numbered(2)).right
    oracle = opened(tmp_path, pause)
    for line in (right, pause.replace("2", "3")):
        with (tmp_path / "answers").open("a") as answers:
            answers.write(line)
    assert oracle.answer(numbered(2)).right
    # What is written while it waits pauses it.
    with pytest.raises(PauseRequested):
        oracle.answer(numbered(3))


def test_the_answers_of_another_run_are_refused(tmp_path: Path) -> None:
    answers = "".join(f'{{"number": {n}, "right": true}}\n' for n in range(2))
    first = opened(tmp_path, answers)
    assert all(first.answer(numbered(number)).right for number in range(2))
    # The same question once more, as where a run goes on.
    assert opened(tmp_path, answers).answer(numbered(1)).right
    other = Question(**{**vars(numbered(1)), "pose": numbered(1).pose + 1e-3})
    with pytest.raises(BadInputError, match=r"question 1 of this run, found the answer to another one, .* remove both"):
        opened(tmp_path, answers).answer(other)
    # What is written now answers what is asked now.
    oracle = opened(tmp_path)
    threading.Timer(0.1, lambda: (tmp_path / "answers").write_text('{"number": 1, "right": false}\n')).start()
    assert oracle.answer(other).right is False


@pytest.mark.parametrize("left", ["", "no json\n", "[1]\n", "{}\n"])
def test_whatever_the_questions_file_holds_is_no_question(tmp_path: Path, left: str) -> None:
    (tmp_path / "questions").write_text(left)
    with pytest.raises(PauseRequested):
        opened(tmp_path, '{"number": 0, "pause": true}\n').answer(numbered(0))


def test_files_are_named_before_any_work(tmp_path: Path) -> None:
    def check(questions: Path | None, answers: Path | None) -> None:
        FileOracleSettings(name="file", questions=questions, answers=answers).check()

    check(tmp_path / "q", tmp_path / "a")
    with pytest.raises(BadInputError, match=r"oracle.questions: must name a file or a pipe, found nothing"):
        check(None, tmp_path / "a")
    with pytest.raises(BadInputError, match=r"oracle.answers: must name a file or a pipe, found a folder"):
        check(tmp_path / "q", tmp_path)
    with pytest.raises(BadInputError, match="another file"):
        check(tmp_path / "q", tmp_path / "q")
