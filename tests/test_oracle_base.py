"""An oracle of one's own, as docs/feedback.md shows it."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from parts import Parts
from questions import Reader, question

from koopdqn.app import cli
from koopdqn.errors import BadInputError
from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.base import Answer, Oracle, OracleSettings
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.pose import Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.settings import load_settings
from koopdqn.tasks.workcell import Workcell

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "feedback.md").read_text(encoding="utf-8")
NODE = {"target": "my_oracle.HighOracle", "name": "high", "budget": None, "when_spent": "stop"}


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (example,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(example.splitlines()) < 40
    (tmp_path / "my_oracle.py").write_text(example)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_oracle", raising=False)


@pytest.mark.usefixtures("module")
def test_the_example_answers(workcell: Workcell, tmp_path: Path) -> None:
    oracle = load_settings(NODE | {"lowest_m": 0.3}, OracleSettings, "oracle").open(workcell, 0, tmp_path)
    assert isinstance(oracle, Oracle)
    for height, right in ((0.31, True), (0.301, None), (0.29, False)):
        asked = question(0)
        asked.reached[2] = height
        answer = oracle.answer(asked)
        assert (answer.right, answer.source) == (right, "high")
    oracle.learning("5 updates")
    oracle.close()


@pytest.mark.usefixtures("module")
def test_its_fields_are_settings_of_the_command_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = ["train", "oracle=custom", f"out={tmp_path / 'run'}"]
    assert cli.main([*given, "oracle.target=my_oracle.HighOracle", "+oracle.lowest_m=-1"]) == 2
    assert "oracle.lowest_m" in capsys.readouterr().err
    assert cli.main(given) == 2
    assert "oracle.target: must be given" in capsys.readouterr().err
    assert cli.main([*given, "oracle.target=my_oracle.Nobody"]) == 2


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"right": "no"}, "right: must be True, False or None, found 'no'"),
        ({"right": 0.3}, "right: must be True, False or None, found 0.3"),
        ({"right": 1}, "right: must be True, False or None, found 1"),
        ({"source": 3}, "source: must be a text that is not empty, found 3"),
        ({"source": None}, "source: must be a text that is not empty, found None"),
        ({"seconds": float("nan")}, "seconds: must be a finite number, 0 or above, found nan"),
        ({"better": "up"}, "better: must be a whole number or None, found 'up'"),
        ({"better": True}, "better: must be a whole number or None, found True"),
        ({"undo": 0.5}, "undo: must be a whole number, found 0.5"),
    ],
)
def test_an_answer_holds_what_it_may_hold(given: dict[str, Any], said: str) -> None:
    with pytest.raises(BadInputError, match=re.escape(said)):
        Answer(**{"right": True, "source": "anna", **given})


def test_numpys_own_kinds_are_kept_in_a_journal(tmp_path: Path) -> None:
    answer: Any = Answer(np.bool_(False), "anna", np.float32(0.5), np.int64(2))  # type: ignore[arg-type]  # as numpy gives
    oracle = JournalledOracle(Reader([answer]), tmp_path / "feedback.jsonl", 0)
    assert oracle.answer(question(0)) == Answer(False, "anna", 0.5, 2)
    assert (tmp_path / "feedback.jsonl").read_text().count("\n") == 1


@pytest.mark.parametrize("said", [True, None, Answer(False, "anna", better=99)])
def test_what_is_no_answer_is_refused_with_and_without_a_journal(
    parts: Parts, reward: IntentReward, trajectories: list[Array], tmp_path: Path, said: Any
) -> None:
    path, expected = tmp_path / "feedback.jsonl", "must return a koopdqn|must be an action from 0 to 9, found 99"
    with pytest.raises(BadInputError, match=expected):
        JournalledOracle(Reader([said]), path, 0).answer(question(0))
    assert path.read_bytes() == b""
    asked, evaluation = question(0), reward.evaluate_actions(trajectories[0][:1], np.array([0]))
    with pytest.raises(BadInputError, match=expected):
        Feedback(reward, Reader([said]), parts.feedback).ask(asked, evaluation, 0)
