from dataclasses import replace

import numpy as np
import pytest
from helpers_unfolding import shaped
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import Parts
from report_runs import knife_parts
from rich.text import Text

from koopdqn.oracles.base import Answer, Earlier, Question
from koopdqn.oracles.terminal import screen
from koopdqn.oracles.terminal.picture import SituationCamera, magnification, magnified
from koopdqn.oracles.terminal.screen import Shown, compose, help_lines
from koopdqn.oracles.terminal.window import region
from koopdqn.pose import POSITION, QUATERNION, position_distance, rotation_distance
from koopdqn.tasks.actions import COUNT, reached_poses
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import Workcell


@pytest.fixture(scope="module")
def asked(parts: Parts) -> Question:
    start = parts.task.nominal_start
    candidates = reached_poses(start[None], parts.task)[0]
    earlier = (Earlier(41, 3, 7, 4, False),)
    return Question(
        12,
        40,
        start,
        start,
        6,
        candidates[6],
        candidates[1],
        "x is 4.1 standard deviations from the demonstrations (limit 3)",
        number=42,
        left=18,
        candidates=candidates,
        progress="750 updates, 4000 actions, 42 questions",
        earlier=earlier,
    )


@pytest.fixture(scope="module")
def knife() -> Parts:
    return knife_parts()


@settings(max_examples=60)
@given(width=st.integers(20, 240), height=st.integers(8, 80), pictures=st.booleans(), helps=st.booleans())
def test_a_screen_fits_its_terminal(
    parts: Parts, asked: Question, width: int, height: int, pictures: bool, helps: bool
) -> None:
    place = region(width, height, pictures=pictures)
    lines = [Text("▀" * place.width)] * place.rows
    shown = Shown(parts.task, "anna", asked, "a status " * 40, lines, 38.0, help=helps)
    composed = compose(shown, width, height, pictures=pictures)
    assert len(composed) == height
    assert all(line.cell_len <= width for line in composed)
    assert composed[-1].cell_len < width, "a full last line would scroll"
    assert place.width <= width
    assert place.rows + 1 < height


def test_a_screen_says_the_leg_of_a_path_that_turns_back_and_of_no_other(parts: Parts, asked: Question) -> None:
    twice = shaped("there and back twice")
    for begun, said in zip(twice.legs(twice.nominal_start), ("1 of 4", "2 of 4", "3 of 4", "4 of 4"), strict=True):
        question = replace(asked, pose=begun, start=begun)
        (head, *_) = compose(Shown(twice, "anna", question, "", [], 38.0), 120, 40, pictures=False)
        assert f"step 40   leg {said}" in head.plain
    (head, *_) = compose(Shown(parts.task, "anna", asked, "", [], 38.0), 120, 40, pictures=False)
    assert "leg" not in head.plain


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_a_screen_says_all_that_an_answer_needs(parts: Parts, asked: Question, width: int, height: int) -> None:
    shown = Shown(parts.task, "anna", asked, "Answered: wrong", [], 38.0)
    lines = [line.plain for line in compose(shown, width, height, pictures=True)]
    text = " ".join(" ".join(lines).split())
    words = ("question 42, 18 left", "episode 12", "step 40", "anna", "moves along +y", "2.1 mm", "Asked because")
    for word in (*words, "standard deviations", "750 updates", "answer 41, +x: wrong", "y right", "q pause"):
        assert word in text, word
    for action in range(COUNT):
        mark = "*" if action == asked.action else " "
        assert f"{action}{mark}{screen.choices(asked, parts.task)[action]}" in text
    assert lines[-1] == "Answered: wrong"


def test_the_help_is_whole_on_a_small_screen(parts: Parts, asked: Question) -> None:
    text = "\n".join(line.plain for line in compose(Shown(parts.task, "anna", asked, help=True), 80, 24, pictures=True))
    assert all(line in text for line in help_lines(asked))


@pytest.mark.parametrize(("width", "height"), [(40, 24), (60, 20), (66, 24), (80, 24)])
def test_keys_and_help_are_whole_on_a_narrow_screen(parts: Parts, asked: Question, width: int, height: int) -> None:
    lines = [line.plain for line in compose(Shown(parts.task, "anna", asked), width, height, pictures=True)]
    for key in ("y right", "0-9 better action", "s skip", "u undo", "p big picture", "? help", "q pause"):
        assert any(key in line for line in lines), key
    helps = compose(Shown(parts.task, "anna", asked, help=True), width, height, pictures=True)
    words = " ".join(" ".join(line.plain for line in helps).split())
    assert height < 24 or "right: a person could have gone this way" in words
    assert width < 60 or "Any key goes back to the question." in words


