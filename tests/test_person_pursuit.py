import itertools

import numpy as np
import pytest
from parts import with_fields

from koopdqn import pose
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.pose import Array
from koopdqn.tasks.person import Expert, Pursuit, ReferencePath
from koopdqn.tasks.shelf import ShelfTask

STEP, AHEAD = 0.002, 0.015
UPRIGHT = np.array([0.0, 1.0, 0.0, 0.0])


@pytest.fixture
def expert() -> Expert:
    ends = pose.make([[0.0, 0, 0], [0.4, 0, 0]], UPRIGHT)
    return Pursuit(name="pursuit", look_ahead_m=AHEAD).expert(ReferencePath.along(ends), ends[-1], STEP, 0.0)


def corners(task: ShelfTask) -> Array:
    signs = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
    return pose.make(
        task.nominal_start[:3] + signs * np.array(task.start_half_range_m), task.nominal_start[pose.QUATERNION]
    )


def test_every_step_is_one_step_long_until_the_goal(expert: Expert) -> None:
    passed = expert.roll_out(pose.make([0.0, 0.03, -0.01], UPRIGHT), 1000)
    gaps = np.linalg.norm(np.diff(passed[:, :3], axis=0), axis=1)
    np.testing.assert_allclose(gaps[:-1], STEP, atol=1e-12)
    assert gaps[-1] <= STEP * (1 + 1e-12)
    np.testing.assert_allclose(passed[-1], expert.goal, atol=1e-6)


def test_the_goal_is_where_it_rests(expert: Expert) -> None:
    np.testing.assert_array_equal(expert.next_pose(expert.goal[None])[0], expert.goal)


def test_it_comes_to_the_goal_from_anywhere_in_the_start_region_and_holds_the_path(shelf_task: ShelfTask) -> None:
    expert = shelf_task.demonstrator
    path = shelf_task.nominal_path
    starts = np.concatenate([corners(shelf_task), shelf_task.draw_starts(np.random.default_rng(0), 20)])
    passed = [starts]
    for _ in range(int(2 * path.length / shelf_task.step_m)):
        passed.append(expert.next_pose(passed[-1]))
    assert pose.position_distance(passed[-1], shelf_task.goal).max() < 1e-6
    assert pose.rotation_distance(passed[-1], shelf_task.goal).max() < 1e-6
    # Ten look-ahead distances further on, the path is held, but for cutting its bends a little.
    held = np.array(passed)[int(10 * AHEAD / shelf_task.step_m) :].reshape(-1, 7)[:, :3]
    assert np.linalg.norm(held - path.at(path.nearest(held)), axis=1).max() < 0.2 * AHEAD


def test_it_is_a_function_of_the_pose_alone(shelf_task: ShelfTask) -> None:
    expert = shelf_task.demonstrator
    poses = shelf_task.draw_starts(np.random.default_rng(1), 50)
    together = expert.next_pose(poses)
    expert.roll_out(poses[3], 20)
    backward = expert.next_pose(poses[::-1])[::-1]
    np.testing.assert_allclose(backward, together, atol=1e-12)
    for point, reached in zip(poses[:10], together, strict=False):
        np.testing.assert_allclose(expert.next_pose(point[None])[0], reached, atol=1e-12)


@pytest.mark.parametrize(
    "options", [["task=shelf", "person=square"], ["task=knife"], ["task=both_sides", "person=via"]]
)
def test_paths_followed_together_are_those_followed_alone_to_the_last_bit(options: list[str]) -> None:
    task = Configuration.load(composed([*options, "out=unused"])).task
    expert, starts = task.expert(finer=2), task.draw_starts(np.random.default_rng(2), 4)
    for start, path in zip(starts, expert.roll_outs(starts, 300), strict=True):
        np.testing.assert_array_equal(expert.roll_out(start, 300), path)


def test_paths_of_different_lengths_each_end_at_the_goal(expert: Expert) -> None:
    starts = pose.make([[0.3, 0.01, 0.0], [0.0, 0.0, 0.0], [0.39, 0.0, 0.0]], UPRIGHT)
    paths = expert.roll_outs(starts, 1000)
    assert len(paths[2]) < len(paths[0]) < len(paths[1])
    for start, path in zip(starts, paths, strict=True):
        np.testing.assert_array_equal(path[0], start)
        np.testing.assert_allclose(path[-1], expert.goal, atol=1e-6)
    assert expert.roll_outs(starts[:0], 1000) == []


def test_held_orientation_is_the_goals(shelf_task: ShelfTask) -> None:
    tilted = shelf_task.nominal_start.copy()
    tilted[3:] = pose.multiply(pose.from_rotation_vector([0.1, 0, 0]), tilted[3:])
    reached = shelf_task.demonstrator.next_pose(tilted[None])
    assert pose.rotation_distance(reached, shelf_task.goal)[0] < 1e-12


@pytest.mark.parametrize("person", ["pursuit", "square", "via", "wide"])
def test_finer_steps_follow_the_same_way(shelf_task: ShelfTask, person: str) -> None:
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    from koopdqn.resources import conf_dir

    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        node = OmegaConf.to_container(compose("config", overrides=[f"person={person}"]).person)
    task = with_fields(shelf_task, person=node)
    start = task.nominal_start.copy()
    start[1] += 0.01
    coarse, fine = task.expert().roll_out(start, 1000), task.expert(finer=4).roll_out(start, 4000)
    assert np.linalg.norm(np.diff(fine[:, :3], axis=0), axis=1)[:-1] == pytest.approx(task.step_m / 4)
    gap = np.linalg.norm(coarse[:, None, :3] - fine[None, :, :3], axis=2).min(axis=1)
    assert gap.max() < task.step_m
