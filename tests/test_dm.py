from collections.abc import Callable
from dataclasses import replace

import dm_env
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from parts import Clerk

from koopdqn.envs.batch import EnvironmentParts
from koopdqn.envs.dm import KoopmanEnvironment
from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.base import Question
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.rl.network import observe
from koopdqn.tasks.workcell import Workcell

AXES = (4, 5, 6, 7, 8, 9)
Make = Callable[..., KoopmanEnvironment]


def untrusting(reward: IntentReward) -> IntentReward:
    """The same reward with a trust domain that trusts nothing, so that everything legal is asked."""
    trust = replace(reward.trust, doubt=np.full_like(reward.trust.doubt, np.inf))
    return IntentReward(reward.task, reward.model, trust, reward.settings)


@pytest.fixture
def make(workcell: Workcell, reward: IntentReward) -> Make:
    def environment(
        rule: Callable[[Question], bool | None] = lambda question: True,
        limit: int = 50,
        seed: int = 0,
        trusting: bool = False,
    ) -> KoopmanEnvironment:
        chosen = reward if trusting else untrusting(reward)
        return KoopmanEnvironment(EnvironmentParts(workcell, chosen, Clerk(rule), limit), seed)

    return environment


class TestProtocol(test_utils.EnvironmentTestMixin, absltest.TestCase):  # type: ignore[misc]  # dm_env is untyped
    """dm_env's own tests of what an environment must do."""

    @pytest.fixture(autouse=True)
    def _parts(self, workcell: Workcell, reward: IntentReward) -> None:
        self._workcell, self._reward = workcell, reward

    def make_object_under_test(self) -> KoopmanEnvironment:
        oracle = ScriptedOracle(self._workcell.task)
        return KoopmanEnvironment(EnvironmentParts(self._workcell, self._reward, oracle, 60), 0)


def test_a_right_action_moves_and_a_wrong_one_is_undone(make: Make) -> None:
    environment = make(lambda question: question.action == 4)
    first = environment.reset()
    start = environment.pose
    wrong = environment.step(5)
    assert wrong.reward == -1.0
    np.testing.assert_array_equal(environment.pose, start)
    np.testing.assert_array_equal(wrong.observation, first.observation)
    right = environment.step(4)
    assert right.reward == 1.0
    assert right.discount == 1.0
    np.testing.assert_allclose(environment.pose[:3] - start[:3], [0.0021, 0, 0], atol=1e-12)
    assert not np.array_equal(right.observation, first.observation)


def test_a_skipped_question_is_no_no_and_moves_nothing(make: Make) -> None:
    environment = make(lambda question: None)
    environment.reset()
    start = environment.pose
    skipped = environment.step(4)
    assert skipped.reward == 0.0
    assert skipped.mid()
    np.testing.assert_array_equal(environment.pose, start)


def test_a_skipped_question_is_no_step_of_the_clock(make: Make, workcell: Workcell, reward: IntentReward) -> None:
    clerk = Clerk(lambda question: None)
    environment = KoopmanEnvironment(EnvironmentParts(workcell, untrusting(reward), clerk, 50), 0)
    environment.reset()
    for action in AXES:
        environment.step(action)
    assert [question.step for question in clerk.asked] == [0] * 6


def test_actions_by_rule_are_wrong_without_asking(workcell: Workcell, reward: IntentReward) -> None:
    clerk = Clerk()
    environment = KoopmanEnvironment(EnvironmentParts(workcell, untrusting(reward), clerk, 50), 0)
    environment.reset()
    start = environment.pose
    for action in (0, 2, 3):
        assert environment.step(action).reward == -1.0
    assert not clerk.asked
    np.testing.assert_array_equal(environment.pose, start)


def test_what_the_arm_cannot_do_is_wrong_without_asking(workcell: Workcell, reward: IntentReward) -> None:
    """Always right and always +y ends at the shelf: the side wall is never entered."""
    clerk = Clerk()
    environment = KoopmanEnvironment(EnvironmentParts(workcell, untrusting(reward), clerk, 1000), 0)
    environment.reset()
    rewards = [environment.step(6).reward for _ in range(120)]
    assert rewards[0] == 1.0
    assert rewards[-1] == -1.0
    blocked = rewards.index(-1.0)
    assert all(value == -1.0 for value in rewards[blocked:])
    assert len(clerk.asked) == blocked
    joints = workcell.reachability.enter(environment.pose).joints
    assert joints is not None
    assert workcell.scene.contact(joints) == ""


