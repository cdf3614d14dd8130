"""What answers do in training: what is remembered, extended, withdrawn and asked at all."""

from collections.abc import Callable
from dataclasses import replace
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

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.errors import BadInputError
from koopdqn.intent.reward import ASKED, CERTIFIED, REMEMBERED, ActionEvaluation, IntentReward
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.oracles.scripted import ImperfectOracle, ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.checkpoint import read_checkpoint, save_checkpoint
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.labelling import label_known
from koopdqn.rl.questions import OpenAttempt, question_about
from koopdqn.tasks.workcell import COLLISION, Motion, Workcell

Make = Callable[..., Trainer]
SHAPED_BY = {"seed": 0}
REMEMBERING = {"extend": False, "remember_m": 0.004}


@pytest.fixture
def make(parts: Parts, workcell: Workcell, reward: IntentReward, trajectories: list[Array]) -> Make:
    """Make a small trainer whose model is trusted nowhere."""

    def trainer(oracle: Oracle | None = None, **changes: Any) -> Trainer:
        changes = {"train": {"max_steps": 300, **UNCHECKED}, **changes}
        return small_trainer(parts, workcell, untrusting(reward), trajectories, oracle, **changes)

    return trainer


class Scripted(Clerk):
    """An oracle that follows a list of answers and then the expert."""

    def __init__(self, expert: Oracle, answers: dict[int, Answer]) -> None:
        super().__init__()
        self.expert = expert
        self.answers = answers

    def answer(self, question: Question) -> Answer:
        self.asked.append(question)
        return self.answers.get(len(self.asked) - 1) or self.expert.answer(question)


def question_at(evaluation: ActionEvaluation, point: Array, action: int) -> Question:
    return Question(
        0,
        0,
        point.copy(),
        point.copy(),
        action,
        evaluation.reached[0, action].copy(),
        evaluation.predicted[0].copy(),
        "",
    )


def ask(trainer: Trainer, point: Array, action: int) -> bool | None:
    """Ask about an action at a pose (7,) as training does, without an episode."""
    evaluation = trainer.feedback.evaluate_actions(point[None], np.array([0]))
    return trainer.feedback.ask(question_at(evaluation, point, action), evaluation, 0).right


def unexpected(reward: IntentReward, point: Array) -> int:
    """Return an axis that the model finds wrong at a pose (7,), though half right."""
    margin = reward.evaluate_actions(point[None], np.array([0])).margin[0]
    return int(np.where(margin < 0, margin, -np.inf).argmax())


def assert_same_evaluation(one: IntentReward | Feedback, two: IntentReward | Feedback, poses: Array) -> None:
    evaluation, other = (each.evaluate_actions(poses, np.zeros(len(poses), dtype=int)) for each in (one, two))
    for name in ActionEvaluation.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(evaluation, name), getattr(other, name), err_msg=name)


@pytest.mark.parametrize("right", [True, False])
def test_an_answer_holds_for_its_action_nearby_and_names_itself(
    make: Make, trajectories: list[Array], right: bool
) -> None:
    trainer = make(Clerk(lambda question: right), feedback=REMEMBERING)
    point = trajectories[0][100]
    action = int(trainer.feedback.evaluate_actions(point[None], np.array([0])).margin[0].argmax())
    assert ask(trainer, point, action) is right
    far = point.copy()
    far[0] += 0.005
    # A yes holds where the model thinks the action at least as surely right as here, a no where it does not.
    here = _margin_at(trainer, point, action)
    around = [point + sign * 2e-4 * np.eye(7)[axis] for axis in range(3) for sign in (-1, 1)]
    near = next(place for place in around if (_margin_at(trainer, place, action) >= here) == right)
    evaluation = trainer.feedback.evaluate_actions(np.array([point, near, far]), np.array([0, 0, 0]))
    np.testing.assert_array_equal(evaluation.known[:, action], [True, True, False])
    for row in (0, 1):
        assert evaluation.source[row, action] == REMEMBERED
        assert evaluation.answer[row, action] == 0
        assert (evaluation.reward[row, action] >= 0) == right
    others = np.delete(evaluation.source, action, axis=1)
    assert not (others == REMEMBERED).any()


