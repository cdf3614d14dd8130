"""Questions put off during episodes and asked when these end."""

import hashlib
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_training import (
    FORGETFUL,
    UNCHECKED,
    assert_same_run,
    assert_spends_its_budget,
    small_trainer,
    untrusting,
)
from parts import Clerk, Parts
from questions import question
from small_run import SOON

from koopdqn.app import cli
from koopdqn.intent.reward import ASKED, CERTIFIED, REMEMBERED, IntentReward
from koopdqn.oracles.base import Answer, Asking, Earlier, Oracle, Place, Question
from koopdqn.oracles.file import question_object
from koopdqn.oracles.journal import read_records
from koopdqn.oracles.replay import JournalledOracle, ReplayOracle
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.oracles.terminal import screen
from koopdqn.oracles.terminal.screen import Shown, compose
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.checkpoint import read_checkpoint, save_checkpoint
from koopdqn.rl.questions import OpenAttempt, PutOffQuestions, answered, question_about
from koopdqn.rl.replay_buffer import Labelled
from koopdqn.tasks.workcell import Workcell

Make = Callable[..., Trainer]
SHAPED_BY = {"seed": 0}
NEAR_ONLY = {"reach_m": 0.005}
"""A yes extends trust by two steps, so that an episode puts off several questions that it does not settle."""


@pytest.fixture
def make(parts: Parts, workcell: Workcell, reward: IntentReward, trajectories: list[Array]) -> Make:
    """Make a small trainer whose model is trusted nowhere and that asks at the end of episodes."""

    def trainer(oracle: Oracle | None = None, **changes: Any) -> Trainer:
        changes = {"train": {"max_steps": 300, **UNCHECKED}, "asking": Asking(ask="episode", gather_most=10), **changes}
        return small_trainer(parts, workcell, untrusting(reward), trajectories, oracle, **changes)

    return trainer


def by_episode(asked: list[Question]) -> Iterator[list[Question]]:
    """Yield what was asked right after one another about one episode."""
    return (list(group) for _, group in groupby(asked, key=lambda each: each.episode))


def stored(trainer: Trainer, source: int) -> list[tuple[int, int, tuple[float, ...]]]:
    """Return step, action and pose of the experience whose reward came from a source."""
    held = trainer.state()[0]
    rows = held["replay/sources"] == source
    columns = (held[f"replay/{name}"][rows].tolist() for name in ("steps", "actions", "poses"))
    return [(step, action, tuple(pose)) for step, action, pose in zip(*columns, strict=True)]


def walk(trainer: Trainer, start: Array, count: int, action: int | None = None) -> list[OpenAttempt]:
    """Return attempts at an action, or of the likeliest, one after another from a pose (7,) on."""
    attempts: list[OpenAttempt] = []
    pose = start
    for step in range(count):
        evaluation = trainer.feedback.evaluate_actions(pose[None], np.array([step]))
        attempts.append(
            OpenAttempt(3, step, pose, start, int(evaluation.margin[0].argmax()) if action is None else action)
        )
        pose = evaluation.reached[0, attempts[-1].action]
    return attempts


def settle(trainer: Trainer, attempts: list[OpenAttempt], limit: int = 100) -> list[Labelled]:
    return list(answered(attempts, trainer.feedback, trainer.env.ask, limit))


@pytest.mark.parametrize("feedback", [FORGETFUL, NEAR_ONLY, {}])
def test_an_episodes_questions_come_together_and_in_order(make: Make, feedback: dict[str, Any]) -> None:
    clerk = Clerk()
    trainer = make(clerk, feedback=feedback)
    trainer.run()
    groups = list(by_episode(clerk.asked))
    assert len({group[0].episode for group in groups}) == len(groups), "nobody comes back to an episode"
    for group in groups:
        steps = [asked.step for asked in group]
        assert steps == sorted(set(steps))
        places = [asked.place for asked in group]
        assert [place and place.number for place in places] == list(range(1, len(group) + 1))
        assert all(place and place.expected >= place.number for place in places)
        if feedback is FORGETFUL:
            assert {place and place.expected for place in places} == {len(group)}
        assert len(group) <= 10


def test_asked_at_once_a_question_has_no_place(make: Make) -> None:
    clerk = Clerk()
    make(clerk, asking=Asking()).run()
    assert clerk.asked
    assert {asked.place for asked in clerk.asked} == {None}


