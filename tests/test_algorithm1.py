import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_training import FORGETFUL, UNCHECKED, assert_same_run, small_trainer, untrusting
from parts import Clerk, Parts

from koopdqn.intent.reward import ASKED, TRUSTED, IntentReward
from koopdqn.intent.tube import Tube
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.journal import read_lines
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.checkpoint import read_checkpoint, save_checkpoint
from koopdqn.rl.checks import Check
from koopdqn.rl.network import observe
from koopdqn.rl.policy import Policy
from koopdqn.run_folder import CHECKPOINT
from koopdqn.tasks.rollout import STUCK, SUCCESS, Episode, roll_out
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.workcell import Workcell

Make = Callable[..., Trainer]
SHAPED_BY = {"seed": 0}
CONFIRM = "koopdqn.rl.checks.Checker.confirm"


@pytest.fixture
def make(parts: Parts, workcell: Workcell, reward: IntentReward, trajectories: list[Array]) -> Make:
    def trainer(oracle: Oracle | None = None, rewarded_by: IntentReward = reward, **changes: Any) -> Trainer:
        return small_trainer(parts, workcell, rewarded_by, trajectories, oracle, **changes)

    return trainer


def half_trusting(reward: IntentReward) -> IntentReward:
    """The same reward with a narrow trust domain, so that some things are known and some must be asked."""
    assert isinstance(reward.trust, Tube)
    narrow = replace(reward.trust, radius=0.5 * reward.trust.radius)
    return IntentReward(reward.task, reward.model, narrow, reward.settings)


KINDS: dict[str, dict[str, Any]] = {
    "fast": {},
    "paper": {"trials": "chosen", "double": False, "rounds_per_update": 3, "episodes_at_once": 1, "warm_up": 20},
    "never back": {"trials": "chosen", "step_back": False, "bootstrap_undone": True},
}


@pytest.mark.parametrize(
    ("kind", "check_every", "max_steps"),
    [("fast", 8, 400), ("fast", 10, 400), ("paper", 30, 100), ("never back", 40, 150), ("never back", 42, 150)],
)
def test_a_run_restored_at_a_check_ends_as_one_that_was_never_stopped(
    make: Make, tmp_path: Path, kind: str, check_every: int, max_steps: int
) -> None:
    """Checks fall at the end of a round of four updates (8, 40) or within one (10, 42)."""
    settings = {"agent": KINDS[kind], "train": {"check_every": check_every, "max_steps": max_steps}}
    whole = make(**settings)
    saved: list[Check] = []

    def save_once(check: Check) -> None:
        if not saved:
            saved.append(check)
            save_checkpoint(tmp_path, whole, SHAPED_BY, 1.5)

    whole.run(save_once)
    assert saved[0].env_steps < whole.env_steps
    checkpoint = read_checkpoint(tmp_path, SHAPED_BY)
    assert checkpoint is not None
    assert checkpoint.about["seconds"] == 1.5
    rest = make(**settings)
    rest.restore(checkpoint.arrays, checkpoint.about["state"])
    assert rest.history.checks == saved
    rest.run()
    assert_same_run(rest, whole)


def test_where_people_follow_their_start_the_agent_sees_poses_as_from_the_nominal_one(
    make: Make, workcell: Workcell, reward: IntentReward
) -> None:
    task = workcell.task
    frame = StartFrame(task.nominal_start[:3], task.goal[:3], follows=True)
    following = IntentReward(task, reward.model.within(frame), reward.trust, reward.settings)
    clerk = Clerk()
    trainer = make(clerk, rewarded_by=untrusting(following), agent={"replay": 10_000}, train={"max_steps": 300})
    trainer.run()
    assert trainer.policy.frame is frame
    held = trainer.replay.held()
    local = frame.to_frame(held.poses, held.starts)
    np.testing.assert_array_equal(held.observations, observe(local, task))
    assert np.abs(local - held.poses).max() > 1e-3
    batch = trainer.env.episodes
    np.testing.assert_array_equal(trainer.env.evaluate_actions().local, frame.to_frame(batch.poses, batch.starts))
    begun = [asked for asked in clerk.asked if asked.step == 0]
    assert begun
    for asked in clerk.asked:
        first = next(each for each in clerk.asked if each.episode == asked.episode)
        np.testing.assert_array_equal(asked.start, first.start)
    arrays, about = trainer.state()
    again = make(Clerk(), rewarded_by=untrusting(following), agent={"replay": 10_000}, train={"max_steps": 300})
    again.restore(arrays, json.loads(json.dumps(about)))
    assert_same_run(again, trainer)