def test_what_is_remembered_is_counted_and_not_asked_again_nearby(make: Make, workcell: Workcell) -> None:
    clerks, trainers = [], []
    for feedback in (FORGETFUL, REMEMBERING):
        expert = ScriptedOracle(workcell.task)
        clerks.append(Scripted(expert, {}))
        trainers.append(make(clerks[-1], feedback=feedback))
        trainers[-1].run()
    forgetful, remembering = trainers
    assert forgetful.history.labelled[REMEMBERED] == 0 < remembering.history.labelled[REMEMBERED]
    assert remembering.history.counts()["remembered"] == remembering.history.labelled[REMEMBERED]
    settings = remembering.feedback.answers.settings
    for later, asked in enumerate(clerks[1].asked):
        for earlier in clerks[1].asked[:later]:
            if earlier.action == asked.action:
                # An answer holds for what the model thinks at least as surely.
                gap = float(pose.position_distance(asked.pose, earlier.pose))
                now, then = (_margin_at(remembering, each.pose, each.action) for each in (asked, earlier))
                right = expert.answer(earlier).right
                assert gap > settings.remember_m or (now < then if right else now > then)


def _margin_at(trainer: Trainer, point: Array, action: int) -> float:
    return float(trainer.feedback.reward.evaluate_actions(point[None], np.array([0])).margin[0, action])


def test_a_yes_extends_trust_so_that_fewer_questions_follow(make: Make) -> None:
    plain, extending = make(feedback={"extend": False}), make(feedback={"extend": True})
    for trainer in (plain, extending):
        trainer.run()
    assert 0 < extending.questions < 0.5 * plain.questions
    assert plain.history.labelled[CERTIFIED] == 0 < extending.history.labelled[CERTIFIED]
    assert extending.env_steps >= 300 <= plain.env_steps


def test_an_unexpected_yes_moves_the_model_and_the_stored_rewards_nearby(make: Make, trajectories: list[Array]) -> None:
    trainer = make(agent={"replay": 5000})
    trainer.run()
    trainer.feedback._oracle = Clerk()
    held = trainer.replay.held()
    trusted = held.sources == CERTIFIED
    point = held.poses[np.flatnonzero(trusted)[0]]
    before = trainer.feedback.reward
    action = unexpected(before, point)
    reached = before.evaluate_actions(point[None], np.array([0])).reached[0, action]
    assert ask(trainer, point, action)
    after = trainer.feedback.reward
    gaps = [
        pose.position_distance(each.evaluate_actions(point[None], np.array([0])).predicted[0], reached)
        for each in (before, after)
    ]
    assert gaps[1] < 0.1 * gaps[0]
    held = trainer.replay.held()
    rows = np.flatnonzero(held.sources == CERTIFIED)
    evaluation = after.evaluate_actions(held.poses[rows], held.steps[rows])
    each = np.arange(len(rows)), held.actions[rows]
    assert evaluation.known[each].all()
    np.testing.assert_allclose(held.rewards[rows], evaluation.reward[each], atol=1e-6)
    np.testing.assert_array_equal(held.undone[rows], held.rewards[rows] < 0)
    np.testing.assert_array_equal(held.terminated[rows], evaluation.at_goal[each] & (held.rewards[rows] >= 0))
    assert trainer.feedback.recomputed > 0


def test_an_undo_takes_back_the_answers_transitions_and_its_effect_but_no_counter(
    make: Make, trajectories: list[Array]
) -> None:
    trainer = make(agent={"replay": 5000})
    trainer.run()
    points = np.concatenate(trajectories)[::7]
    held, before = trainer.replay.held(), replace_reward(trainer)
    counters = trainer.questions, trainer.env_steps, trainer.learner.updates, trainer.env.begun
    point = trajectories[0][60]
    action = unexpected(trainer.feedback.reward, point)
    number = trainer.questions
    trainer.feedback._oracle = Clerk()
    ask(trainer, point, action)
    assert trainer.feedback.answers.numbers[-1] == number
    other = trainer.feedback.evaluate_actions(point[None], np.array([0]))
    assert other.known[0, action]
    trainer.feedback._oracle = Scripted(Clerk(), {0: Answer(None, "clerk", undo=1)})
    assert ask(trainer, trajectories[0][90], 5) is None
    assert number not in trainer.feedback.answers.numbers
    assert_same_evaluation(trainer.feedback.reward, before, points)
    now = trainer.replay.held()
    assert number not in now.answers
    # What rests on other answers, on rules or on a trusted model that is as it was has stayed.
    np.testing.assert_array_equal(now.poses, held.poses)
    np.testing.assert_allclose(now.rewards, held.rewards, atol=1e-6)
    questions, *others = counters
    assert trainer.questions == questions + 2
    assert (trainer.env_steps, trainer.learner.updates, trainer.env.begun) == tuple(others)