def test_a_yes_stores_the_experience_and_pays_the_episode(make: Make, workcell: Workcell) -> None:
    clerk = Clerk()
    trainer = make(clerk, feedback=FORGETFUL, agent={"replay": 10_000})
    trainer.run()
    assert sorted(stored(trainer, ASKED)) == sorted((a.step, a.action, tuple(a.pose.tolist())) for a in clerk.asked)
    groups = {group[0].episode: group for group in by_episode(clerk.asked)}
    goals = [workcell.task.reached(np.array([asked.reached for asked in group])).sum() for group in groups.values()]
    size = trainer.feedback.reward.settings
    paid = [size.size * len(group) + size.goal * int(goal) for group, goal in zip(groups.values(), goals, strict=True)]
    assert [reward for reward in trainer.history.rewards if reward] == paid
    assert sum(trainer.history.lengths) == len(clerk.asked)


def test_a_no_is_stored_as_wrong_and_what_it_led_to_is_dropped(make: Make) -> None:
    clerk = Clerk(lambda asked: asked.place is not None and asked.place.number < 3)
    trainer = make(clerk, feedback=FORGETFUL, agent={"replay": 10_000})
    trainer.run()
    groups = list(by_episode(clerk.asked))
    assert max(len(group) for group in groups) == 3
    assert max(trainer.history.lengths) > 3, "episodes went on past the wrong action"
    assert len(stored(trainer, ASKED)) == len(clerk.asked)
    held = trainer.state()[0]
    asked = held["replay/sources"] == ASKED
    np.testing.assert_array_equal(held["replay/undone"][asked], held["replay/rewards"][asked] < 0)
    assert held["replay/undone"][asked].sum() == sum(len(group) == 3 for group in groups)


def test_without_stepping_back_a_no_drops_nothing(make: Make) -> None:
    clerk = Clerk(lambda asked: False)
    agent = {"trials": "chosen", "step_back": False, "bootstrap_undone": True}
    trainer = make(clerk, feedback=FORGETFUL, agent=agent, asking=Asking(ask="episode", gather_most=4))
    trainer.run()
    sizes = [len(group) for group in by_episode(clerk.asked)]
    assert max(sizes) == 4
    assert not trainer.state()[0]["replay/undone"].any()


def test_a_skip_stores_nothing_and_the_next_is_asked(make: Make) -> None:
    clerk = Clerk(lambda asked: None if asked.step % 2 else True)
    trainer = make(clerk, feedback=FORGETFUL, agent={"replay": 10_000})
    trainer.run()
    steps = {asked.step for asked in clerk.asked}
    assert {0, 1, 2} <= steps
    assert {step % 2 for step, _, _ in stored(trainer, ASKED)} == {0}
    silent = make(Clerk(lambda asked: None), train={"max_episodes": 20, "max_steps": 10**6}, feedback=FORGETFUL)
    silent.run()
    assert 20 <= len(silent.history.rewards) <= 24
    assert silent.history.labelled[ASKED] == 0


@pytest.mark.parametrize("most", [1, 3])
def test_so_many_questions_end_an_episode(make: Make, most: int) -> None:
    clerk = Clerk()
    trainer = make(clerk, feedback=FORGETFUL, asking=Asking(ask="episode", gather_most=most))
    trainer.run()
    assert {len(group) for group in by_episode(clerk.asked)} >= {most}
    assert max(trainer.history.lengths) == most


def test_what_a_yes_settles_is_not_asked_but_stored(make: Make, trajectories: list[Array]) -> None:
    clerk = Clerk()
    trainer = make(clerk, feedback={"reach_m": 0.02})
    attempts = walk(trainer, trajectories[0][60], 6)
    found = settle(trainer, attempts)
    assert [asked.step for asked in clerk.asked] == [0]
    assert clerk.asked[0].place == Place(1, 1)
    sources = [int(each.evaluation.source[each.rows[0], each.actions[0]]) for each in found]
    assert sources == [ASKED] + 5 * [CERTIFIED]
    assert all(each.rewards[0] > 0 for each in found)
    for each, attempt in zip(found, attempts, strict=True):
        assert each.evaluation.steps[each.rows[0]] == attempt.step
        np.testing.assert_array_equal(each.evaluation.poses[each.rows[0]], attempt.pose)
        np.testing.assert_array_equal(each.evaluation.starts[each.rows[0]], attempt.start)
        assert each.actions[0] == attempt.action


def test_a_remembered_no_ends_a_later_batch_without_a_question(make: Make, trajectories: list[Array]) -> None:
    clerk = Clerk(lambda asked: False)
    trainer = make(clerk, feedback={"extend": False, "remember_m": 0.004})
    attempts = walk(trainer, trajectories[0][60], 4, 5)
    assert [float(each.rewards[0]) for each in settle(trainer, attempts)] == [-1.0]
    again = settle(trainer, attempts)
    assert len(clerk.asked) == 1
    assert len(again) == 1
    assert again[0].evaluation.source[0, 5] == REMEMBERED


