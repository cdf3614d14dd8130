from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.intent.reward import ASKED, RULE, SOURCES, TRUSTED, IntentReward, RewardSettings
from koopdqn.intent.trust import Trust
from koopdqn.intent.tube import Tube
from koopdqn.pose import Array
from koopdqn.tasks.actions import legal_actions, reached_poses, within_tolerance
from koopdqn.tasks.start_frame import StartFrame

SIGN = RewardSettings(
    shape="sign",
    prediction="rescaled",
    size=1.0,
    goal=0.0,
)
AXES = np.array([4, 5, 6, 7, 8, 9])


def reward_with(base: IntentReward, **fields: object) -> IntentReward:
    return IntentReward(base.task, base.model, base.trust, base.settings.model_copy(update=fields))


def undoubting(base: IntentReward, doubt: float = 0.0) -> IntentReward:
    """The same reward with one doubt everywhere."""
    trust = replace(base.trust, doubt=np.full_like(base.trust.doubt, doubt))
    return IntentReward(base.task, base.model, trust, base.settings)


def beside(trajectories: list[Array], seed: int, count: int, spread: float) -> tuple[Array, np.ndarray]:
    """Poses near demonstrated ones, with their steps."""
    rng = np.random.default_rng(seed)
    steps = rng.integers(0, min(len(rows) for rows in trajectories), count)
    poses = np.array([trajectories[rng.integers(len(trajectories))][step] for step in steps])
    poses[:, :3] += spread * rng.normal(size=(count, 3))
    return poses, steps


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), spread=st.floats(0, 0.004), prediction=st.sampled_from(["raw", "rescaled"]))
def test_of_what_is_allowed_the_best_is_certain_where_the_state_is_trusted(
    reward: IntentReward, trajectories: list[Array], seed: int, spread: float, prediction: str
) -> None:
    doubting = reward_with(undoubting(reward, doubt=50.0), prediction=prediction)
    poses, steps = beside(trajectories, seed, 20, spread)
    evaluation = doubting.evaluate_actions(poses, steps)
    allowed = evaluation.source != RULE
    best = evaluation.margin == evaluation.margin.max(axis=1, keepdims=True)
    trusted = (evaluation.source == TRUSTED).any(axis=1)
    assert trusted.any()
    np.testing.assert_array_equal((evaluation.source == TRUSTED)[trusted], (best & allowed)[trusted])


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), spread=st.floats(0, 0.02))
def test_the_sign_rule_is_the_papers(reward: IntentReward, trajectories: list[Array], seed: int, spread: float) -> None:
    """Plus where both distances to the prediction are within tolerance, minus otherwise and by rule."""
    poses, steps = beside(trajectories, seed, 20, spread)
    for prediction in ("raw", "rescaled"):
        evaluation = reward_with(reward, **{**SIGN.model_dump(), "prediction": prediction}).evaluate_actions(
            poses, steps
        )
        wished = (
            reward.model.predict(poses) if prediction == "raw" else reward.model.predict_step(poses, reward.task.step_m)
        )
        np.testing.assert_array_equal(evaluation.predicted, wished)
        right = within_tolerance(evaluation.reached, wished[:, None], reward.task) & legal_actions(reward.task)
        np.testing.assert_array_equal(evaluation.reward, np.where(right, 1.0, -1.0))


@settings(max_examples=25)
@given(seed=st.integers(0, 1000), spread=st.floats(0, 0.02), size=st.floats(0.1, 3))
def test_the_margin_has_the_same_sign_and_is_bounded(
    reward: IntentReward, trajectories: list[Array], seed: int, spread: float, size: float
) -> None:
    poses, steps = beside(trajectories, seed, 20, spread)
    signed = reward_with(reward, shape="sign", size=size, goal=0.0).evaluate_actions(poses, steps).reward
    margin = reward_with(reward, shape="margin", size=size, goal=0.0).evaluate_actions(poses, steps).reward
    np.testing.assert_array_equal(margin >= 0, signed >= 0)
    assert np.abs(margin).max() <= size
    np.testing.assert_allclose(np.abs(signed), size)


def test_a_larger_margin_is_nearer_to_the_prediction(reward: IntentReward, trajectories: list[Array]) -> None:
    poses, steps = beside(trajectories, 0, 30, 0.002)
    evaluation = reward_with(reward, shape="margin", goal=0.0).evaluate_actions(poses, steps)
    distance = pose.position_distance(evaluation.reached, evaluation.predicted[:, None])
    for row in range(len(poses)):
        order = np.argsort(distance[row, AXES])
        assert np.all(np.diff(evaluation.reward[row, AXES][order]) <= 1e-12)


