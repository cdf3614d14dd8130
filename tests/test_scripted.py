from pathlib import Path

import numpy as np
from parts import Parts

from koopdqn.oracles.base import Oracle, Question
from koopdqn.oracles.scripted import ScriptedOracle, ScriptedOracleSettings
from koopdqn.pose import Array
from koopdqn.tasks.actions import reached_poses, within_tolerance
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import Workcell


def question(at: Array, action: int, reached: Array) -> Question:
    return Question(0, 0, at, at, action, reached, reached, "")


def test_it_says_right_where_the_demonstrator_would_be_within_tolerance(shelf_task: ShelfTask) -> None:
    oracle = ScriptedOracle(shelf_task)
    starts = shelf_task.draw_starts(np.random.default_rng(0), 30)
    reached = reached_poses(starts, shelf_task)
    wished = shelf_task.demonstrator.next_pose(starts)
    answers = set()
    for row, start in enumerate(starts):
        for action in range(10):
            answer = oracle.answer(question(start, action, reached[row, action]))
            assert answer.right == within_tolerance(reached[row, action], wished[row], shelf_task)
            answers.add(answer.right)
    assert answers == {True, False}


def test_where_the_demonstrator_goes_is_right_and_standing_still_is_wrong(shelf_task: ShelfTask) -> None:
    oracle, poses = ScriptedOracle(shelf_task), shelf_task.draw_starts(np.random.default_rng(1), 40)
    for here, there in zip(poses, shelf_task.demonstrator.next_pose(poses), strict=True):
        assert oracle.answer(question(here, 4, there)).right
        assert not oracle.answer(question(here, 4, here)).right


def test_some_legal_action_is_right_from_anywhere(shelf_task: ShelfTask) -> None:
    oracle, poses = ScriptedOracle(shelf_task), shelf_task.draw_starts(np.random.default_rng(2), 100)
    for here, reached in zip(poses, reached_poses(poses, shelf_task), strict=True):
        assert any(oracle.answer(question(here, action, reached[action])).right for action in (1, 4, 5, 6, 7, 8, 9))


def test_the_same_question_has_the_same_answer_whatever_the_seed(
    parts: Parts, workcell: Workcell, tmp_path: Path
) -> None:
    settings = ScriptedOracleSettings(name="expert")
    start = parts.task.nominal_start
    asked = question(start, 4, reached_poses(start[None], parts.task)[0, 4])
    one, other = (settings.open(workcell, seed, tmp_path) for seed in (0, 1))
    assert one.answer(asked) == other.answer(asked) == one.answer(asked)
    assert one.answer(asked).source == "expert"
    assert isinstance(one, Oracle)
