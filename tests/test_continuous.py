"""Training, evaluation and environments with continuous actions."""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from helpers_shown import recorded, shown, tipping
from helpers_training import assert_same_run, untrusting
from parts import Clerk, Parts
from stable_baselines3.common.env_checker import check_env as check_for_stable_baselines

import koopdqn.gym  # noqa: F401  (registers the environments)
from koopdqn import pose
from koopdqn.app import api
from koopdqn.artifact import described
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.envs.batch import EnvironmentParts
from koopdqn.envs.dm import KoopmanEnvironment
from koopdqn.envs.gym import KoopmanEnv, KoopmanVectorEnv
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import Greedy
from koopdqn.intent.fit import Fitted
from koopdqn.intent.reward import REMEMBERED, RULE, TRUSTED, IntentReward
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.replay import JournalledOracle
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.oracles.terminal import screen
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import read_policy, write_policy
from koopdqn.rl.settings import ActorCriticSettings
from koopdqn.tasks.actions import FIRST_TWIST, SUGGESTED, moved_by
from koopdqn.tasks.rollout import SUCCESS, roll_out
from koopdqn.tasks.workcell import Workcell

FEW = {"batch": 8, "replay": 600, "warm_up": 60, "episodes_at_once": 4, "updates_per_round": 4, "exploring_steps": 8}
SHORT = {"check_every": 10, "max_steps": 900, "max_episodes": 200, "stop": "limit", "check_success": 1.0}
SMALL = ("demo.count=2", "intent.count=60")


@pytest.fixture(scope="module")
def continuous(reward: IntentReward) -> IntentReward:
    return IntentReward(reward.task, reward.model, reward.trust, reward.settings, continuous=True)


@pytest.fixture(scope="module")
def agent() -> ActorCriticSettings:
    agent = api.load_config("actions=continuous").agent
    assert isinstance(agent, ActorCriticSettings)
    network = agent.network.model_copy(update={"hidden": (8,), "fourier_features": 8})
    return agent.model_copy(update={"network": network, "critic_hidden": (8, 8), **FEW})


def trainer(
    parts: Parts,
    workcell: Workcell,
    reward: IntentReward,
    agent: ActorCriticSettings,
    trajectories: list[Array],
    oracle: Oracle | None = None,
    **feedback: Any,
) -> Trainer:
    return Trainer(
        workcell,
        reward,
        [rows[-20:] for rows in trajectories[:3]],
        oracle or ScriptedOracle(workcell.task),
        agent,
        parts.train.model_copy(update=SHORT),
        0,
        parts.feedback.model_copy(update=feedback),
    )


def test_rewards_fall_with_the_distance_from_the_suggestion(
    continuous: IntentReward, trajectories: list[Array]
) -> None:
    poses = trajectories[0][5:200:10]
    twists = np.random.default_rng(0).normal(size=(len(poses), 40, 3))
    evaluation = continuous.evaluate_actions(poses, np.zeros(len(poses), np.int64), poses, twists)
    assert evaluation.reward.shape == (len(poses), FIRST_TWIST + 40)
    np.testing.assert_allclose(evaluation.margin[:, SUGGESTED], 1.0)
    reached = moved_by(poses[:, None], twists, continuous.task)
    np.testing.assert_allclose(evaluation.reached[:, FIRST_TWIST:], reached)
    far = np.linalg.norm(reached[..., :3] - evaluation.predicted[:, None, :3], axis=2)
    order = np.argsort(far, axis=1)
    assert (np.diff(np.take_along_axis(evaluation.reward[:, FIRST_TWIST:], order, axis=1), axis=1) <= 1e-12).all()
    trusted = evaluation.source[:, FIRST_TWIST:] == TRUSTED
    right = evaluation.reward[:, FIRST_TWIST:] >= 0
    np.testing.assert_array_equal(right[trusted], (far <= continuous.task.position_tolerance_m)[trusted])
    assert trusted.any()
    assert set(evaluation.source[:, [0, 2, 3]].ravel()) == {RULE}