def test_actions_named_for_rotation_are_wrong_by_rule_where_orientation_is_held(
    reward: IntentReward, trajectories: list[Array]
) -> None:
    poses, steps = beside(trajectories, 1, 30, 0.001)
    evaluation = reward.evaluate_actions(poses, steps)
    for action in (0, 2, 3):
        np.testing.assert_array_equal(evaluation.reward[:, action], -reward.settings.size)
        np.testing.assert_array_equal(evaluation.source[:, action], RULE)
        assert evaluation.known[:, action].all()


def test_an_action_that_changes_nothing_is_wrong_even_at_the_goal(reward: IntentReward) -> None:
    evaluation = reward.evaluate_actions(reward.task.goal[None], np.array([500]))
    assert pose.position_distance(evaluation.reached[0, 1], reward.task.goal) == 0
    assert evaluation.reward[0, 1] == -reward.settings.size
    assert evaluation.source[0, 1] == RULE


def test_poses_may_be_lists(reward: IntentReward, trajectories: list[Array]) -> None:
    poses, steps = beside(trajectories, 2, 5, 0.02)
    listed = reward.evaluate_actions(poses.tolist(), steps.tolist(), poses.tolist())
    np.testing.assert_array_equal(listed.reward, reward.evaluate_actions(poses, steps, poses).reward)


def test_knowing_is_having_a_source_other_than_asking(reward: IntentReward, trajectories: list[Array]) -> None:
    poses, steps = beside(trajectories, 2, 100, 0.02)
    evaluation = reward.evaluate_actions(poses, steps)
    np.testing.assert_array_equal(evaluation.known, evaluation.source != ASKED)
    assert set(np.unique(evaluation.source)) == {RULE, TRUSTED, ASKED}
    assert SOURCES == ("rule", "trusted", "asked", "remembered", "certified")


@pytest.mark.parametrize("needs", ["reached", "both"])
def test_what_must_be_trusted_is_the_reached_state_or_both(
    reward: IntentReward, trajectories: list[Array], needs: str
) -> None:
    sure = undoubting(reward).trust
    assert isinstance(sure, Tube)
    trust = replace(sure, settings=sure.settings.model_copy(update={"needs": needs}), radius=0.6 * sure.radius)
    evaluation = IntentReward(reward.task, reward.model, trust, SIGN).evaluate_actions(
        *(data := beside(trajectories, 3, 200, 0.012))
    )
    poses, steps = data
    here = trust.contains(poses, steps)
    there = np.stack([trust.contains(evaluation.reached[:, action], steps + 1) for action in range(10)], axis=1)
    wanted = there if needs == "reached" else there & here[:, None]
    trusted = evaluation.source[:, AXES] == TRUSTED
    np.testing.assert_array_equal(trusted, wanted[:, AXES])
    assert (there & ~here[:, None])[:, AXES].any(), "some case must tell the two apart"


def test_from_elsewhere_poses_are_predicted_and_trusted_as_from_the_nominal_start(
    reward: IntentReward, trajectories: list[Array]
) -> None:
    frame = StartFrame(reward.task.nominal_start[:3], reward.task.goal[:3], follows=True)
    model = reward.model.within(frame)
    following = IntentReward(reward.task, model, undoubting(reward).trust, SIGN)
    poses, steps = beside(trajectories, 7, 200, 0.004)
    starts = reward.task.draw_starts(np.random.default_rng(7), len(poses))
    evaluation = following.evaluate_actions(poses, steps, starts)
    np.testing.assert_array_equal(evaluation.reached, reached_poses(poses, reward.task))
    np.testing.assert_array_equal(evaluation.local, frame.to_frame(poses, starts))
    np.testing.assert_array_equal(evaluation.local_reached, frame.to_frame(evaluation.reached, starts[:, None]))
    wished = model.to_step(poses, model.intended(poses, starts), reward.task.step_m)
    np.testing.assert_allclose(evaluation.predicted, wished, atol=1e-12)
    here = reward.trust.contains(evaluation.local, steps)
    there = [reward.trust.contains(evaluation.local_reached[:, action], steps + 1) for action in AXES]
    trusted = evaluation.source[:, AXES] == TRUSTED
    np.testing.assert_array_equal(trusted, np.stack(there, axis=1) & here[:, None])
    assert not np.array_equal(here, reward.trust.contains(poses, steps)), "some start must tell the two apart"
    # From the nominal start itself nothing is moved.
    nominal = following.evaluate_actions(poses, steps, np.repeat(reward.task.nominal_start[None], len(poses), axis=0))
    plain = following.evaluate_actions(poses, steps)
    for name in ("predicted", "reward", "margin", "local_reached"):
        np.testing.assert_allclose(getattr(nominal, name), getattr(plain, name), atol=1e-9)


class _Recording(Tube):
    """A trust domain that keeps which steps it was asked about."""

    def assess(self, poses: Array, steps: np.ndarray) -> Trust:
        ASKED_STEPS.append((len(poses), np.array(steps)))
        return super().assess(poses, steps)