def replace_reward(trainer: Trainer) -> IntentReward:
    """Return the trainer's present reward function, made anew from its answers."""
    feedback = trainer.feedback
    yeses, before, after = feedback.answers.extension()
    reaches = feedback._reaches(before)
    radii = np.concatenate([feedback._radii(yeses), np.minimum(0.5 * reaches, feedback._settings.reach_m)])
    return feedback._base.extended(np.concatenate([yeses, before]), radii, before, after, reaches)


def test_an_answer_that_withdraws_another_is_judged_by_the_model_without_it(
    make: Make, trajectories: list[Array]
) -> None:
    one, two = trajectories[0][60], trajectories[0][66]
    at_once, apart = make(Clerk()), make(Clerk())
    for trainer in (at_once, apart):
        ask(trainer, one, unexpected(trainer.feedback.reward, one))
    # What the corrected model suggests is not what the fitted one does.
    evaluation = at_once.feedback.evaluate_actions(two[None], np.array([0]))
    action = int(evaluation.margin[0].argmax())
    assert at_once.feedback._base.evaluate_actions(two[None], np.array([0])).margin[0].argmax() != action
    at_once.feedback._oracle = Scripted(Clerk(), {0: Answer(True, "clerk", undo=1)})
    apart.feedback._oracle = Scripted(Clerk(), {0: Answer(None, "clerk", undo=1), 1: Answer(True, "clerk")})
    ask(apart, one, action)
    for trainer in (at_once, apart):
        assert ask(trainer, two, action)
        assert trainer.feedback.answers.expected == [False]
    assert at_once.feedback.answers.margins == apart.feedback.answers.margins
    assert_same_evaluation(at_once.feedback.reward, apart.feedback.reward, np.concatenate(trajectories)[::7])


def test_an_answer_is_stored_where_what_was_certified_has_been_withdrawn(make: Make) -> None:
    trainer = make(Clerk())
    env, feedback = trainer.env, trainer.feedback
    point = env.episodes.poses[0]
    action = int(feedback.evaluate_actions(point[None], np.array([0])).margin[0].argmax())
    ask(trainer, point, action)
    evaluation = env.evaluate_actions()
    assert evaluation.source[0, action] == CERTIFIED
    label_known(env, evaluation)
    feedback._oracle = Scripted(Clerk(), {0: Answer(None, "clerk", undo=1)})
    ask(trainer, point, action)
    attempt = env.try_action(0, action, env.evaluate_actions(), None, ask=True)
    assert attempt.asked
    assert attempt.new


def test_an_undo_removes_exactly_the_transitions_of_the_withdrawn_answers(make: Make) -> None:
    trainer = make(feedback=REMEMBERING, agent={"replay": 5000})
    trainer.run()
    held = trainer.replay.held()
    standing = sorted(set(trainer.feedback.answers.numbers))
    gone = standing[-3:]
    trainer.feedback._oracle = Scripted(Clerk(), {0: Answer(None, "clerk", undo=3)})
    point = held.poses[0]
    ask(trainer, point, 5)
    now, kept = trainer.replay.held(), ~np.isin(held.answers, gone)
    assert (~kept).sum() > 0
    for name in ("poses", "actions", "rewards", "answers"):
        np.testing.assert_array_equal(getattr(now, name), getattr(held, name)[kept])
    assert set(trainer.feedback.answers.numbers) == set(standing[:-3])


def test_an_undo_withdraws_the_latest_answers_even_if_a_contradiction_has_forgotten_them(
    make: Make, trajectories: list[Array]
) -> None:
    trainer = make(Clerk(lambda question: question.action == 4), feedback=REMEMBERING)
    one, two = trajectories[0][40], trajectories[0][120]
    ask(trainer, one, 4)
    ask(trainer, two, 5)
    trainer.feedback.contradict(two)
    assert trainer.feedback.answers.numbers == [0]
    trainer.feedback._oracle = Scripted(Clerk(), {0: Answer(None, "clerk", undo=1)})
    ask(trainer, one, 6)
    assert trainer.feedback.answers.numbers == [0], "the no was the latest answer, not the yes"