def test_table_1_is_evaluated_as_it_was(
    continuous: IntentReward, reward: IntentReward, trajectories: list[Array]
) -> None:
    """With orientation held, one step toward a prediction is the same for both kinds of actions."""
    poses, steps = trajectories[1][::7], np.zeros(len(trajectories[1][::7]), np.int64)
    one, many = (each.evaluate_actions(poses, steps, poses) for each in (reward, continuous))
    np.testing.assert_allclose(many.reached[:, :SUGGESTED], one.reached)
    np.testing.assert_allclose(many.margin[:, :SUGGESTED], one.margin, atol=1e-9)


def test_a_run_restored_at_a_check_ends_as_one_that_was_never_stopped(
    parts: Parts, workcell: Workcell, continuous: IntentReward, agent: ActorCriticSettings, trajectories: list[Array]
) -> None:
    made = (parts, workcell, continuous, agent, trajectories)
    whole = trainer(*made)
    states = []
    whole.run(lambda check: states.append(whole.state()))
    assert whole.learner.updates >= 20
    arrays, about = states[0]
    rest = trainer(*made)
    rest.restore(arrays, json.loads(json.dumps(about)))
    rest.run()
    assert_same_run(whole, rest)


def test_stored_twists_lead_where_they_led(
    parts: Parts, workcell: Workcell, continuous: IntentReward, agent: ActorCriticSettings, trajectories: list[Array]
) -> None:
    made = trainer(parts, workcell, continuous, agent, trajectories)
    made.run()
    held = made.replay.held()
    assert held.twists is not None
    again = continuous.evaluate_actions(held.poses, held.steps, held.starts, held.twists[:, None].astype(np.float64))
    known = held.sources == TRUSTED
    np.testing.assert_allclose(again.reward[known, FIRST_TWIST], held.rewards[known], atol=1e-4)
    np.testing.assert_array_equal(held.undone, held.rewards < 0)
    assert np.linalg.norm(held.twists, axis=1).max() <= 1 + 1e-6


class Guide(Oracle):
    """Says which action would have been right."""

    def __init__(self, better: int) -> None:
        self.better = better
        self.asked: list[Question] = []

    def answer(self, question: Question) -> Answer:
        self.asked.append(question)
        return Answer(self.better == question.action, "guide", better=self.better)


@pytest.mark.parametrize("better", [SUGGESTED, 6])
def test_a_person_names_the_suggestion_or_a_direction(
    continuous: IntentReward, parts: Parts, shelf_task: Any, better: int
) -> None:
    """The first certifies the model around it, the other moves its suggestion to that direction."""
    place = shelf_task.goal + np.array([-0.15, -0.2, 0.2, 0, 0, 0, 0])
    guide = Guide(better)
    feedback = Feedback(untrusted(continuous), guide, parts.feedback)
    none = np.zeros(1, np.int64)
    before = feedback.evaluate_actions(place[None], none)
    assert not before.known[0, SUGGESTED]
    named = before.reached[0, :FIRST_TWIST]
    asked = Question(0, 0, place, place, SUGGESTED, named[SUGGESTED], before.predicted[0], "far", candidates=named)
    feedback.ask(asked, before, 0)
    after = feedback.evaluate_actions(place[None], none)
    assert after.known[0, SUGGESTED]
    assert after.reward[0, SUGGESTED] == pytest.approx(1.0)
    np.testing.assert_allclose(after.reached[0, SUGGESTED], named[better], atol=1e-6)


def test_a_no_about_the_suggestion_holds_nearby(continuous: IntentReward, parts: Parts, shelf_task: Any) -> None:
    place = shelf_task.goal + np.array([-0.15, -0.2, 0.2, 0, 0, 0, 0])
    feedback = Feedback(untrusted(continuous), Clerk(lambda question: False), parts.feedback)
    none = np.zeros(1, np.int64)
    before = feedback.evaluate_actions(place[None], none)
    named = before.reached[0, :FIRST_TWIST]
    asked = Question(0, 0, place, place, SUGGESTED, named[SUGGESTED], before.predicted[0], "far", candidates=named)
    feedback.ask(asked, before, 0)
    beside = np.repeat(place[None], 3, axis=0)
    beside[:, 1] += [0.003, 0.006, 0.012]
    after = feedback.evaluate_actions(beside, np.zeros(3, np.int64))
    assert (after.source[:, SUGGESTED] == REMEMBERED).tolist() == [True, True, False]
    assert (after.reward[:2, SUGGESTED] < 0).all()