ASKED_STEPS: list[tuple[int, np.ndarray]] = []


def test_trust_is_asked_of_reached_poses_one_step_later(reward: IntentReward, trajectories: list[Array]) -> None:
    names = [each.name for each in fields(reward.trust)]
    recording = _Recording(**{name: getattr(reward.trust, name) for name in names})
    ASKED_STEPS.clear()
    IntentReward(reward.task, reward.model, recording, SIGN).evaluate_actions(
        trajectories[0][[3, 40]], np.array([3, 40])
    )
    by_count = dict(ASKED_STEPS)
    assert by_count.keys() == {2, 20}
    np.testing.assert_array_equal(by_count[2], [3, 40])
    np.testing.assert_array_equal(by_count[20], [4] * 10 + [41] * 10)


def test_doubt_leaves_the_best_action_and_the_clear_ones(reward: IntentReward, trajectories: list[Array]) -> None:
    poses, steps = trajectories[0][:150], np.arange(150)
    exact = reward_with(reward, shape="margin", goal=0.0)
    sure, doubting = (undoubting(exact, doubt).evaluate_actions(poses, steps) for doubt in (0.0, 0.3))
    np.testing.assert_array_equal(sure.reward, doubting.reward)
    dropped = (sure.source == TRUSTED) & (doubting.source == ASKED)
    assert dropped.any()
    assert np.abs(sure.margin[dropped]).max() < 0.3
    best = sure.margin.argmax(axis=1)
    rows = np.arange(len(poses))
    np.testing.assert_array_equal(doubting.source[rows, best], sure.source[rows, best])
    clear = np.abs(sure.margin) > 0.3
    np.testing.assert_array_equal(doubting.source[clear], sure.source[clear])


def test_reaching_the_goal_rightly_is_worth_more(reward: IntentReward) -> None:
    bonus = 0.75
    near = reward.task.goal[None].copy()
    near[0, 0] -= reward.task.goal_tolerance_m + 0.5 * reward.task.step_m
    given_ = reward_with(reward, shape="sign", goal=bonus).evaluate_actions(near, np.array([200]))
    without = reward_with(reward, shape="sign", goal=0.0).evaluate_actions(near, np.array([200]))
    difference = given_.reward - without.reward
    right_there = given_.at_goal & (without.reward >= 0)
    assert right_there.any()
    np.testing.assert_allclose(difference[right_there], bonus)
    np.testing.assert_array_equal(difference[~right_there], 0.0)
    reached = reached_poses(near, reward.task)
    np.testing.assert_array_equal(given_.at_goal[0], reward.task.reached(reached[0]))


def test_answers_are_worth_what_predictions_are(reward: IntentReward) -> None:
    worth = reward_with(reward, size=2.0, goal=0.5).value
    assert worth(True, False) == 2.0
    assert worth(True, True) == 2.5
    assert worth(False, False) == worth(False, True) == -2.0


def test_every_demonstrated_state_has_a_right_action(reward: IntentReward, trajectories: list[Array]) -> None:
    for rows in trajectories[:2]:
        evaluation = reward.evaluate_actions(rows[:-2], np.arange(len(rows) - 2))
        assert (evaluation.reward >= 0).any(axis=1).all()


def test_an_answer_moves_no_prediction_that_demonstrations_decide(
    reward: IntentReward, trajectories: list[Array]
) -> None:
    here = trajectories[0][60:61]
    after = here + np.array([[0, 0, 0.0021, 0, 0, 0, 0]])
    moved = reward.extended(here[:0], np.zeros(0), here, after, np.array([0.2]))
    poses, steps = beside(trajectories, 5, 300, 0.03)
    shown = reward.trust.assess(poses, steps).demonstrated
    assert 20 < shown.sum() < 280
    before, then = reward.evaluate_actions(poses, steps).predicted, moved.evaluate_actions(poses, steps).predicted
    np.testing.assert_array_equal(then[shown], before[shown])
    changed = np.abs(then - before).max(axis=1) > 1e-6
    assert changed[~shown].mean() > 0.5


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (lambda poses: poses[0], r"poses must have shape \(N, 7\), found \(7,\)"),
        (lambda poses: np.nan * poses, "poses must be finite, found NaN"),
        (lambda poses: 0.5 * poses, r"poses must hold quaternions of length 1 within 0.001, found 0\.5"),
    ],
)
def test_strange_poses_are_refused(
    reward: IntentReward, trajectories: list[Array], changed: Callable[[Array], Array], words: str
) -> None:
    poses = trajectories[0][40:42]
    with pytest.raises(BadInputError, match=words):
        reward.evaluate_actions(changed(poses), np.array([40, 41]), poses)
    with pytest.raises(BadInputError, match=words.replace("poses", "starts")):
        reward.evaluate_actions(poses, np.array([40, 41]), changed(poses))
