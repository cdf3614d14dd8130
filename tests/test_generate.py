import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import Parts, with_fields

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.generate import generate, smooth_variation
from koopdqn.errors import WorkFailedError
from koopdqn.pose import Array
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import Motion, Reachability, Workcell


def hausdorff(a: Array, b: Array) -> float:
    gap = np.linalg.norm(a[:, None, :3] - b[None, :, :3], axis=2)
    return float(max(gap.min(axis=1).max(), gap.min(axis=0).max()))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_demonstrations_from_one_start_differ_as_people_do(workcell: Workcell, parts: Parts, seed: int) -> None:
    same_start = with_fields(parts.task, start_half_range_m=[0.0, 0.0, 0.0])
    found = generate(same_start, workcell.reachability, parts.demo, seed).demonstrations
    for a, b in itertools.combinations(found.items, 2):
        np.testing.assert_allclose(a.poses[0], b.poses[0], atol=1e-9)
        # Shapes are drawn 5 mm apart on the nominal path; following it cuts bends, and 0.2 mm of that at most.
        assert 0.005 <= hausdorff(a.poses, b.poses) <= 0.015


def test_the_seed_fixes_everything(workcell: Workcell, parts: Parts, demonstrations: Demonstrations) -> None:
    again = generate(parts.task, workcell.reachability, parts.demo, 0).demonstrations
    other = generate(parts.task, workcell.reachability, parts.demo, 1).demonstrations
    assert again.digest() == demonstrations.digest() != other.digest()


def test_each_lies_on_the_arm_touches_nothing_and_ends_at_the_goal(
    workcell: Workcell, demonstrations: Demonstrations, shelf_task: ShelfTask
) -> None:
    assert (demonstrations.task, demonstrations.arm, len(demonstrations)) == ("shelf", workcell.arm.name, 5)
    for item in demonstrations.items:
        assert item.joints is not None
        assert pose.position_distance(workcell.arm.forward(item.joints), item.poses).max() < 1e-9
        assert all(workcell.scene.contact(joints) == "" for joints in item.joints[::5])
        assert shelf_task.reached(item.poses[-1:])[0]
        assert not shelf_task.rule_broken(item.poses).any()
        offset = np.abs(item.poses[0, :3] - shelf_task.nominal_start[:3])
        assert np.all(offset <= np.array(shelf_task.start_half_range_m) + 1e-9)


class _Refusing(Reachability):
    """An arm that cannot take every third start, nor follow every other path."""

    def enter(self, pose: Array) -> Motion:
        return Motion(None, "unreachable") if int(pose[0] * 1e7) % 3 == 0 else super().enter(pose)

    def follow(self, poses: Array) -> tuple[Array | None, str]:
        return (None, "collision") if int(poses[1, 1] * 1e9) % 2 == 0 else super().follow(poses)


def test_a_small_set_is_the_beginning_of_a_large_one_whatever_was_refused(workcell: Workcell, parts: Parts) -> None:
    arm = _Refusing(workcell.arm, workcell.scene, workcell.reachability.posture)
    sets = [generate(parts.task, arm, parts.demo.model_copy(update={"count": n}), 0) for n in (1, 2, 5)]
    assert min(sets[-1].redrawn[reason] for reason in ("collision", "unreachable")) > 0
    for smaller, larger in itertools.pairwise(sets):
        assert sum(smaller.redrawn.values()) <= sum(larger.redrawn.values())
        for one, other in zip(smaller.demonstrations.items, larger.demonstrations.items, strict=False):
            np.testing.assert_array_equal(one.poses, other.poses)
            np.testing.assert_array_equal(one.times, other.times)


def test_samples_come_at_the_wished_rate_and_speed(demonstrations: Demonstrations, parts: Parts) -> None:
    for item in demonstrations.items:
        np.testing.assert_allclose(np.diff(item.times)[:-1], parts.demo.sample_seconds, atol=1e-9)
        assert np.diff(item.times)[-1] <= parts.demo.sample_seconds + 1e-9
        speeds = pose.position_distance(item.poses[1:], item.poses[:-1]) / np.diff(item.times)
        assert speeds[len(speeds) // 5 : -len(speeds) // 5].mean() == pytest.approx(parts.demo.speed_m_s, rel=0.35)


@given(seed=st.integers(0, 1000))
def test_a_wander_vanishes_at_both_ends_and_is_as_large_as_said(shelf_task: ShelfTask, seed: int) -> None:
    offset = smooth_variation(shelf_task, np.random.default_rng(seed))
    assert offset.shape == shelf_task.nominal_path.points.shape
    np.testing.assert_allclose(offset[[0, -1]], 0.0, atol=1e-15)
    assert np.linalg.norm(offset, axis=1).max() == pytest.approx(shelf_task.variation_m, rel=1e-12)
    # Smooth: neighbours, half a millimetre apart, differ by little.
    assert np.linalg.norm(np.diff(offset, axis=0), axis=1).max() < 0.05 * shelf_task.nominal_path.spacing * 20


def test_progress_is_told_once_a_demonstration(workcell: Workcell, parts: Parts) -> None:
    told: list[int] = []
    two = parts.demo.model_copy(update={"count": 2})
    generate(parts.task, workcell.reachability, two, 3, told.append)
    assert told == [1, 2]


def test_a_path_the_arm_cannot_follow_ends_with_the_reasons(workcell: Workcell, parts: Parts) -> None:
    coarse = {"step_m": 0.021, "position_tolerance_m": 0.02}
    through_wall = with_fields(parts.task, waypoints=[[0.53, -0.2, 0.42], [0.59, 0.1, 0.47]], **coarse)
    refusal = r"task shelf: the arm must be able to follow the demonstrator, found at .* collision: "
    with pytest.raises(WorkFailedError, match=refusal):
        generate(through_wall, workcell.reachability, parts.demo, 0)
