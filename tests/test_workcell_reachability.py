import numpy as np
import pytest
from parts import Parts, with_fields

from koopdqn import pose
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.tasks.workcell import COLLISION, JUMP, UNREACHABLE, Reachability, Workcell, open_workcell


def entered(workcell: Workcell, at: Array) -> Array:
    joints = workcell.reachability.enter(at).joints
    assert joints is not None
    return joints


def test_a_motion_ends_where_it_should(workcell: Workcell) -> None:
    start = workcell.task.nominal_start
    wished = start.copy()
    wished[0] -= workcell.task.step_m
    motion = workcell.reachability.move(wished, entered(workcell, start))
    assert motion.joints is not None
    assert (motion.reason, motion.detail) == ("", "")
    assert pose.position_distance(workcell.arm.forward(motion.joints), wished) < 1e-9


def test_what_cannot_be_done_is_refused_with_its_reason(workcell: Workcell) -> None:
    task, start = workcell.task, workcell.task.nominal_start
    joints = entered(workcell, start)
    far, behind, wall = (pose.make(p, start[3:]) for p in ([3.0, 0, 0.4], [0.23, -0.2, 0.4], [0.56, -0.03, 0.47]))
    assert workcell.reachability.move(far, joints).reason == UNREACHABLE
    jump = workcell.reachability.move(behind, joints)
    assert jump.reason == JUMP
    assert "would jump" in jump.detail
    beside = workcell.arm.inverse(wall, joints)
    assert beside.success
    hit = workcell.reachability.move(wall, beside.joints)
    assert hit.reason == COLLISION
    assert "shelf_right" in hit.detail
    assert workcell.reachability.enter(far).reason == UNREACHABLE
    assert workcell.reachability.enter(wall).reason == COLLISION
    assert task.nominal_start is start


def test_a_batch_of_motions_is_each_by_itself(workcell: Workcell) -> None:
    start = workcell.task.nominal_start
    joints = entered(workcell, start)
    aside, back = start[:3] + np.array([[0.0, 0.002, 0.0], [-0.002, 0.0, 0.0]])
    targets = pose.make([aside, [3.0, 0, 0.4], [0.23, -0.2, 0.4], back, [0.56, -0.03, 0.47]], start[3:])
    wall = workcell.arm.inverse(targets[-1], joints).joints
    seeds = np.array([joints] * 4 + [wall])
    together = workcell.reachability.move_batch(targets, seeds)
    assert [motion.reason for motion in together] == ["", UNREACHABLE, JUMP, "", COLLISION]
    for motion, target, seed in zip(together, targets, seeds, strict=True):
        alone = workcell.reachability.move(target, seed)
        assert (motion.reason, motion.detail) == (alone.reason, alone.detail)
        if alone.joints is not None:
            assert motion.joints is not None
            np.testing.assert_allclose(motion.joints, alone.joints, atol=1e-9)
    assert workcell.reachability.move_batch(np.zeros((0, 7)), np.zeros((0, 6))) == []


def test_a_step_takes_as_long_as_its_slowest_joint_needs(parts: Parts, workcell: Workcell) -> None:
    start = workcell.task.nominal_start
    wished = start.copy()
    wished[1] += 0.02
    joints = entered(workcell, start)
    moved = workcell.reachability.move(wished, joints).joints
    assert moved is not None
    needed = float((np.abs(moved - joints) / np.array(workcell.arm.velocity_limits)).max())
    path = np.array([joints, moved, moved])
    for seconds in (0.5 * needed, 2.0 * needed):
        reachability = Reachability(parts.arm.model_copy(update={"step_seconds": seconds}), workcell.scene)
        assert reachability.move(wished, joints).joints is not None
        np.testing.assert_allclose(reachability.durations(path), [max(seconds, needed), seconds])


def test_entering_takes_the_free_solution_nearest_home(workcell: Workcell) -> None:
    start, home = workcell.task.nominal_start, np.array(workcell.arm.home)
    chosen = entered(workcell, start)
    free = [q for q in workcell.arm.solutions(start, home) if not workcell.scene.contact(q)]
    assert len(free) > 1
    assert np.abs(chosen - home).max() == pytest.approx(min(np.abs(q - home).max() for q in free), abs=1e-12)


def test_entering_takes_the_free_solution_nearest_the_posture_but_with_room_to_turn(workcell: Workcell) -> None:
    """Of the solutions nearest to a posture wound up to a limit it takes the one that is not wound up."""
    start = workcell.task.nominal_start
    unwound = entered(workcell, start)
    for joint, turns in ((0, -1), (3, 1), (5, 1)):
        posture = unwound.copy()
        posture[joint] += turns * 2.0 * np.pi
        assert np.any(np.abs(posture) > np.pi)
        wound = Reachability(workcell.arm, workcell.scene, posture)
        joints = wound.enter(start).joints
        assert joints is not None
        np.testing.assert_allclose(joints, unwound, atol=1e-9)
        assert np.all(np.abs(joints) <= np.pi)


@pytest.fixture(scope="module")
def knife() -> Workcell:
    config = Configuration.load(composed(["task=knife"]))
    return open_workcell(config.task, config.robot)


def test_far_starts_are_entered_in_the_nominal_one_s_posture_unless_it_collides(knife: Workcell) -> None:
    """From home every other far start of the knife would be taken in another posture."""
    task, reachability = knife.task.with_starts_scaled(3.0), knife.reachability
    nominal = entered(knife, knife.task.nominal_start)
    np.testing.assert_allclose(reachability.posture, nominal, atol=1e-12)
    from_home = Reachability(knife.arm, knife.scene)
    starts, joints, _ = reachability.draw_starts(task, np.random.default_rng(0), 40)
    others = np.array([from_home.enter(start).joints for start in starts])
    near, also_from_home = (np.abs(taken - nominal).max(axis=1) < np.radians(60.0) for taken in (joints, others))
    assert also_from_home.sum() < 25 < near.sum()
    assert all(knife.scene.contact(knife.arm.solutions(start, nominal)[0]) for start in starts[~near])


def test_following_is_entering_and_moving(workcell: Workcell) -> None:
    path = workcell.task.demonstrator.roll_out(workcell.task.nominal_start, 10)
    joints, reason = workcell.reachability.follow(path)
    assert reason == ""
    assert joints is not None
    np.testing.assert_allclose(workcell.reachability.flange_poses(joints)[:, :3], path[:, :3], atol=1e-9)
    np.testing.assert_array_equal(joints[0], entered(workcell, path[0]))
    path[5, 0] += 2.0
    assert workcell.reachability.follow(path) == (None, UNREACHABLE)


def test_starts_are_free_and_refused_ones_are_drawn_again_and_counted(workcell: Workcell) -> None:
    # The region reaches into the side wall from here.
    near_wall = with_fields(workcell.task, waypoints=[[0.53, -0.12, 0.42], [0.59, 0.1, 0.47]])
    starts, joints, refused = workcell.reachability.draw_starts(near_wall, np.random.default_rng(0), 30)
    assert starts.shape == (30, 7)
    assert refused > 0
    assert all(workcell.scene.contact(row) == "" for row in joints)
    assert pose.position_distance(workcell.arm.forward(joints), starts).max() < 1e-9


def test_a_start_region_out_of_reach_is_refused(workcell: Workcell) -> None:
    away = with_fields(workcell.task, waypoints=[[3.0, 0.0, 0.4], [0.59, 0.1, 0.47]])
    with pytest.raises(BadInputError, match=r"starts of the start region.*found 51 refused of 51"):
        workcell.reachability.draw_starts(away, np.random.default_rng(0), 1)