def test_on_a_small_screen_a_long_answer_and_wish_are_whole(knife: Parts, asked: Question) -> None:
    start = knife.task.nominal_start
    ends = reached_poses(start[None], knife.task)[0]
    given = replace(
        asked,
        pose=start,
        reached=ends[4],
        predicted=ends[3],
        candidates=np.vstack([ends, ends[3]]),
        choosable=np.ones(COUNT + 1, dtype=bool),
    )
    text = "\n".join(line.plain for line in compose(Shown(knife.task, "anna", given), 80, 24, pictures=True))
    assert screen.opinion(given) in text
    for key, choice in zip(screen.CHOICE_KEYS, screen.choices(given, knife.task), strict=True):
        assert f"{key}{'*' if int(key, 36) == asked.action else ' '}{choice}" in text


def test_the_models_suggestion_is_named_where_there_is_one(parts: Parts, asked: Question) -> None:
    assert asked.candidates is not None
    suggesting = replace(asked, candidates=np.vstack([asked.candidates, asked.predicted]), choosable=np.ones(11, bool))
    for question, named in ((asked, False), (suggesting, True)):
        for shown in (Shown(parts.task, "anna", question), Shown(parts.task, "anna", question, help=True)):
            text = "\n".join(line.plain for line in compose(shown, 80, 24, pictures=True))
            assert ("0-9 m" in text) is named
            assert "0-9" in text


def test_only_actions_that_can_be_right_can_be_named(shelf_task: ShelfTask, asked: Question) -> None:
    assert screen.choosable(asked, shelf_task).tolist() == [i not in (0, 2, 3) for i in range(COUNT)]
    nothing = replace(asked, choosable=np.zeros(COUNT, dtype=bool))
    assert not screen.choosable(nothing, shelf_task).any()
    assert set(screen.choices(nothing, shelf_task)) == {"-"}


def test_the_amounts_are_those_of_the_poses(shelf_task: ShelfTask, asked: Question) -> None:
    there = position_distance(asked.reached, shelf_task.goal)
    assert screen.moved(asked).split() == ["2.1", "mm", "0.0°"]
    assert screen.remaining(asked, shelf_task).split()[0] == f"{1e3 * there:.1f}"
    gain = 1e3 * (position_distance(asked.pose, shelf_task.goal) - there)
    assert screen.nearer(asked, shelf_task) == f"{abs(gain):.1f} mm {'nearer' if gain >= 0 else 'farther'}"
    same = replace(asked, predicted=asked.reached)
    assert screen.opinion(same) == "2.1 mm, 0° off it"
    assert screen.told(Answer(False, "anna", better=8)) == "wrong: better +z"


@settings(max_examples=30)
@given(seed=st.integers(0, 999), times=st.floats(1, 100))
def test_a_magnified_motion_keeps_its_direction(seed: int, times: float) -> None:
    rng = np.random.default_rng(seed)
    before = rng.normal(size=7)
    before[QUATERNION] /= np.linalg.norm(before[QUATERNION])
    after = magnified(before, before + np.concatenate([rng.normal(size=3) * 1e-3, np.zeros(4)]), 1.0)
    far = magnified(before, after, times)
    assert np.allclose((far - before)[POSITION], times * (after - before)[POSITION])
    assert rotation_distance(far, before) < 1e-6


@pytest.mark.draws
def test_the_picture_shows_the_motion_larger_and_marks_where_things_are(workcell: Workcell, asked: Question) -> None:
    times = magnification(asked)
    assert times * 0.0021 == pytest.approx(0.08, rel=0.01)
    camera = SituationCamera(workcell, (120, 90))
    try:
        situation = camera.picture(asked)
        begun = camera.picture(asked, 0.0)
    finally:
        camera.close()
    assert situation.image.shape == (90, 120, 3)
    assert situation.times == times
    assert not np.array_equal(situation.image, begun.image), "the arm stands elsewhere at the motion's beginning"
    for mark in "bgrm":
        x, y = situation.marks[mark]
        assert 0 <= x < 1
        assert 0 <= y < 1


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_the_two_columns_of_keys_stand_apart_and_whole(asked: Question, width: int, height: int) -> None:
    task = knife_parts().task
    start = task.nominal_start
    there = replace(asked, pose=start, candidates=reached_poses(start[None], task)[0])
    lines = [line.plain for line in compose(Shown(task, "anna", there), width, height, pictures=True)]
    texts = screen.choices(there, task)
    for action in range(COUNT // 2):
        (row,) = [line for line in lines if f"{action} {texts[action]}  " in line]
        assert row.endswith(f"{action + COUNT // 2}{'*' if action + 5 == asked.action else ' '}{texts[action + 5]}")