def test_a_better_action_is_known_and_right_at_the_pose(make: Make, trajectories: list[Array]) -> None:
    for feedback in (REMEMBERING, {"extend": True}):
        trainer = make(Scripted(Clerk(), {0: Answer(False, "clerk", better=8)}), feedback=feedback)
        point = trajectories[0][100]
        assert ask(trainer, point, 5) is False
        evaluation = trainer.feedback.evaluate_actions(point[None], np.array([0]))
        assert evaluation.known[0, 8]
        assert evaluation.reward[0, 8] > 0
        assert evaluation.known[0, 5]
        assert evaluation.reward[0, 5] < 0


def test_a_better_action_is_taken_next_even_if_it_was_passed_over(make: Make) -> None:
    """The first question is skipped; the second answer says that the first action would have been right."""
    clerk = Clerk()

    def answered(question: Question) -> Answer:
        clerk.asked.append(question)
        if len(clerk.asked) == 1:
            return Answer(None, "clerk")
        return Answer(False, "clerk", better=clerk.asked[0].action)

    clerk.answer = answered  # type: ignore[method-assign]
    trainer = make(clerk, agent={"episodes_at_once": 1}, feedback=REMEMBERING)
    for _ in range(2):
        trainer.collect()
    first = clerk.asked[0]
    np.testing.assert_array_equal(trainer.env.episodes.poses[0], first.reached)
    assert len(clerk.asked) == 2


@pytest.mark.parametrize("when_spent", ["stop", "distrust", "scripted"])
def test_a_spent_budget_asks_no_more(make: Make, workcell: Workcell, when_spent: str) -> None:
    trainer = assert_spends_its_budget(make, Scripted(ScriptedOracle(workcell.task), {}), when_spent)
    substituted = trainer.feedback.substituted
    assert trainer.history.labelled[ASKED] == 5 + substituted
    if when_spent != "stop":
        assert trainer.env_steps >= 300 or len(trainer.history.rewards) >= 60


def test_questions_are_numbered_without_a_journal_too(make: Make, workcell: Workcell) -> None:
    clerk = Scripted(ScriptedOracle(workcell.task), {})
    make(clerk, train={"max_steps": 200, **UNCHECKED}).run()
    assert [asked.number for asked in clerk.asked] == list(range(len(clerk.asked)))
    assert len(clerk.asked) > 1


def test_without_a_budget_none_is_spent(make: Make) -> None:
    trainer = make()
    trainer.run()
    assert not trainer.feedback.spent
    assert trainer.feedback.substituted == 0


@pytest.mark.parametrize("feedback", [FORGETFUL, REMEMBERING, {}])
def test_an_oracle_that_never_answers_does_not_keep_training_for_ever(make: Make, feedback: dict[str, Any]) -> None:
    trainer = make(Clerk(lambda question: None), train={"max_episodes": 20}, feedback=feedback)
    trainer.run()
    assert 20 <= len(trainer.history.rewards) <= 24
    assert len(trainer.feedback.answers) == 0
    assert trainer.history.labelled[ASKED] == 0


def test_skipped_questions_are_no_contradiction(make: Make) -> None:
    """One no and six skips at a pose leave nothing to try there, and the no stands."""
    said: set[int] = set()

    def rule(question: Question) -> bool | None:
        if question.episode in said:
            return None
        said.add(question.episode)
        return False

    trainer = make(Clerk(rule), train={"max_episodes": 8}, feedback=REMEMBERING)
    trainer.run()
    assert trainer.feedback.answers.contradictions == 0
    assert len(trainer.feedback.answers) == len(said) > 0


def test_what_a_contradiction_forgets_is_not_known_to_other_episodes_of_the_round(
    make: Make, trajectories: list[Array]
) -> None:
    trainer = make(Clerk(lambda question: False), feedback=REMEMBERING)
    here, beside = trajectories[0][100], trajectories[0][101]
    ask(trainer, here, 5)
    assert trainer.feedback.evaluate_actions(beside[None], np.array([0])).known[0, 5]
    changes = trainer.feedback.changes
    trainer.feedback.contradict(here)
    assert trainer.feedback.changes == changes + 1, "an evaluation made before must be made anew"
    assert not trainer.feedback.evaluate_actions(beside[None], np.array([0])).known[0, 5]
    trainer.feedback.contradict(here)
    assert trainer.feedback.changes == changes + 1, "nothing is left to forget"


