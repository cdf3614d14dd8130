import numpy as np
from parts import Parts

from koopdqn import pose
from koopdqn.intent.fitting import Fitted
from koopdqn.intent.model import IntentModel
from koopdqn.pose import Array


def asked(trajectories: list[Array]) -> tuple[Array, Array]:
    """Poses beside a demonstration, and answers that go elsewhere than the model does."""
    poses = trajectories[0][40:100:20].copy()
    following = poses.copy()
    following[:, 2] += 0.0021
    return poses, following


def test_the_prediction_goes_where_the_answers_say(fitted: Fitted, trajectories: list[Array]) -> None:
    poses, following = asked(trajectories)
    before = pose.position_distance(fitted.model.predict(poses), following)
    after = pose.position_distance(fitted.model.extended(poses, following).predict(poses), following)
    assert before.min() > 1e-3
    assert after.max() < 0.05 * before.min()


def test_beyond_their_reach_and_at_the_goal_nothing_changes(
    fitted: Fitted, trajectories: list[Array], parts: Parts
) -> None:
    poses, following = asked(trajectories)
    model = fitted.model.extended(poses, following)
    rng = np.random.default_rng(0)
    points = parts.task.draw_starts(rng, 300)
    points[:, :3] = rng.uniform([0.35, -0.3, 0.3], [0.7, 0.3, 0.6], (300, 3))
    gap = pose.position_distance(points[:, None], poses[None]).min(axis=1)
    far = points[gap > 2 * model.reach]
    assert len(far) > 50
    np.testing.assert_array_equal(model.predict(far), fitted.model.predict(far))
    goal = parts.task.goal[None]
    near_goal = goal + np.array([0.001, 0, 0, 0, 0, 0, 0])
    model = fitted.model.extended(near_goal, poses[:1])
    np.testing.assert_array_equal(model.predict(goal)[:, :3], goal[:, :3])


def test_pairs_given_one_after_the_other_are_those_given_together_and_are_stored(
    fitted: Fitted, trajectories: list[Array], parts: Parts
) -> None:
    poses, following = asked(trajectories)
    together = fitted.model.extended(poses, following)
    in_turn = fitted.model.extended(poses[:1], following[:1]).extended(poses[1:], following[1:])
    stored = IntentModel.restore(together.arrays(), parts.intent)
    everything = np.concatenate(trajectories)
    for other in (in_turn, stored):
        np.testing.assert_array_equal(other.predict(everything), together.predict(everything))
    base = {name: values for name, values in together.arrays().items() if not name.startswith("pairs_")}
    np.testing.assert_array_equal(
        IntentModel.restore(base, parts.intent).predict(everything), fitted.model.predict(everything)
    )
    assert fitted.model.extended(poses[:0], following[:0]) is fitted.model