@pytest.mark.parametrize(("reach", "last"), [(0.0001, 1), (0.003, 2), (0.006, 3)])
def test_only_questions_that_a_yes_would_not_settle_count(
    make: Make, trajectories: list[Array], reach: float, last: int
) -> None:
    """The second question of steps of 2.1 mm along one axis is the first beyond the reach of a yes to the first."""
    trainer = make(feedback={"reach_m": reach})
    attempts = walk(trainer, trajectories[0][60], 4, 8)
    put_off = PutOffQuestions(Asking(ask="episode", gather_most=2), trainer.feedback, 2)
    full = [put_off.add(1, attempt) for attempt in attempts]
    assert full.index(True) == last
    restored = PutOffQuestions(Asking(ask="episode", gather_most=2), trainer.feedback, 2)
    restored.restore(put_off.state())
    assert restored.take(0) == put_off.take(0) == []
    for one, two in zip(restored.take(1), attempts, strict=True):
        assert (one.episode, one.step, one.action) == (two.episode, two.step, two.action)
        np.testing.assert_array_equal(one.pose, two.pose)
        np.testing.assert_array_equal(one.start, two.start)
    assert put_off.take(1)
    assert len(restored.state()["rows"]) == 0, "what was taken is held no more"


def test_an_episode_cut_at_its_limit_says_so(make: Make, trajectories: list[Array]) -> None:
    trainer = make(Clerk(), feedback=FORGETFUL)
    found = settle(trainer, walk(trainer, trajectories[0][60], 4, 8), limit=4)
    assert [each.truncated for each in found] == [False, False, False, True]
    wrong = make(Clerk(lambda asked: asked.step < 3), feedback=FORGETFUL)
    assert not any(each.truncated for each in settle(wrong, walk(wrong, trajectories[0][60], 4, 8), limit=4))


@pytest.mark.parametrize("when_spent", ["stop", "distrust", "scripted"])
def test_a_spent_budget_asks_no_more(make: Make, when_spent: str) -> None:
    assert_spends_its_budget(make, Clerk(), when_spent)


def undoing(workcell: Workcell) -> Oracle:
    """An expert who now and then withdraws an answer or two, within a batch or of an earlier one."""
    expert = ScriptedOracle(workcell.task)
    stray = {3: 1, 8: 2, 14: 2, 30: 1}

    class _Undoing(Oracle):
        def answer(self, question: Question) -> Answer:
            return replace(expert.answer(question), undo=min(stray.get(question.number, 0), len(question.earlier)))

    return _Undoing()


def test_a_run_killed_with_questions_pending_or_replayed_ends_as_if_never_stopped(
    make: Make, workcell: Workcell, tmp_path: Path
) -> None:
    settings: dict[str, Any] = {
        "agent": {"updates_per_round": 1, "warm_up": 20},
        "train": {"check_every": 20, "max_steps": 700},
        "feedback": NEAR_ONLY,
    }
    journal = tmp_path / "whole.jsonl"
    whole = make(JournalledOracle(undoing(workcell), journal, 0), **settings)
    saved: list[int] = []

    def save_once(_: object) -> None:
        if not saved and whole.questions > 8 and len(whole.state()[0]["put_off/rows"]) > 3:
            saved.append(whole.questions)
            save_checkpoint(tmp_path, whole, SHAPED_BY, 0.0)

    whole.run(save_once)
    assert saved
    assert saved[0] < whole.questions, "some answers must come after the checkpoint"
    assert any(record.withdrawn for record in read_records(journal).items)
    checkpoint = read_checkpoint(tmp_path, SHAPED_BY)
    assert checkpoint is not None
    assert len(checkpoint.arrays["put_off/poses"]) > 3
    written = journal.read_bytes()
    rest = make(JournalledOracle(undoing(workcell), journal, saved[0]), **settings)
    rest.restore(checkpoint.arrays, checkpoint.about["state"])
    assert rest.state()[0].keys() == checkpoint.arrays.keys()
    for name, values in rest.state()[0].items():
        np.testing.assert_array_equal(values, checkpoint.arrays[name], err_msg=name)
    rest.run()
    assert_same_run(rest, whole)
    assert journal.read_bytes() == written
    # Killed between two answers of one batch: the first is on disk, the second is asked.
    lines = written.splitlines(keepends=True)
    said = [(line["kind"], line["episode"]) for line in map(json.loads, lines)]
    cut = max(i for i in range(1, len(lines)) if said[i - 1] == said[i] and said[i][0] == "answer")
    assert cut > saved[0] + 1
    journal.write_bytes(b"".join(lines[:cut]))
    again = make(JournalledOracle(undoing(workcell), journal, saved[0]), **settings)
    # A run keeps the lists of the checkpoint that it goes on from.
    checkpoint = read_checkpoint(tmp_path, SHAPED_BY)
    assert checkpoint is not None
    again.restore(checkpoint.arrays, checkpoint.about["state"])
    again.run()
    assert_same_run(again, whole)
    assert journal.read_bytes() == written
    copy = tmp_path / "copy.jsonl"
    replayed = make(JournalledOracle(ReplayOracle(journal), copy, 0), **settings)
    replayed.run()
    assert_same_run(replayed, whole)
    assert copy.read_bytes() == written