def test_an_oracle_that_says_no_to_everything_contradicts_itself(make: Make) -> None:
    trainer = make(Clerk(lambda question: False), train={"max_episodes": 8}, feedback=REMEMBERING)
    trainer.run()
    assert trainer.feedback.answers.contradictions >= 8


def undoing(workcell: Workcell) -> Oracle:
    """An expert who now and then withdraws an answer or two, or says what would have been better."""
    expert = ScriptedOracle(workcell.task)
    stray = {4: 1, 9: 2, 15: 1}

    class _Undoing(Oracle):
        def answer(self, question: Question) -> Answer:
            answer = expert.answer(question)
            undo = min(stray.get(question.number, 0), len(question.earlier))
            return replace(answer, undo=undo)

    return _Undoing()


def test_a_killed_run_with_answers_remembered_extended_and_withdrawn_goes_on_as_if_never_stopped(
    make: Make, workcell: Workcell, tmp_path: Path
) -> None:
    settings: dict[str, Any] = {
        "agent": {"updates_per_round": 1, "warm_up": 20},
        "train": {"check_every": 20, "max_steps": 700},
        "feedback": {"reach_m": 0.003},
    }
    journal = tmp_path / "whole.jsonl"
    whole = make(JournalledOracle(undoing(workcell), journal, 0), **settings)
    saved: list[int] = []

    def save_once(_: object) -> None:
        if not saved and whole.questions > 16:
            saved.append(whole.questions)
            save_checkpoint(tmp_path, whole, SHAPED_BY, 0.0)

    whole.run(save_once)
    assert saved
    assert saved[0] < whole.questions, "some answers must come after the checkpoint"
    assert len(whole.feedback.answers) > 0
    checkpoint = read_checkpoint(tmp_path, SHAPED_BY)
    assert checkpoint is not None
    answered = int(checkpoint.arrays["feedback/questions"])
    written = journal.read_bytes()
    rest = make(JournalledOracle(undoing(workcell), journal, answered), **settings)
    rest.restore(checkpoint.arrays, checkpoint.about["state"])
    rest.run()
    assert_same_run(rest, whole)
    assert journal.read_bytes() == written


def test_a_run_with_a_noisy_oracle_is_fixed_by_its_seeds(make: Make, workcell: Workcell, tmp_path: Path) -> None:
    def run(name: str, seed: int) -> Trainer:
        noisy = ImperfectOracle(ScriptedOracle(workcell.task), wrong=0.2, silent=0.1, seed=seed)
        trainer = make(JournalledOracle(noisy, tmp_path / name, 0), feedback={"reach_m": 0.003})
        trainer.run()
        return trainer

    one, two, other = run("one", 3), run("two", 3), run("other", 4)
    assert_same_run(one, two)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    assert (tmp_path / "one").read_bytes() != (tmp_path / "other").read_bytes()
    assert one.history.agreement()["asked"] < 1.0 > other.history.agreement()["asked"]  # type: ignore[operator]


def test_after_a_no_the_same_place_is_asked_about_until_something_is_right(make: Make) -> None:
    noes: dict[tuple[float, ...], int] = {}

    def rule(question: Question) -> bool:
        place = tuple(question.pose.tolist())
        noes[place] = noes.get(place, 0) + 1
        return noes[place] > 2

    clerk = Clerk(rule)
    trainer = make(clerk, feedback=FORGETFUL)
    trainer.collect()
    places = [tuple(question.pose.tolist()) for question in clerk.asked]
    # Four episodes side by side, in three questions each, one place after the other.
    assert len(clerk.asked) == 12
    assert all(places[i] == places[i - i % 3] for i in range(12))
    assert len(set(places)) == 4


class _Refusing:
    """Reachability of an arm that can make no motion."""

    def move(self, point: Array, joints: Array) -> Motion:
        return Motion(None, COLLISION, "anything with anything")

    def move_batch(self, poses: Array, joints: Array) -> list[Motion]:
        return [self.move(*each) for each in zip(poses, joints, strict=True)]


