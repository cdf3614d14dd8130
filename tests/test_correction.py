import numpy as np
from parts import Parts

from koopdqn import pose
from koopdqn.intent.correction import CorrectedIntent
from koopdqn.intent.fit import Fitted
from koopdqn.intent.reward import IntentReward
from koopdqn.pose import Array

REACHES = np.array([0.03, 0.05, 0.04])


def asked(trajectories: list[Array]) -> tuple[Array, Array, Array]:
    """Poses beside a demonstration, answers that go elsewhere than the model does, and their reaches."""
    poses = trajectories[0][40:100:20].copy()
    following = poses.copy()
    following[:, 2] += 0.0021
    return poses, following, REACHES


def test_the_prediction_goes_where_the_answers_say(fitted: Fitted, trajectories: list[Array]) -> None:
    poses, following, reaches = asked(trajectories)
    before = pose.position_distance(fitted.model.predict(poses), following)
    after = pose.position_distance(CorrectedIntent(fitted.model, poses, following, reaches).predict(poses), following)
    assert before.min() > 1e-3
    assert after.max() < 1e-6


def test_within_half_its_reach_an_answer_alone_decides(fitted: Fitted, trajectories: list[Array]) -> None:
    poses, following, reaches = (values[:1] for values in asked(trajectories))
    model = CorrectedIntent(fitted.model, poses, following, reaches)
    rng = np.random.default_rng(0)
    way = rng.normal(size=(100, 3))
    way *= rng.uniform(0.0, 0.49 * reaches[0], (100, 1)) / np.linalg.norm(way, axis=1, keepdims=True)
    points = pose.make(poses[0, :3] + way, poses[0, 3:])
    motion = model.predict(points)[:, :3] - points[:, :3]
    np.testing.assert_allclose(motion, np.tile(following[0, :3] - poses[0, :3], (100, 1)), atol=1e-9)


def test_between_answers_the_nearer_counts_more(fitted: Fitted, trajectories: list[Array]) -> None:
    here = trajectories[0][60]
    poses = here + np.array([[0, 0, 0, 0, 0, 0, 0], [0.02, 0, 0, 0, 0, 0, 0]])
    following = poses + np.array([[0, 0, 0.002, 0, 0, 0, 0], [0, 0.002, 0, 0, 0, 0, 0]])
    model = CorrectedIntent(fitted.model, poses, following, np.array([0.1, 0.1]))
    points = here + np.array([0.005, 0.010, 0.015])[:, None] * np.array([1, 0, 0, 0, 0, 0, 0])
    motion = model.predict(points)[:, :3] - points[:, :3]
    np.testing.assert_allclose(motion[1], [0, 0.001, 0.001], atol=1e-9)
    assert motion[0, 2] > motion[1, 2] > motion[2, 2] > 0


def test_beyond_their_reach_and_at_the_goal_nothing_changes(
    fitted: Fitted, trajectories: list[Array], parts: Parts
) -> None:
    poses, following, reaches = asked(trajectories)
    model = CorrectedIntent(fitted.model, poses, following, reaches)
    rng = np.random.default_rng(0)
    points = parts.task.draw_starts(rng, 300)
    points[:, :3] = rng.uniform([0.35, -0.3, 0.3], [0.7, 0.3, 0.6], (300, 3))
    gap = pose.position_distance(points[:, None], poses[None])
    far = points[(gap > reaches).all(axis=1)]
    assert len(far) > 50
    np.testing.assert_array_equal(model.predict(far), fitted.model.predict(far))
    goal = parts.task.goal[None]
    near_goal = goal + np.array([0.001, 0, 0, 0, 0, 0, 0])
    model = CorrectedIntent(fitted.model, near_goal, poses[:1], reaches[:1])
    np.testing.assert_allclose(model.predict(goal)[:, :3], goal[:, :3], atol=1e-12)


def test_no_pairs_leave_the_model_as_it_is(reward: IntentReward) -> None:
    none = np.zeros((0, 7))
    assert reward.extended(none, np.zeros(0), none, none, np.zeros(0)).model is reward.model