def test_a_question_says_its_place_to_people_and_programs(parts: Parts, make: Make, trajectories: list[Array]) -> None:
    trainer, point = make(), trajectories[0][60]
    evaluation = trainer.feedback.evaluate_actions(point[None], np.array([7]))
    asked = question_about(OpenAttempt(12, 7, point, point, 8), trainer.feedback.reward, evaluation, 0, Place(2, 5))
    for place, said in ((Place(2, 5), "Question 2 of about 5 in the episode"), (None, "")):
        each = replace(asked, place=place)
        shown = [line.plain for line in compose(Shown(parts.task, "anna", each), 80, 24, pictures=False)]
        assert ("in the episode" in "\n".join(shown)) == bool(said)
        assert said in shown or not said
        told = json.loads(json.dumps(question_object(each)))["place"]
        assert told == (None if place is None else {"number": 2, "expected": 5})
    assert question(0).place is None


@pytest.mark.parametrize("action", range(10))
def test_the_longest_question_of_a_batch_fits_a_small_screen(
    parts: Parts, make: Make, trajectories: list[Array], action: int
) -> None:
    trainer, point = make(), trajectories[0][60]
    evaluation = trainer.feedback.evaluate_actions(point[None], np.array([107]))
    plain = question_about(
        OpenAttempt(1234, 107, point, point, action), trainer.feedback.reward, evaluation, 0, Place(12, 15)
    )
    asked = replace(
        plain,
        reason="x is 14.1 standard deviations from the demonstrations (limit 3)",
        progress="1800 updates, 244520 actions, 142 questions, success 100% of held-out starts",
        earlier=(Earlier(141, 3, 7, 3, right=False),),
    )
    text = "\n".join(line.plain for line in compose(Shown(parts.task, "anna", asked), 80, 24, pictures=True))
    assert "Question 12 of about 15 in the episode" in text
    for other, choice in enumerate(screen.choices(asked, parts.task)):
        assert f"{other}{'*' if other == action else ' '}{choice}" in text


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("oracle.ask=later", ("oracle.ask", "at_once", "episode", "later")),
        ("oracle.gather_most=0", ("oracle.gather_most", "1", "0")),
    ],
)
def test_a_wrong_setting_is_told(
    override: str, words: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", "task=shelf", override, f"out={tmp_path / 'run'}"]) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert all(word in told for word in words), told


def test_a_command_that_asks_at_episodes_ends_is_replayed_to_the_byte(tmp_path: Path) -> None:
    asking = ("trust=box", "trust.sigmas=0.8", "feedback.reach_m=0.006")
    command = ["train", *SOON, *asking, "oracle.ask=episode", "oracle.gather_most=4", "--json"]
    one, two, other = (tmp_path / name for name in ("one", "two", "other"))
    journal = one / "feedback.jsonl"
    assert cli.main([*command, f"out={one}"]) == 0
    assert cli.main([*command, "oracle=replay", f"journal={journal}", f"out={two}"]) == 0
    digests = {hashlib.sha256((folder / "policy.safetensors").read_bytes()).hexdigest() for folder in (one, two)}
    assert len(digests) == 1
    assert (two / "feedback.jsonl").read_bytes() == journal.read_bytes()
    lines = [json.loads(line) for line in journal.read_text().splitlines()]
    sizes = [len(list(group)) for _, group in groupby(lines, key=lambda line: line["episode"])]
    assert max(sizes) > 1, "some episode must have several questions"
    at_once = [item for item in command if "oracle." not in item]
    assert cli.main([*at_once, "oracle=replay", f"journal={journal}", f"out={other}"]) == 2