def test_nobody_is_asked_where_the_arm_cannot_do_what_demonstrations_support(
    parts: Parts, workcell: Workcell, reward: IntentReward, trajectories: list[Array]
) -> None:
    clerk = Clerk()
    trainer = small_trainer(
        parts, workcell, reward, trajectories, clerk, agent={"episodes_at_once": 1}, train=dict(UNCHECKED)
    )
    trust = replace(reward.trust, doubt=np.full_like(reward.trust.doubt, 0.5))
    trainer.feedback.reward = IntentReward(reward.task, reward.model, trust, reward.settings)
    trainer.env.episodes.poses[0] = trainer.env.episodes.starts[0] = trajectories[0][60]
    evaluation = trainer.env.evaluate_actions()
    assert (evaluation.source == ASKED).any(), "some action must be left to ask about"
    trainer.workcell = replace(workcell, reachability=_Refusing())  # type: ignore[arg-type]
    number = trainer.env.episodes.numbers[0]
    for _ in range(10):
        trainer.collect()
        if trainer.env.episodes.numbers[0] != number:
            break
    assert trainer.env.episodes.numbers[0] != number, "the episode ends there"
    assert not clerk.asked


def test_what_an_answer_would_settle_leaves_out_what_demonstrations_speak_of(
    make: Make, reward: IntentReward, trajectories: list[Array]
) -> None:
    trainer = make(feedback={"reach_m": 0.07})
    here = trajectories[0][60]
    doubted = replace(reward.trust, doubt=np.full_like(reward.trust.doubt, np.inf))
    for trust, settled in ((trainer.feedback._base.trust, True), (doubted, False)):
        trainer.feedback._base = IntentReward(reward.task, reward.model, trust, reward.settings)
        assert trainer.feedback.extension_contains(here[None], here, 0) == settled


def asked_at(reward: IntentReward, *answers: Answer) -> tuple[Feedback, list[Question]]:
    """Ask about places above the start, one after the other, for answers; return the feedback and the questions."""
    clerk = Clerk()
    feedback = Feedback(untrusting(reward), Scripted(clerk, dict(enumerate(answers))), load_config().feedback)
    start, questions = reward.task.nominal_start, []
    for index, _ in enumerate(answers):
        here = start + np.array([0.0, 0.0, 0.2 * index, 0.0, 0.0, 0.0, 0.0])
        evaluation = feedback.evaluate_actions(here[None], np.zeros(1, dtype=np.int64), start[None])
        questions.append(question_about(OpenAttempt(0, index, here, start, 6), feedback.reward, evaluation, 0))
        feedback.ask(questions[-1], evaluation, 0)
    return feedback, questions


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (Answer(True, "x", better=8), "right: must be true exactly if the better action is the one asked about"),
        (Answer(None, "x", undo=-1), "undo: must be 0 to 1, the answers that stand, found -1"),
        (Answer(None, "x", undo=2), "undo: must be 0 to 1, the answers that stand, found 2"),
    ],
)
def test_an_oracle_from_python_is_held_to_what_an_answer_may_say(
    reward: IntentReward, answer: Answer, words: str
) -> None:
    with pytest.raises(BadInputError, match=words):
        asked_at(reward, Answer(False, "x"), answer)


def test_a_question_in_a_trusted_place_says_why_it_is_asked(reward: IntentReward) -> None:
    here = reward.task.nominal_start[None]
    evaluation = reward.evaluate_actions(here, np.zeros(1, dtype=np.int64), here)
    attempt = OpenAttempt(0, 0, here[0], here[0], 6)
    assert question_about(attempt, reward, evaluation, 0).reason == "the prediction is too near the tolerance"
    evaluation.source[0, 6] = CERTIFIED
    assert question_about(attempt, reward, evaluation, 0).reason == "answers nearby leave no other action"


def test_an_undo_takes_away_what_a_step_into_reach_had_certified(
    reward: IntentReward, monkeypatch: pytest.MonkeyPatch
) -> None:
    feedback, _ = asked_at(reward, Answer(True, "x"))
    reaches: list[float] = []
    monkeypatch.setattr(Feedback, "_recompute", lambda self, poses, beyond=0.0: reaches.append(beyond))
    feedback._withdraw(1)
    assert reaches == [reward.task.step_m]