def untrusted(reward: IntentReward) -> IntentReward:
    base = untrusting(reward)
    return IntentReward(base.task, base.model, base.trust, base.settings, continuous=reward.continuous)


def test_questions_are_about_actions_with_a_name_the_suggestion_first(
    parts: Parts, workcell: Workcell, continuous: IntentReward, agent: ActorCriticSettings, trajectories: list[Array]
) -> None:
    clerk = Clerk(lambda question: question.action == 6)
    made = trainer(parts, workcell, untrusted(continuous), agent, trajectories, clerk, extend=False, remember_m=0.0)
    made.settings = made.settings.model_copy(update={"max_steps": 30})
    made.run()
    assert clerk.asked[0].action == SUGGESTED
    assert {question.action for question in clerk.asked} <= set(range(FIRST_TWIST))
    first = clerk.asked[0]
    assert first.candidates is not None
    assert first.candidates.shape == (FIRST_TWIST, 7)
    assert screen.choices(first, workcell.task)[SUGGESTED].startswith("model's")
    assert screen.choosable(first, workcell.task)[SUGGESTED]


def test_joints_stand_at_their_poses_whatever_answers_change(
    parts: Parts, workcell: Workcell, continuous: IntentReward, agent: ActorCriticSettings, trajectories: list[Array]
) -> None:
    """An answer in one episode changes what is suggested in others, whose motions were known already."""
    together = agent.model_copy(update={"episodes_at_once": 16, "exploring_starts": 0.0})
    clerk = Clerk(lambda question: question.number % 5 == 4)
    made = trainer(parts, workcell, untrusted(continuous), together, trajectories, clerk)
    for _ in range(12):
        made.collect()
        stands = workcell.reachability.flange_poses(made.env.episodes.joints)
        assert pose.position_distance(stands, made.env.episodes.poses).max() < 1e-5
    assert made.feedback.questions > 10


def test_a_better_action_that_there_is_not_is_refused(tmp_path: Path, shelf_task: Any) -> None:
    """The suggestion is no answer where actions are Table 1's."""
    oracle = JournalledOracle(Guide(SUGGESTED), tmp_path / "feedback.jsonl", 0)
    here = shelf_task.nominal_start
    asked = Question(0, 0, here, here, 4, here, here, "far", candidates=np.repeat(here[None], 10, axis=0))
    with pytest.raises(BadInputError, match="better: must be an action from 0 to 9, found 10"):
        oracle.answer(asked)
    oracle.close()


def test_greedy_on_the_suggestion_reaches_the_goal(workcell: Workcell, fitted: Fitted) -> None:
    task = workcell.task
    starts, joints, _ = workcell.reachability.draw_starts(task, np.random.default_rng(7), 3)
    greedy = Greedy(fitted.model, task, continuous=True)
    episodes = roll_out(greedy, task, workcell.reachability, starts, joints, 900)
    assert [episode.outcome for episode in episodes] == [SUCCESS] * 3
    path = episodes[0].poses[:-1]
    begun = np.repeat(starts[:1], len(path), axis=0)
    np.testing.assert_allclose(
        episodes[0].poses[1:], fitted.model.to_step(path, fitted.model.intended(path, begun), task.step_m), atol=1e-9
    )


def test_a_policys_file_says_that_its_actions_are_twists(
    parts: Parts,
    workcell: Workcell,
    continuous: IntentReward,
    agent: ActorCriticSettings,
    trajectories: list[Array],
    tmp_path: Path,
) -> None:
    made = trainer(parts, workcell, continuous, agent, trajectories)
    policy = made.best_policy()
    about = {"task": described(workcell.task)}
    write_policy(tmp_path / "p.safetensors", made.best, agent.network, policy.frame, about, continuous=True)
    read, _ = read_policy(tmp_path / "p.safetensors", workcell.task)
    poses = trajectories[0][::20]
    assert read(poses, poses).shape == (len(poses), 3)
    np.testing.assert_array_equal(read(poses, poses), policy(poses, poses))


@pytest.mark.parametrize(
    ("overrides", "found"),
    [(("actions=continuous", "agent=fast"), "found fast"), (("agent=td3",), "found td3")],
)
def test_an_agent_of_the_other_actions_is_refused(overrides: tuple[str, ...], found: str) -> None:
    with pytest.raises(BadInputError, match=rf"^agent: must be .* of actions=.*, {found}$"):
        api.load_config(*overrides)


