"""Correcting a learned path: it leads through the waypoints shown, and stays what it was elsewhere."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from helpers_shelf import PARTS, reward_of, shelf, taught

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.app.api import load_config
from koopdqn.artifact import described
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.evaluation.correction import CorrectionSettings, Followed, along, check_clear, in_base, in_frame, played
from koopdqn.intent.bend import Bend, BentIntent, BentTrust
from koopdqn.pose import Array
from koopdqn.rl.dqn import Learner
from koopdqn.rl.network import size
from koopdqn.rl.policy import Policy, PolicyAround, around, read_policy, tube_of, write_corrected, write_policy
from koopdqn.safety import Guard
from koopdqn.safety.guard import TUBE
from koopdqn.settings import validate
from koopdqn.tasks.actions import reached_poses, twists_between
from koopdqn.tasks.obstacles import Obstacle
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.workcell import open_workcell

LIMIT = 800
X = np.linspace(0.0, 0.4, 41)
LINE = np.stack([X, np.zeros_like(X), np.zeros_like(X)], axis=1)


class _Rewarded(Policy):
    """Values actions as the intent rewards them."""

    def __init__(self) -> None:
        super().__init__(cast(Any, None), shelf().task)

    def values(self, poses: Array, starts: Array) -> np.ndarray:
        steps = np.zeros(len(poses), dtype=np.int64)
        return reward_of(taught()).evaluate_actions(poses, steps, starts).reward


class _Lost(Policy):
    """Values actions at random."""

    def __init__(self) -> None:
        super().__init__(cast(Any, None), shelf().task)

    def values(self, poses: Array, starts: Array) -> np.ndarray:
        return np.random.default_rng(0).normal(size=(len(poses), 10))


class _Twisted(Policy):
    """Takes the twists to where the intent leads."""

    def __init__(self, bend: Bend | None = None) -> None:
        super().__init__(cast(Any, None), shelf().task, continuous=True, bend=bend)

    def values(self, poses: Array, starts: Array) -> np.ndarray:
        model, task = taught().model, shelf().task
        wished = model.to_step(poses, model.intended(poses, starts), task.step_m)
        return twists_between(poses, wished, task)


def _lifted(was: Bend) -> Array:
    """Return four waypoints up to 40 mm above the middle of a path."""
    middle = np.linspace(0.45, 0.65, 4) * len(was.path)
    up = np.array([0.6, 1.0, 1.0, 0.6])[:, None] * np.array([0.0, 0.0, 0.04])
    return np.asarray(was.path[middle.astype(int)] + up)


def _apart(points: Array, line: Array) -> Array:
    return np.asarray(np.linalg.norm(points[:, None] - line, axis=2).min(axis=1))


def test_a_bend_leads_through_its_waypoints_and_moves_nothing_elsewhere() -> None:
    waypoints = np.array([[0.15, 0.02, 0.0], [0.2, 0.04, 0.01], [0.25, 0.02, 0.0]])
    bend = Bend.none(LINE).through(waypoints)
    assert _apart(waypoints, bend.bent).max() < 1e-9
    far = (bend.path[:, 0] < 0.15 - 0.03 - 1e-9) | (bend.path[:, 0] > 0.25 + 0.03 + 1e-9)
    assert far.sum() > 400
    assert not bend.offsets[far].any()
    assert (bend.offsets[:, 1] >= 0.0).all()


def test_a_waypoint_little_aside_can_be_anywhere_but_at_the_ends() -> None:
    for x in np.linspace(0.03, 0.37, 69):
        bend = Bend.none(LINE).through(np.array([[x, 0.005, 0.0]]))
        assert bend.offsets[:, 1].max() == pytest.approx(0.005)


def test_a_second_correction_keeps_the_first() -> None:
    first = Bend.none(LINE).through(np.array([[0.1, 0.02, 0.0]]))
    both = first.through(np.array([[0.3, 0.0, 0.02]]))
    left = both.path[:, 0] < 0.2
    assert np.array_equal(both.offsets[left], first.offsets[left])
    assert both.offsets[~left, 2].max() == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("waypoints", "said"),
    [
        ([[0.2, 0.02, 0.0], [0.15, 0.02, 0.0]], "in the order in which the path passes them"),
        ([[0.2, 0.3, 0.0]], r"within 0\.2 m of the learned path, found one 0\.300 m away"),
        ([[0.01, 0.02, 0.0]], r"at least 0\.02 m of path from its start"),
    ],
)
def test_waypoints_that_no_path_can_take_are_refused(waypoints: list[list[float]], said: str) -> None:
    with pytest.raises(BadInputError, match=said):
        Bend.none(LINE).through(np.array(waypoints))


@pytest.mark.parametrize("policy", [_Rewarded(), _Twisted()], ids=["of Table 1", "continuous"])
def test_the_corrected_stretch_is_followed_and_the_rest_stays(policy: Policy) -> None:
    old = played(shelf(), policy, LIMIT)
    was = along(old, STILL)
    waypoints = _lifted(was)
    now = was.through(waypoints)
    found = Followed.of(old, played(shelf(), PolicyAround(policy, now), LIMIT), was, now, waypoints, STILL)
    assert found.moved.max() > 0.039
    assert found.missed.max() < 0.003
    assert found.inside.max() < 0.0035
    assert found.before.max() < 1e-6
    assert found.behind.mean() < 0.002


def test_waypoints_and_path_meet_in_the_start_frame() -> None:
    start = shelf().task.nominal_start
    frame = StartFrame(start[:3] + np.array([0.0, 0.02, 0.0]), shelf().task.goal[:3], follows=True)
    old = played(shelf(), _Rewarded(), LIMIT)
    seen = in_base(along(old, frame).path, start, frame)
    smooth = along(old, STILL).path
    assert np.linalg.norm(seen[:, None] - smooth, axis=2).min(axis=1).max() < 1e-3
    np.testing.assert_allclose(in_base(in_frame(seen, start, frame), start, frame), seen, atol=1e-6)
    assert np.abs(along(old, frame).path[:10] - smooth[:10]).max() > 0.015


def test_the_guards_tube_goes_with_a_correction() -> None:
    was = along(played(shelf(), _Rewarded(), LIMIT), STILL)
    now = was.through(was.path[[len(was.path) // 2]] + np.array([[0.0, 0.0, 0.08]]))
    corrected = PolicyAround(_Twisted(now), now)
    made, trust = played(shelf(), corrected, LIMIT), taught().trust
    # Also where the intent has meanwhile been led around something that the correction does not pass.
    elsewhere = BentTrust.of(trust, was.through(was.path[[len(was.path) // 2]] + np.array([[0.0, -0.1, 0.0]])))
    assert np.array_equal(
        tube_of(corrected, elsewhere).distance(made.poses), tube_of(corrected, trust).distance(made.poses)
    )
    own, moved = (Guard(shelf(), load_config().guard, each) for each in (trust, tube_of(corrected, trust)))
    refused = own.review(made.poses, made.joints)
    assert refused is not None
    assert refused.cause == TUBE
    assert moved.review(made.poses, made.joints) is None


def test_what_the_arm_cannot_follow_is_told() -> None:
    policy = _Rewarded()
    was = along(played(shelf(), policy, LIMIT), STILL)
    # Into the side wall of the shelf.
    wall = was.path[[len(was.path) // 2]] + np.array([[0.15, -0.02, -0.06]])
    with pytest.raises(WorkFailedError, match="the path must reach the goal, found collision"):
        played(shelf(), PolicyAround(policy, was.through(wall)), LIMIT)


def test_a_correction_is_kept_with_the_policy(tmp_path: Path) -> None:
    task, agent = PARTS.task, PARTS.agent
    learner = Learner(size(task), agent, np.random.default_rng(0))
    about = {"task": described(task)}
    write_policy(tmp_path / "old.safetensors", learner.policy_arrays(), agent.network, STILL, about)
    bend = Bend.none(LINE).through(np.array([[0.2, 0.04, 0.0]]))
    write_corrected(tmp_path / "new.safetensors", tmp_path / "old.safetensors", bend)
    old, new = (read_policy(tmp_path / name, task)[0] for name in ("old.safetensors", "new.safetensors"))
    model = taught().model
    assert old.bend is None
    assert around(old, model) is old
    assert new.bend is not None
    assert np.array_equal(new.bend.bent, bend.bent)
    assert isinstance(around(new, model), PolicyAround)
    led = around(new, BentIntent(model, Bend.none(LINE)))
    assert isinstance(led, PolicyAround)
    assert led.bend is new.bend, "a correction goes before what is led around"
    start = task.nominal_start[None]
    assert np.array_equal(old.values(start, start), new.values(start, start))


def test_a_corrected_policy_follows_its_correction_wherever_it_is_asked() -> None:
    was = along(played(shelf(), _Twisted(), LIMIT), STILL)
    now = was.through(was.path[[len(was.path) // 2]] + np.array([[0.0, 0.0, 0.08]]))
    by_itself, led = played(shelf(), _Twisted(now), LIMIT), played(shelf(), PolicyAround(_Twisted(), now), LIMIT)
    assert np.array_equal(by_itself.poses, led.poses)
    assert np.linalg.norm(by_itself.poses[:, None, :3] - was.path, axis=2).min(axis=1).max() > 0.07


def test_what_stands_in_the_corrected_path_is_refused_and_nothing_else() -> None:
    was = along(played(shelf(), _Twisted(), LIMIT), STILL)
    middle = len(was.path) // 2
    now = was.through(was.path[[middle]] + np.array([[0.0, -0.1, 0.0]]))
    for place in (now.bent[middle], np.array([-0.5, -0.5, 0.5])):
        lamp = {"name": "lamp", "shape": "sphere", "center_m": tuple(place.tolist()), "radius_m": 0.005}
        task = PARTS.task.model_copy(update={"obstacles": (Obstacle.model_validate(lamp),)})
        cell = open_workcell(task, PARTS.arm)
        if place[0] < 0.0:
            check_clear(cell, _Twisted(now), LIMIT)
        else:
            with pytest.raises(BadInputError, match=r"not stand in the way of a corrected run, found: .*collision"):
                check_clear(cell, _Twisted(now), LIMIT)


def test_waypoints_are_a_list_or_a_file(tmp_path: Path) -> None:
    (tmp_path / "better.csv").write_text("0.1,0.2,0.3\n0.2,0.2,0.3\n")
    (tmp_path / "marked.csv").write_text("\ufeff0.1,0.2,0.3\n0.2,0.2,0.3\n", encoding="utf-8")
    read = validate({"waypoints": str(tmp_path / "better.csv")}, CorrectionSettings)
    assert read == validate({"waypoints": str(tmp_path / "marked.csv")}, CorrectionSettings)
    assert read == validate({"waypoints": [[0.1, 0.2, 0.3], [0.2, 0.2, 0.3]]}, CorrectionSettings)
    for wrong in (str(tmp_path / "none.csv"), [[0.1, 0.2]], [["x", 0.2, 0.3]]):
        with pytest.raises(BadInputError, match=r"waypoints"):
            validate({"waypoints": wrong}, CorrectionSettings)


def test_the_command_says_what_it_needs(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["correct", "waypoints=[[0.4,0.0,0.5]]"]) == 2
    assert "run: must name the trained run to correct, found none" in capsys.readouterr().err


def test_a_pose_beside_an_unmoved_place_gets_the_policys_own_action() -> None:
    policy = _Rewarded()
    path = along(played(shelf(), policy, LIMIT), STILL)
    bend = path.through(path.path[[len(path.path) // 2]] + np.array([[0.0, 0.0, 0.03]]))
    poses = np.tile(shelf().task.nominal_start, (5, 1))
    poses[:, pose.POSITION] += np.random.default_rng(0).normal(scale=0.002, size=(5, 3))
    assert np.array_equal(PolicyAround(policy, bend)(poses, poses), policy(poses, poses))


def test_beside_a_moved_path_every_action_comes_forward_and_none_circles() -> None:
    rng, was = np.random.default_rng(0), along(played(shelf(), _Rewarded(), LIMIT), STILL)
    bend = was.through(_lifted(was))
    moved = bend.bent[np.linalg.norm(bend.offsets, axis=1) > 1e-3]
    poses = np.tile(shelf().task.nominal_start, (200, 1))
    poses[:, pose.POSITION] = rng.choice(moved, 200) + rng.normal(scale=0.003, size=(200, 3))
    actions = PolicyAround(_Lost(), bend)(poses, poses)
    reached = reached_poses(poses, shelf().task)[np.arange(200), actions]
    assert (bend.come(reached) > bend.come(poses)).all()
