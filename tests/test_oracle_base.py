"""An oracle of one's own, as docs/feedback.md shows it."""

import re
import sys
from pathlib import Path

import pytest
from questions import question

from koopdqn.app import cli
from koopdqn.oracles.base import Oracle, OracleSettings
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