def test_the_same_seed_gives_the_same_run_and_another_seed_another(make: Make) -> None:
    one, two, other = make(seed=3), make(seed=3), make(seed=4)
    for trainer in (one, two, other):
        trainer.run()
    assert_same_run(one, two)
    for name, values in one.best.items():
        np.testing.assert_array_equal(values, two.best[name])
    assert any(not np.array_equal(values, other.best[name]) for name, values in one.best.items())


def test_global_random_states_play_no_part(make: Make) -> None:
    import torch

    runs = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        np.random.seed(seed)
        runs.append(make(train={"max_steps": 200}))
        runs[-1].run()
    assert_same_run(*runs)


def test_checks_are_made_at_their_updates_and_tell_the_policys_success(make: Make, workcell: Workcell) -> None:
    # At the end of a round of updates, so that the network is still the one that was measured.
    trainer = make(train={"check_every": 8})
    seen: list[Check] = []
    measured: list[float] = []

    def measure(check: Check) -> None:
        seen.append(check)
        rng = np.random.default_rng([trainer.settings.check_seed, 3])
        starts, joints, _ = workcell.reachability.draw_starts(workcell.task, rng, 20)
        policy = Policy(trainer.learner.online, workcell.task)
        episodes = roll_out(policy, workcell.task, workcell.reachability, starts, joints, trainer.step_limit)
        measured.append(float(np.mean([episode.outcome == SUCCESS for episode in episodes])))

    trainer.run(measure)
    assert [check.updates for check in seen] == list(range(8, 8 * len(seen) + 1, 8))
    assert [check.success_rate for check in seen] == measured
    assert trainer.history.checks == seen
    for check in seen:
        assert sum(check.failures.values()) == round(20 * (1 - check.success_rate))
    assert trainer.progress.best_success == max(check.success_rate for check in seen)
    assert len(trainer.history.losses) == len(seen)
    # Of equally good policies the latest is kept.
    best = [check.updates for check in seen if check.success_rate == trainer.progress.best_success]
    assert trainer.progress.best_update == best[-1]


