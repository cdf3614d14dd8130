import json
from pathlib import Path
from unittest.mock import MagicMock

import pytest
from parts import Clerk
from questions import question, written
from small_run import SMALL

from koopdqn.app import cli
from koopdqn.app.api import load_config
from koopdqn.errors import BadInputError
from koopdqn.oracles import repair
from koopdqn.oracles.base import Answer
from koopdqn.oracles.journal import read_lines, read_records
from koopdqn.oracles.repair import summarise
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.tasks.workcell import Workcell


def journal(folder: Path, teacher: str, rights: list[bool | None]) -> Path:
    path = folder / f"{teacher}.jsonl"
    written(path, [Answer(right, teacher, 1.0) for right in rights])
    return path


def change(path: Path, number: int, text: str, *, learned: int = 0, drop_later: bool = False) -> None:
    repair.edit(path, number, text, None, learned, drop_later=drop_later)


def test_an_edit_is_a_new_line_and_the_run_is_told_the_new_answer(tmp_path: Path) -> None:
    path = journal(tmp_path, "anna", [True, False, None])
    before = path.read_bytes()
    change(path, 1, "7")
    assert path.read_bytes().startswith(before)
    assert [read_lines(path)[-1][key] for key in ("kind", "source")] == ["edit", "editor"]
    oracle = JournalledOracle(Clerk(), path, 0)
    told = [oracle.answer(question(number)) for number in range(3)]
    assert [(answer.right, answer.better) for answer in told] == [(True, None), (False, 7), (None, None)]


@pytest.mark.parametrize(
    ("text", "right", "better"),
    [("right", True, None), ("N", False, None), ("skip", None, None), ("0", True, 0), ("9", False, 9)],
)
def test_what_an_answer_may_be(text: str, right: bool | None, better: int | None) -> None:
    assert repair.parse_answer(text, 0) == (right, better)


@pytest.mark.parametrize("text", ["", "10", "maybe", "²", "-1"])
def test_what_no_answer_is(text: str) -> None:
    with pytest.raises(BadInputError, match="must be right, wrong, skip or a better action from 0 to 9"):
        repair.parse_answer(text, 0)


def test_m_is_the_models_suggestion_where_it_is_an_action(tmp_path: Path) -> None:
    path = journal(tmp_path, "anna", [False, False])
    # As a run with continuous actions writes it: the first question is about the suggestion.
    path.write_text(path.read_text().replace('"action": 1', '"action": 10'))
    change(path, 0, "M")
    line = read_records(path).items[0].line
    assert (line.right, line.better) == (False, 10)
    assert repair.parse_answer("m", 10, continuous=True) == (True, 10)
    table_1 = journal(tmp_path, "bert", [True])
    with pytest.raises(BadInputError, match="a better action from 0 to 9, found 'm'"):
        change(table_1, 0, "m")


def test_a_run_that_learned_from_an_answer_refuses_its_edit_and_a_new_one_takes_it(tmp_path: Path) -> None:
    path = journal(tmp_path, "anna", [True, True, True])
    change(path, 1, "wrong", learned=2)
    with pytest.raises(BadInputError, match="answer 1 must be the one the run has learned from"):
        JournalledOracle(Clerk(), path, 2)
    oracle = JournalledOracle(Clerk(), path, 1)
    assert oracle.answer(question(1)).right is False


def test_what_was_withdrawn_is_not_edited(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [Answer(True, "anna"), Answer(True, "anna", undo=1)])
    with pytest.raises(BadInputError, match="must be that of an answer that stands, found 0"):
        change(path, 0, "wrong")