@pytest.fixture
def made() -> Iterator[gymnasium.Env[Any, Any]]:
    environment = gymnasium.make("koopdqn/ShelfContinuous-v0", render_mode="rgb_array", overrides=SMALL)
    yield environment
    environment.close()


@pytest.mark.usefixtures("no_display")
@pytest.mark.draws
def test_both_checkers_are_silent(made: gymnasium.Env[Any, Any]) -> None:
    assert made.action_space == gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
        check_for_stable_baselines(made, skip_render_check=False)


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def env_parts(workcell: Workcell, continuous: IntentReward) -> EnvironmentParts:
    learning = FeedbackSettings(remember_m=0.01, remember_rad=0.05, extend=True, reach_m=0.07)
    return EnvironmentParts(workcell, continuous, ScriptedOracle(workcell.task), 40, learning)


def test_every_face_gives_the_same(env_parts: EnvironmentParts) -> None:
    one, many = KoopmanEnv(env_parts), KoopmanVectorEnv(env_parts, 1)
    first, _ = one.reset(seed=3)
    firsts, _ = many.reset(seed=3)
    np.testing.assert_array_equal(first, firsts[0])
    for twist in np.random.default_rng(0).uniform(-1, 1, (30, 3)).astype(np.float32):
        observation, reward, *_, info = one.step(twist)
        observations, rewards, *_, infos = many.step(twist[None])
        np.testing.assert_array_equal(observation, observations[0])
        assert reward == rewards[0]
        assert info["undone"] == (reward < 0) == infos["undone"][0]
    environment = KoopmanEnvironment(env_parts, 0)
    environment.reset()
    before, twist = environment.pose, np.array([0.0, 0.6, 0.8], np.float32)
    environment.action_spec().validate(twist)
    step = environment.step(twist)
    moved = np.linalg.norm(environment.pose[:3] - before[:3])
    assert moved == pytest.approx(env_parts.workcell.task.step_m if step.reward >= 0 else 0.0, abs=1e-9)
    with pytest.raises(ValueError, match="action must be finite"):
        environment.step(np.array([np.nan, 0, 0]))
    # Transposed twists would mix those of different episodes.
    for actions in (np.zeros((3, 1)), np.zeros(3)):
        with pytest.raises(ValueError, match=r"actions must have shape \(1, 3\), found"):
            many.step(actions)


def test_an_intent_that_turns_otherwise_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "tipping.hdf5"
    write_hdf5(file, shown(recorded(tipping())))
    given = ("task=demonstrated", f"demos={file}", "task.holdout=0", "actions=continuous", "intent.count=60")
    full, straight = (api.load_config(*given, f"task.turning={turning}") for turning in ("full", "geodesic"))
    fitted = api.fit(full, api.generate(full))
    assert api.intent_reward(full, fitted).continuous
    with pytest.raises(BadInputError, match=r"must turn as task demonstrated .* not in full, found the other"):
        api.intent_reward(straight, fitted)


@pytest.mark.slow
def test_a_tool_that_tips_and_turns_back_is_learned(tmp_path: Path) -> None:
    file = tmp_path / "tipping.hdf5"
    write_hdf5(file, shown(*(recorded(tipping(offset)) for offset in (0.0, 0.01, 0.02))))
    config = api.load_config("task=demonstrated", f"demos={file}", "task.holdout=0", "actions=continuous")
    assert config.derived is not None
    demonstrations = config.derived.training
    trained = api.train(config, demonstrations, api.fit(config, demonstrations))
    assert trained.learned
    cell = api.open_workcell(config)
    starts, joints, _ = cell.reachability.draw_starts(config.task, np.random.default_rng(5), 50)
    episodes = roll_out(trained.policy, config.task, cell.reachability, starts, joints, trained.step_limit)
    assert np.mean([episode.outcome == SUCCESS for episode in episodes]) >= 0.95
    tipped = [np.degrees(pose.rotation_distance(each.poses, config.task.goal).max()) for each in episodes]
    np.testing.assert_allclose(tipped, 40, atol=5)