def test_only_checks_passed_in_a_row_count_and_the_best_policy_is_kept(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = iter([1.0, 0.5, 1.0, 1.0, 0.9, 1.0, 1.0, 1.0])

    def scripted(*_: object, **__: object) -> list[Episode]:
        successes = round(20 * next(rates))
        return [Episode(np.zeros((1, 7)), np.zeros((1, 6)), SUCCESS if i < successes else STUCK) for i in range(20)]

    monkeypatch.setattr("koopdqn.rl.checks.roll_out", scripted)
    monkeypatch.setattr(CONFIRM, lambda *_: (1.0, False))
    trainer = make(
        train={"check_success": 0.95, "checks_to_learn": 3, "stop": "learned", "check_every": 4, "max_steps": 10**6}
    )
    policies: list[dict[str, np.ndarray]] = []
    trainer.run(lambda check: policies.append(trainer.learner.policy_arrays()))
    assert [check.success_rate for check in trainer.history.checks] == [1.0, 0.5, 1.0, 1.0, 0.9, 1.0, 1.0, 1.0]
    assert trainer.history.checks[1].failures == {STUCK: 10}
    assert trainer.progress.learned_at == trainer.history.checks[-1].env_steps
    assert trainer.progress.best_success == 1.0
    assert trainer.progress.best_update == 32
    for name, values in trainer.best.items():
        np.testing.assert_array_equal(values, policies[-1][name])


def test_learned_is_when_the_way_stops_coming_nearer_to_the_intents_own(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = [(1.0, 9.0), (1.0, 8.5), (1.0, 8.0), (1.0, 7.5), (0.9, 7.0), (1.0, 6.0), (1.0, 5.9), (1.0, 6.4)]
    rest = iter(found)
    monkeypatch.setattr("koopdqn.rl.checks.Checker.measure", lambda *_: (*next(rest), {}))
    monkeypatch.setattr(CONFIRM, lambda *_: (1.0, False))
    trainer = make(
        train={"gain": 0.1, "check_success": 0.95, "checks_to_learn": 3, "stop": "learned", "max_steps": 10**6}
    )
    trainer.run()
    assert [(check.success_rate, check.intent_distance) for check in trainer.history.checks] == found
    # 8.0 is nearer than 9.0 by more than a tenth, and 0.9 is too seldom: both begin the count anew.
    assert trainer.progress.learned_at == trainer.history.checks[-1].env_steps
    assert trainer.progress.best_update == trainer.history.checks[6].updates


def test_a_check_that_is_far_astray_confirms_nothing(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(1.0, 2.0), (1.0, 3.1), (1.0, 2.9)]
    rest = iter(found)
    monkeypatch.setattr("koopdqn.rl.checks.Checker.measure", lambda *_: (*next(rest), {}))
    monkeypatch.setattr(CONFIRM, lambda *_: (1.0, False))
    trainer = make(train={"gain": 0.1, "checks_to_learn": 2, "stop": "learned", "max_steps": 10**6})
    trainer.run()
    # 3.1 is over one and a half times 2.0; 2.9 is not.
    assert [check.intent_distance for check in trainer.history.checks] == [2.0, 3.1, 2.9]
    assert trainer.progress.best_update == trainer.history.checks[0].updates


def test_a_check_that_is_far_astray_is_neither_kept_nor_taken_as_learned(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though more starts succeed, and though as many checks as are needed were passed before it."""
    rest = iter([(0.95, 10.0), (0.95, 10.0), (1.0, 30.0), *[(0.95, 9.9)] * 9])
    monkeypatch.setattr("koopdqn.rl.checks.Checker.measure", lambda *_: (*next(rest), {}))
    trainer = make(
        train={"gain": 0.1, "check_success": 0.95, "checks_to_learn": 2, "stop": "learned", "max_steps": 10**6}
    )
    confirmed: list[float] = []

    def confirm(*_: object) -> tuple[float, bool]:
        confirmed.append(trainer.history.checks[-1].intent_distance)
        return 1.0, len(confirmed) == 1

    monkeypatch.setattr(CONFIRM, confirm)
    trainer.run()
    assert confirmed == [10.0, 9.9]
    assert trainer.progress.best_update == trainer.history.checks[-1].updates


def test_past_learned_only_what_is_confirmed_is_kept(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    rest = iter([9.0, 9.0, 5.0, 4.0, 3.0])
    confirmed = {9.0: (1.0, False), 5.0: (0.5, False), 4.0: (1.0, False), 3.0: (1.0, True)}
    monkeypatch.setattr("koopdqn.rl.checks.Checker.measure", lambda *_: (1.0, next(rest, 8.0), {}))
    trainer = make(train={"gain": 0.1, "checks_to_learn": 2, "stop": "limit", "extend": None, "max_steps": 900})
    monkeypatch.setattr(CONFIRM, lambda *_: confirmed[trainer.history.checks[-1].intent_distance])
    trainer.run()
    checks = trainer.history.checks
    assert trainer.progress.learned_at == checks[1].env_steps
    assert [check.intent_distance for check in checks][:5] == [9.0, 9.0, 5.0, 4.0, 3.0]
    assert trainer.progress.best_update == checks[3].updates


@pytest.mark.parametrize(("distances", "checks"), [([9.0] * 9, 6), ([9.0] * 3 + [2.0] * 3, 5)])
def test_a_path_that_goes_another_way_is_learned_only_if_many_checks_bring_it_no_nearer(
    make: Make, monkeypatch: pytest.MonkeyPatch, distances: list[float], checks: int
) -> None:
    rest = iter(distances)
    monkeypatch.setattr("koopdqn.rl.checks.Checker.measure", lambda *_: (1.0, next(rest), {}))
    trainer = make(train={"gain": 0.1, "checks_to_learn": 2, "stop": "learned", "max_steps": 10**6})
    monkeypatch.setattr(CONFIRM, lambda *_: (1.0, trainer.history.checks[-1].intent_distance > 2.0))
    trainer.run()
    assert trainer.learned
    assert len(trainer.history.checks) == checks


def test_what_other_starts_do_not_confirm_was_passed_by_chance(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    found, rates = iter([3.0, 3.0, 4.0, 4.0, 5.0]), iter([0.85, 0.97])
    monkeypatch.setattr("koopdqn.rl.checks.Checker.measure", lambda *_: (1.0, next(found), {}))
    monkeypatch.setattr(CONFIRM, lambda *_: (next(rates), False))
    trainer = make(
        train={"gain": 0.1, "check_success": 0.95, "checks_to_learn": 2, "stop": "learned", "max_steps": 10**6}
    )
    trainer.run()
    checks = trainer.history.checks
    assert [check.intent_distance for check in checks] == [3.0, 3.0, 4.0, 4.0]
    assert trainer.progress.learned_at == checks[-1].env_steps
    # Though the first was nearer: it reaches the goal from 85 % of the others.
    assert trainer.progress.best_update == checks[-1].updates


def test_the_step_limit_is_a_multiple_of_the_longest_demonstration(make: Make) -> None:
    assert make(train={"step_limit_factor": 4.0}).step_limit == 80


def test_learned_is_enough_passed_checks_in_a_row_and_stops_there(make: Make) -> None:
    trainer = make(train={"check_success": 0.0, "stop": "learned", "max_steps": 10**6, "checks_to_learn": 3})
    trainer.run()
    assert trainer.learned
    assert [check.updates for check in trainer.history.checks][:3] == [10, 20, 30]
    assert trainer.progress.learned_at == trainer.history.checks[2].env_steps
    # At most the rest of one round's updates.
    assert trainer.learner.updates <= 30 + 4


@pytest.mark.parametrize("extend", [1.0, 3.0])
def test_training_on_goes_to_a_multiple_of_what_it_took_to_learn(make: Make, extend: float) -> None:
    trainer = make(
        train={"check_success": 0.0, "stop": "limit", "extend": extend, "max_steps": 10**6, "checks_to_learn": 1}
    )
    trainer.run()
    assert trainer.env_steps >= extend * trainer.progress.learned_at
    # A round of four episodes tries at most ten actions each, and one more that is asked.
    assert trainer.env_steps <= extend * trainer.progress.learned_at + 4 * 11
    assert trainer.progress.learned_at == trainer.history.checks[0].env_steps


def test_training_on_without_a_multiple_goes_to_its_limit(make: Make) -> None:
    trainer = make(
        train={"check_success": 0.0, "stop": "limit", "extend": None, "max_steps": 400, "checks_to_learn": 1}
    )
    trainer.run()
    assert trainer.learned
    assert trainer.progress.learned_at < 400 <= trainer.env_steps


def test_limits_of_steps_and_episodes_bound_an_unlearned_run(make: Make) -> None:
    by_steps = make(train={"max_steps": 150, "stop": "learned", **UNCHECKED})
    by_steps.run()
    assert 150 <= by_steps.env_steps <= 150 + 4 * 11
    assert not by_steps.learned
    assert by_steps.progress.learned_at == -1
    by_episodes = make(train={"max_episodes": 6, "max_steps": 10**6, **UNCHECKED})
    by_episodes.run()
    assert 6 <= len(by_episodes.history.rewards) <= 6 + 4
    extended = make(train={"check_success": 0.0, "checks_to_learn": 1, "extend": 1000.0, "max_steps": 300})
    extended.run()
    assert 300 <= extended.env_steps <= 300 + 4 * 11


def test_a_run_goes_on_after_its_limit_is_raised(make: Make) -> None:
    first = make(train={"max_steps": 200})
    first.run()
    arrays, about = first.state()
    second, whole = make(train={"max_steps": 400}), make(train={"max_steps": 400})
    second.restore(arrays, json.loads(json.dumps(about)))
    second.run()
    whole.run()
    assert_same_run(second, whole)


def test_with_an_oracle_that_is_always_right_every_answer_agrees(make: Make, reward: IntentReward) -> None:
    trainer = make(rewarded_by=half_trusting(reward), train=UNCHECKED)
    trainer.run()
    history = trainer.history
    assert history.labelled[ASKED] == trainer.questions > 0
    assert history.agreed[ASKED] == history.labelled[ASKED]
    assert history.labelled[TRUSTED] >= history.agreed[TRUSTED] > 0.5 * history.labelled[TRUSTED]


def test_nothing_is_asked_twice_nor_where_it_is_known(make: Make, workcell: Workcell, reward: IntentReward) -> None:
    expert = ScriptedOracle(workcell.task)
    clerk = Clerk(lambda question: expert.answer(question).right)
    narrow = half_trusting(reward)
    trainer = make(clerk, rewarded_by=narrow, train=UNCHECKED)
    trainer.run()
    keys = [(asked.episode, asked.step, asked.action) for asked in clerk.asked]
    assert len(keys) == len(set(keys)) == trainer.questions > 0
    for asked in clerk.asked:
        evaluation = narrow.evaluate_actions(asked.pose[None], np.array([asked.step]))
        assert not evaluation.known[0, asked.action]
        np.testing.assert_array_equal(evaluation.reached[0, asked.action], asked.reached)
        # A batch of another size rounds its matrix products otherwise.
        np.testing.assert_allclose(evaluation.predicted[0], asked.predicted, atol=1e-12)
        assert asked.reason


def test_the_likeliest_action_is_asked_first(make: Make, reward: IntentReward) -> None:
    clerk = Clerk(lambda question: False)
    trainer = make(clerk, rewarded_by=untrusting(reward), train={"max_episodes": 6}, feedback=FORGETFUL)
    trainer.run()
    by_episode: dict[int, list[Question]] = {}
    for asked in clerk.asked:
        by_episode.setdefault(asked.episode, []).append(asked)
    for questions in by_episode.values():
        opinion = reward.evaluate_actions(questions[0].pose[None], np.array([0])).margin[0]
        order = [opinion[asked.action] for asked in questions]
        assert order == sorted(order, reverse=True)


def test_wrong_actions_are_undone_stored_and_end_an_episode_when_none_is_left(make: Make, reward: IntentReward) -> None:
    clerk = Clerk(lambda question: False)
    settings = {"train": {"max_episodes": 8}, "agent": {"exploring_starts": 0.0}, "feedback": FORGETFUL}
    trainer = make(clerk, rewarded_by=untrusting(reward), **settings)
    trainer.run()
    history = trainer.history
    assert set(history.lengths) == {0}
    assert history.labelled[TRUSTED] == 0
    finished = len(history.rewards)
    # Three actions are wrong by rule; the other seven are asked for, or impossible.
    per_episode = [sum(asked.episode == number for asked in clerk.asked) for number in range(finished)]
    assert max(per_episode) == 7
    # Of what was asked in one state nothing moved.
    assert {asked.step for asked in clerk.asked} == {0}
    arrays, _ = trainer.state()
    stored = arrays["replay/rewards"]
    assert len(stored) == trainer.env_steps
    assert np.all(stored == -1.0)
    assert arrays["replay/undone"].all()
    assert not arrays["replay/terminated"].any()


def test_skipped_questions_teach_nothing_and_do_not_hang(make: Make, reward: IntentReward) -> None:
    clerk = Clerk(lambda question: None)
    trainer = make(clerk, rewarded_by=untrusting(reward), train={"max_episodes": 8}, feedback=FORGETFUL)
    trainer.run()
    assert trainer.questions == len(clerk.asked) > 0
    assert trainer.history.labelled[ASKED] == 0
    assert set(trainer.history.lengths) == {0}
    arrays, _ = trainer.state()
    assert set(np.unique(arrays["replay/actions"])) <= {0, 2, 3}


def test_stored_transitions_say_what_happened(make: Make, workcell: Workcell) -> None:
    trainer = make(agent={"replay": 10_000}, train=UNCHECKED)
    trainer.run()
    replay = {name.removeprefix("replay/"): values for name, values in trainer.state()[0].items() if "replay/" in name}
    wrong = replay["rewards"] < 0
    np.testing.assert_array_equal(replay["undone"], wrong)
    assert not (replay["terminated"] & wrong).any()
    task = workcell.task
    # The fourth value is the distance to the goal, the fifth the rotation from it.
    near = replay["next_observations"][:, 3] <= task.goal_tolerance_m
    np.testing.assert_array_equal(replay["terminated"], near & ~wrong)
    assert replay["terminated"].any()
    assert not (replay["truncated"] & replay["terminated"]).any()
    assert set(np.unique(replay["actions"])) <= set(range(10))
    assert np.isin(replay["actions"][~wrong], [1, 4, 5, 6, 7, 8, 9]).all()


def test_without_stepping_back_wrong_actions_move_and_limits_truncate(make: Make) -> None:
    trainer = make(
        agent={**KINDS["never back"], "epsilon_start": 1.0, "epsilon_end": 1.0, "replay": 10_000}, train=UNCHECKED
    )
    trainer.run()
    arrays, _ = trainer.state()
    assert not arrays["replay/undone"].any()
    assert (arrays["replay/rewards"] < 0).any()
    assert arrays["replay/truncated"].any()
    assert max(trainer.history.lengths) > 0
    exploring = np.array(trainer.history.exploring)
    assert np.array(trainer.history.lengths)[exploring].max() <= 8


class _Interrupting(Oracle):
    """An expert whose user presses Ctrl-C at one question."""

    def __init__(self, expert: Oracle, at: int) -> None:
        self._expert = expert
        self._left = at

    def answer(self, question: Question) -> Answer:
        self._left -= 1
        if self._left < 0:
            raise KeyboardInterrupt
        return self._expert.answer(question)

    def close(self) -> None:
        self._expert.close()


def test_an_interrupted_run_goes_on_from_its_checkpoint_and_journal_and_asks_no_one_twice(
    make: Make, workcell: Workcell, reward: IntentReward, tmp_path: Path
) -> None:
    settings = {
        "agent": {"updates_per_round": 1, "warm_up": 20},
        "train": {"check_every": 10, "max_steps": 300},
        "feedback": FORGETFUL,
        "rewarded_by": untrusting(reward),
    }
    expert = ScriptedOracle(workcell.task)
    whole = make(expert, **settings)
    whole.run()
    first_check = whole.history.checks[0]
    counted = Clerk(lambda question: expert.answer(question).right)
    journal = tmp_path / "feedback.jsonl"
    stopped = make(JournalledOracle(_Interrupting(counted, whole.questions - 3), journal, 0), **settings)
    with pytest.raises(KeyboardInterrupt):
        stopped.run(lambda check: save_checkpoint(tmp_path, stopped, SHAPED_BY, 0.0))
    checkpoint = read_checkpoint(tmp_path, SHAPED_BY)
    assert checkpoint is not None
    answered = int(checkpoint.arrays["feedback/questions"])
    assert first_check.updates == 10
    assert answered < len(read_lines(journal)) == whole.questions - 3
    rest = make(JournalledOracle(counted, journal, answered), **settings)
    rest.restore(checkpoint.arrays, checkpoint.about["state"])
    rest.run()
    assert len(counted.asked) == whole.questions == len(read_lines(journal))
    for name, values in whole.best.items():
        np.testing.assert_array_equal(rest.best[name], values, err_msg=name)
    assert rest.history.state() == whole.history.state()
    assert_same_run(rest, whole)


def test_a_checkpoint_has_the_same_bytes_for_the_same_state(make: Make, tmp_path: Path) -> None:
    trainer = make(train={"max_steps": 150})
    trainer.run()
    written = []
    for name in ("a", "b"):
        save_checkpoint(tmp_path / name, trainer, SHAPED_BY, 2.0)
        written.append((tmp_path / name / CHECKPOINT).read_bytes())
    assert written[0] == written[1]
    assert [path.name for path in (tmp_path / "a" / CHECKPOINT).parent.iterdir()] == ["latest.safetensors"]


def test_what_is_learned_from_agrees_with_the_scripted_expert(
    make: Make, workcell: Workcell, reward: IntentReward
) -> None:
    """Where everything is asked, the sign of each stored reward is the demonstrator's opinion."""
    expert = ScriptedOracle(workcell.task)
    clerk = Clerk(lambda asked: expert.answer(asked).right)
    settings = {"agent": {"replay": 10_000}, "train": {"max_steps": 300, **UNCHECKED}, "feedback": FORGETFUL}
    trainer = make(clerk, rewarded_by=untrusting(reward), **settings)
    trainer.run()
    rewards = trainer.state()[0]["replay/rewards"]
    asked_right = sum(bool(clerk.rule(asked)) for asked in clerk.asked)
    assert int((rewards > 0).sum()) == asked_right > 0