def test_a_skip_before_an_undo_is_not_answered_later(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    skip, no = Answer(None, "anna"), Answer(False, "anna")
    written(path, [no, skip, Answer(False, "anna", undo=1), skip])
    with pytest.raises(BadInputError, match="skipped question before an answer was withdrawn, found 1"):
        change(path, 1, "wrong")
    change(path, 3, "wrong")
    assert read_records(path).items[3].line.right is False
    other = tmp_path / "bert.jsonl"
    written(other, [Answer(False, "bert"), Answer(True, "bert"), Answer(False, "bert")])
    repair.merge([path, other], tmp_path / "merged.jsonl")
    assert read_records(tmp_path / "merged.jsonl").items[1].line.right is None


def test_a_skip_before_an_undo_that_waits_for_an_answer_is_not_answered(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [Answer(True, "anna"), Answer(None, "anna")])
    with path.open("a", encoding="utf-8") as file:
        file.write('{"kind": "undo", "number": 0, "before": 2, "episode": 0, "step": 0}\n')
    assert read_records(path).pending == 1
    with pytest.raises(BadInputError, match="skipped question before an answer was withdrawn, found 1"):
        change(path, 1, "wrong")
    change(path, 1, "wrong", drop_later=True)


def test_dropping_what_is_later_asks_it_anew(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    yes = Answer(True, "anna")
    written(path, [yes, yes, Answer(True, "anna", undo=2), yes])
    assert [item.withdrawn for item in read_records(path).items] == [True, True, False, False]
    change(path, 1, "wrong", drop_later=True)
    records = read_records(path)
    assert [(item.line.right, item.withdrawn) for item in records.items] == [(True, False), (False, False)]
    clerk = Clerk()
    oracle = JournalledOracle(clerk, path, 0)
    for number in range(3):
        oracle.answer(question(number))
    oracle.close()
    assert len(clerk.asked) == 1
    assert len(read_records(path).items) == 3


def test_merging_keeps_the_first_lets_most_decide_and_overwrites_nothing(tmp_path: Path) -> None:
    first = journal(tmp_path, "anna", [True, True, False, True])
    others = [journal(tmp_path, "bert", [True, False, None]), journal(tmp_path, "cleo", [True, False, True])]
    out = tmp_path / "merged.jsonl"
    merged = repair.merge([first, *others], out)
    assert (merged.answers, merged.opinions, merged.changed, merged.left_out) == (4, 6, 1, 0)
    items = read_records(out).items
    assert [item.line.right for item in items] == [True, False, False, True]
    assert out.read_bytes().startswith(first.read_bytes())
    with pytest.raises(BadInputError, match="must name a new file"):
        repair.merge([first, *others], out)
    with pytest.raises(BadInputError, match="2 or more"):
        repair.merge([first], tmp_path / "alone.jsonl")


def test_a_teacher_has_one_voice_however_many_journals_hold_it(tmp_path: Path) -> None:
    first = journal(tmp_path, "anna", [True])
    others = []
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        others.append(journal(tmp_path / folder, "bert", [False]))
    merged = tmp_path / "merged.jsonl"
    assert repair.merge([first, *others], merged).changed == 0
    assert repair.merge([merged, others[0]], tmp_path / "again.jsonl").changed == 0
    assert repair.merge([merged, journal(tmp_path, "cleo", [False])], tmp_path / "more.jsonl").changed == 1


def test_agreement_counts_what_both_answered(tmp_path: Path) -> None:
    paths = [
        journal(tmp_path, "anna", [True, True, False, None]),
        journal(tmp_path, "bert", [True, False, False, True]),
    ]
    summary = summarise([read_records(path) for path in paths])
    (pair,) = summary.agreement
    assert (pair.one, pair.other, pair.questions, pair.same) == ("anna", "bert", 3, 2)
    assert [(item.name, item.answers, item.skipped) for item in summary.teachers] == [("anna", 4, 1), ("bert", 4, 0)]
    merged = tmp_path / "merged.jsonl"
    repair.merge(paths, merged)
    assert summarise([read_records(merged)]).agreement == summary.agreement


def test_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    journal(folder, "feedback", [True, False, None])
    assert cli.main(["feedback", "edit", str(folder), "2", "4", "--teacher", "bert"]) == 0
    assert "answer 2 is now wrong (better +x), by bert" in capsys.readouterr().out
    assert cli.main(["feedback", "show", str(folder)]) == 0
    shown = capsys.readouterr().out
    assert "edited" in shown
    assert "bert" in shown
    assert cli.main(["feedback", "show", f"run={folder}"]) == 0
    assert capsys.readouterr().out == shown
    assert cli.main(["feedback", "show", str(folder), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["answers"] == 3
    out = tmp_path / "merged.jsonl"
    other = journal(tmp_path, "cleo", [False])
    assert cli.main(["feedback", "merge", str(folder), str(other), "--out", str(out)]) == 0
    assert cli.main(["feedback", "show", str(tmp_path / "nowhere")]) == 2
    assert "must name a journal or a run folder that holds feedback.jsonl" in capsys.readouterr().err


def test_an_edit_of_what_a_run_has_learned_from_is_told_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    given = (*SMALL, "task=shelf", "trust=nowhere", "train.max_steps=6000")
    assert cli.main(["train", *given, f"out={folder}"]) == 1
    asked = json.loads((folder / "train.json").read_text())["oracle_queries"]
    assert asked == len(read_records(folder / "feedback.jsonl").items) > 1
    capsys.readouterr()
    assert cli.main(["feedback", "edit", str(folder), str(asked - 1), "2"]) == 2
    assert "an action that can be right in the run's task, 1, 4, 5" in " ".join(capsys.readouterr().err.split())
    assert cli.main(["feedback", "edit", str(folder), str(asked - 1), "skip"]) == 0
    assert f"has learned from answer {asked - 1} already and cannot go on" in capsys.readouterr().err
    assert read_records(folder / "feedback.jsonl").items[-1].line.right is None


@pytest.mark.parametrize("teacher", ["", "  ", "a\nb", "a\x1b[1m"])
def test_who_edits_has_a_name_on_one_line(tmp_path: Path, teacher: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = journal(tmp_path, "anna", [True])
    before = path.read_bytes()
    assert cli.main(["feedback", "edit", str(path), "0", "wrong", "--teacher", teacher]) == 2
    assert "--teacher: must be a name on one line, found" in capsys.readouterr().err
    assert path.read_bytes() == before


def test_without_a_subcommand_the_help_is_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["feedback"]) == 0
    told = capsys.readouterr()
    assert "merge" in told.out
    assert not told.err


def test_an_edited_answer_that_is_what_it_was_again_is_what_the_run_learned_from(tmp_path: Path) -> None:
    path = journal(tmp_path, "anna", [True, True])
    change(path, 0, "wrong", learned=1)
    change(path, 0, "right", learned=1)
    assert JournalledOracle(Clerk(), path, 1).caught_up is False
    change(path, 0, "2", learned=1)
    with pytest.raises(BadInputError, match="answer 0 must be the one"):
        JournalledOracle(Clerk(), path, 1)


def test_a_new_run_goes_on_from_an_edited_journal(
    tmp_path: Path, workcell: Workcell, monkeypatch: pytest.MonkeyPatch
) -> None:
    # There is no terminal here.
    monkeypatch.setattr("koopdqn.oracles.terminal.oracle.TerminalOracle", MagicMock())
    path, folder = journal(tmp_path, "anna", [True, True]), tmp_path / "run"
    folder.mkdir()
    change(path, 0, "wrong", learned=2)
    settings = load_config("oracle=terminal", f"journal={path}").oracle
    settings.open(workcell, 0, folder)
    assert [item.line.right for item in read_records(folder / "feedback.jsonl").items] == [False, True]
    # As after its first checkpoint.
    assert JournalledOracle(Clerk(), folder / "feedback.jsonl", 2).questions == 2


def test_who_is_overruled_keeps_a_voice_in_any_order(tmp_path: Path) -> None:
    no: list[bool | None] = [True, True, True, False]
    yes: list[bool | None] = [True] * 4
    paths = {name: journal(tmp_path, name, no if name in "ade" else yes) for name in "abcde"}
    at_once, first, in_two = (tmp_path / f"{name}.jsonl" for name in ("once", "first", "two"))
    repair.merge(list(paths.values()), at_once)
    repair.merge([paths[name] for name in "abc"], first)
    assert [item.line.right for item in read_records(first).items] == yes
    (pair,) = (each for each in summarise([read_records(first)]).agreement if (each.one, each.other) == ("a", "b"))
    assert (pair.questions, pair.same) == (4, 3)
    repair.merge([first, paths["d"], paths["e"]], in_two)
    others = tmp_path / "others.jsonl"
    repair.merge([paths["a"], first, paths["d"], paths["e"]], others)
    for path in (at_once, in_two, others):
        assert [item.line.right for item in read_records(path).items] == no


def test_what_was_withdrawn_is_not_merged(tmp_path: Path) -> None:
    path = tmp_path / "feedback.jsonl"
    written(path, [Answer(False, "anna"), Answer(True, "anna", undo=1)])
    others = [journal(tmp_path, name, [True, True]) for name in ("bert", "cleo")]
    assert repair.merge([path, *others], tmp_path / "merged.jsonl").changed == 0


def test_a_faulty_line_is_told_by_its_place_in_the_file(tmp_path: Path) -> None:
    path = journal(tmp_path, "anna", [True, True])
    path.write_text("\n\n" + path.read_text().replace('"number": 1', '"number": 9'))
    with pytest.raises(BadInputError, match=r"line 4: answers must be numbered in order"):
        read_records(path)


def test_a_journal_without_answers_has_none_to_edit(tmp_path: Path) -> None:
    (tmp_path / "feedback.jsonl").touch()
    with pytest.raises(BadInputError, match="found 0, and a journal without answers"):
        change(tmp_path / "feedback.jsonl", 0, "right")