def test_the_goal_terminates_with_discount_zero(workcell: Workcell, reward: IntentReward) -> None:
    task = workcell.task
    environment = KoopmanEnvironment(EnvironmentParts(workcell, reward, ScriptedOracle(task), 3000), 3)
    timestep = environment.reset()
    for _ in range(1000):
        evaluation = reward.evaluate_actions(environment.pose[None], np.array([0]))
        wished = task.demonstrator.next_pose(environment.pose[None])[0]
        # One in forty of the model's rewards is not the demonstrator's; a wrong action is undone.
        right = np.flatnonzero(evaluation.reward[0] >= 0)
        nearest = right[np.linalg.norm(evaluation.reached[0, right, :3] - wished[:3], axis=1).argmin()]
        timestep = environment.step(int(nearest))
        if timestep.last():
            break
    assert timestep.last()
    assert timestep.discount == 0.0
    assert timestep.reward > reward.settings.goal
    assert task.reached(environment.pose[None])[0]


def test_the_step_limit_truncates_with_discount_one(make: Make) -> None:
    environment = make(lambda question: False, limit=5)
    environment.reset()
    timesteps = [environment.step(action) for action in (4, 5, 6, 7, 8)]
    assert [timestep.last() for timestep in timesteps] == [False] * 4 + [True]
    assert timesteps[-1].discount == 1.0
    again = environment.step(4)
    assert again.first()
    assert again.reward is None


def test_a_step_before_a_reset_is_a_reset(make: Make) -> None:
    timestep = make().step(4)
    assert timestep.step_type is dm_env.StepType.FIRST


def test_questions_tell_all_and_number_their_episodes(workcell: Workcell, reward: IntentReward) -> None:
    clerk = Clerk()
    environment = KoopmanEnvironment(EnvironmentParts(workcell, untrusting(reward), clerk, 50), 0)
    for episode in range(2):
        environment.reset()
        before = environment.pose
        environment.step(4)
        environment.step(6)
        first, second = clerk.asked[-2:]
        assert (first.episode, first.step, first.action) == (episode, 0, 4)
        assert (second.episode, second.step, second.action) == (episode, 1, 6)
        np.testing.assert_array_equal(first.pose, before)
        np.testing.assert_array_equal([first.start, second.start], [before, before])
        np.testing.assert_array_equal(first.reached, second.pose)
        np.testing.assert_array_equal(
            first.predicted, reward.evaluate_actions(before[None], np.array([0])).predicted[0]
        )
        assert "of the rewards here are right" in first.reason or "standard deviations" in first.reason


def test_where_the_model_is_trusted_nobody_is_asked(workcell: Workcell, reward: IntentReward) -> None:
    sure = IntentReward(reward.task, reward.model, replace(reward.trust, doubt=0 * reward.trust.doubt), reward.settings)
    clerk = Clerk()
    environment = KoopmanEnvironment(EnvironmentParts(workcell, sure, clerk, 100), 1)
    environment.reset()
    for _ in range(30):
        evaluation = sure.evaluate_actions(environment.pose[None], np.array([0]))
        asked = len(clerk.asked)
        action = int(evaluation.reward[0].argmax())
        timestep = environment.step(action)
        assert (len(clerk.asked) > asked) == (not evaluation.known[0, action])
        if evaluation.known[0, action]:
            assert timestep.reward == evaluation.reward[0, action]


def test_observations_are_the_agents(make: Make, workcell: Workcell) -> None:
    environment = make()
    timestep = environment.reset()
    np.testing.assert_array_equal(timestep.observation, observe(environment.pose[None], workcell.task)[0])
    environment.observation_spec().validate(timestep.observation)


@pytest.mark.parametrize("action", [-1, 10])
def test_what_is_no_action_is_refused(make: Make, action: int) -> None:
    environment = make()
    environment.reset()
    with pytest.raises(ValueError, match=rf"action must be from 0 to 9, found {action}"):
        environment.step(action)


def test_the_seed_fixes_the_starts_which_differ(make: Make) -> None:
    one, two, other = make(seed=4), make(seed=4), make(seed=5)
    starts = []
    for environment in (one, two, other):
        for _ in range(2):
            environment.reset()
            starts.append(environment.pose)
    np.testing.assert_array_equal(starts[:2], starts[2:4])
    assert not np.array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[0], starts[4])


def test_the_pose_given_out_is_a_copy(make: Make) -> None:
    environment = make()
    environment.reset()
    before = environment.pose
    environment.pose[:] = 0.0
    np.testing.assert_array_equal(environment.pose, before)


def test_closing_closes_the_oracle(workcell: Workcell, reward: IntentReward) -> None:
    clerk = Clerk()
    KoopmanEnvironment(EnvironmentParts(workcell, reward, clerk, 5), 0).close()
    assert clerk.closed


def test_the_arm_is_seen_where_it_is_before_the_first_step(make: Make, workcell: Workcell) -> None:
    environment = make()
    environment.reset()
    joints = environment.physics.data.qpos[workcell.scene.joint_index]
    np.testing.assert_allclose(workcell.arm.forward(joints), environment.pose, atol=1e-6)
