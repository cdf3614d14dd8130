import numpy as np
import pytest
from parts import load_parts

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.pose import Array
from koopdqn.rl.settings import AgentSettings
from koopdqn.rl.starts import StartSampler
from koopdqn.rl.vector_env import Episodes
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.workcell import Workcell, open_workcell


def exploring(share: float, region: float, scale: float = 1.0, spread_m: float = 0.008) -> AgentSettings:
    return load_parts().agent.model_copy(
        update={
            "exploring_starts": share,
            "exploring_in_region": region,
            "exploring_scale": scale,
            "exploring_spread_m": spread_m,
            "exploring_spread_rad": 0.05,
            "exploring_steps": 40,
        }
    )


def sampler(workcell: Workcell, trajectories: list[Array], share: float, region: float = 0.0) -> StartSampler:
    return StartSampler(workcell, STILL, trajectories, 750, exploring(share, region))


def wide(workcell: Workcell, trajectories: list[Array], share: float, scale: float) -> StartSampler:
    return StartSampler(workcell, STILL, trajectories, 750, exploring(share, 1.0, scale))


def begun(starts: StartSampler, count: int, seed: int = 0) -> Episodes:
    batch, rng = Episodes(count, 6), np.random.default_rng(seed)
    for index in range(count):
        batch.begin(index, 100 + index, starts.draw(rng))
    return batch


def in_region(workcell: Workcell, poses: Array) -> np.ndarray:
    offset = np.abs(poses[:, :3] - workcell.task.nominal_start[:3])
    return np.asarray(np.all(offset <= np.array(workcell.task.start_half_range_m) + 1e-12, axis=1))


@pytest.mark.parametrize(("share", "limit"), [(0.0, 750), (1.0, 40)])
def test_exploring_episodes_are_short_and_lie_along_demonstrations(
    workcell: Workcell, trajectories: list[Array], share: float, limit: int
) -> None:
    batch = begun(sampler(workcell, trajectories, share), 60)
    np.testing.assert_array_equal(batch.limits, limit)
    np.testing.assert_array_equal(batch.exploring, share == 1.0)
    shown = np.concatenate(trajectories)[:, :3]
    gap = np.linalg.norm(batch.poses[:, None, :3] - shown[None], axis=2).min(axis=1)
    if share == 1.0:
        assert gap.max() < 5 * 0.008
        assert not in_region(workcell, batch.poses).all()
    else:
        assert in_region(workcell, batch.poses).all()


def test_an_episode_that_begins_along_no_demonstration_began_where_it_is(
    workcell: Workcell, trajectories: list[Array]
) -> None:
    batch = begun(sampler(workcell, trajectories, 0.5, 1.0), 20)
    np.testing.assert_array_equal(batch.starts, batch.poses)


def test_along_demonstrations_that_follow_their_start_it_lies_beside_them_as_its_start_does(
    workcell: Workcell, trajectories: list[Array]
) -> None:
    task = workcell.task
    frame = StartFrame(task.nominal_start[:3], task.goal[:3], follows=True)
    placed = frame.each(trajectories)
    starts = StartSampler(workcell, frame, placed, 750, exploring(1.0, 0.0, spread_m=1e-9))
    batch = begun(starts, 40)
    assert in_region(workcell, batch.starts).all()
    assert not in_region(workcell, batch.poses).all()
    shown = np.concatenate(placed)[:, :3]
    gaps = []
    for poses in (batch.poses, frame.to_frame(batch.poses, batch.starts)):
        gaps.append(np.linalg.norm(poses[:, None, :3] - shown[None], axis=2).min(axis=1))
    assert gaps[1].max() < 1e-7
    assert np.median(gaps[0]) > 1e-3


@pytest.mark.parametrize(("actions", "aside"), [("table1", False), ("continuous", True)])
def test_where_the_tool_is_turned_already_what_can_turn_anywhere_begins_turned_aside(actions: str, aside: bool) -> None:
    """Table 1 cannot turn away from the goal; a twist can, and has to learn the way back."""
    config = load_config("task=knife", f"actions={actions}")
    task = config.task
    positions = np.linspace([0.345, -0.080, 0.405], [0.400, -0.020, 0.415], 40)
    shown = [pose.make(positions, task.goal[pose.QUATERNION])]
    agent = config.agent.model_copy(update={"exploring_starts": 1.0, "exploring_in_region": 0.0})
    starts = StartSampler(open_workcell(task, config.robot), STILL, shown, 750, agent)
    rng = np.random.default_rng(0)
    turned = pose.rotation_distance(np.array([starts.draw(rng).pose for _ in range(40)]), task.goal)
    if aside:
        assert 0.03 < np.median(turned) < 0.12
    else:
        np.testing.assert_allclose(turned, 0.0, atol=1e-6)


def test_shares_of_starts_are_as_said(workcell: Workcell, trajectories: list[Array]) -> None:
    batch = begun(sampler(workcell, trajectories, 0.5, 1.0), 300)
    assert 0.4 < batch.exploring.mean() < 0.6
    assert in_region(workcell, batch.poses).all()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_starts_around_the_region_lie_up_to_so_many_times_wider_and_densest_within_it(
    workcell: Workcell, trajectories: list[Array], share: float
) -> None:
    batch = begun(wide(workcell, trajectories, share, 3.0), 300)
    offset = np.abs(batch.poses[:, :3] - workcell.task.nominal_start[:3])
    times = (offset / np.array(workcell.task.start_half_range_m)).max(axis=1)
    assert 2.0 < times.max() <= 3.0
    within = [float(((times >= low) & (times < low + 1.0)).mean()) for low in (0.0, 1.0, 2.0)]
    # Evenly drawn in the widest region, a start would lie in the innermost one once in 27 times.
    assert within[0] > 2 / 27
    density = np.array(within) / (1, 7, 19)
    assert (np.diff(density) < 0).all()
    # Its outermost part is most of the space, and what a person shows least of.
    assert within[2] > 0.3


def test_every_start_is_one_the_arm_can_take_and_no_goal(workcell: Workcell, trajectories: list[Array]) -> None:
    batch = begun(sampler(workcell, trajectories, 0.8, 0.3), 40)
    reached = workcell.arm.forward(batch.joints)
    assert pose.position_distance(reached, batch.poses).max() < 1e-9
    assert all(workcell.scene.contact(row) == "" for row in batch.joints)
    assert not workcell.task.reached(batch.poses).any()


def test_beginning_wipes_what_was(workcell: Workcell, trajectories: list[Array]) -> None:
    batch = Episodes(2, 6)
    batch.steps[:], batch.rewards[:], batch.tried[:], batch.stored[:] = 9, 9.0, True, True
    batch.begin(1, 7, sampler(workcell, trajectories, 0.0).draw(np.random.default_rng(0)))
    assert (batch.steps[1], batch.rewards[1], batch.numbers[1]) == (0, 0.0, 7)
    assert not batch.tried[1].any()
    assert not batch.stored[1].any()
    assert (batch.steps[0], batch.rewards[0]) == (9, 9.0)
    assert batch.stored[0].all()


def test_moving_is_a_step_to_where_nothing_was_tried(workcell: Workcell, trajectories: list[Array]) -> None:
    batch = begun(sampler(workcell, trajectories, 0.0), 2)
    batch.tried[:, 3], batch.stored[:, 4] = True, True
    target, joints = batch.poses[0] + 0.001, batch.joints[0] + 0.01
    batch.move(0, target, joints)
    np.testing.assert_array_equal(batch.poses[0], target)
    np.testing.assert_array_equal(batch.joints[0], joints)
    assert batch.steps.tolist() == [1, 0]
    assert batch.stored.any(axis=1).tolist() == [False, True]
    assert batch.tried.any(axis=1).tolist() == [False, True]


def test_reopening_lets_the_episodes_that_are_there_try_one_action_anew(
    workcell: Workcell, trajectories: list[Array]
) -> None:
    batch = begun(sampler(workcell, trajectories, 0.0), 3)
    batch.tried[:], batch.stored[:] = True, True
    batch.reopen(np.array([True, False, True]), 6)
    for open_ in (~batch.tried, ~batch.stored):
        np.testing.assert_array_equal(np.argwhere(open_), [[0, 6], [2, 6]])


def test_a_restored_batch_is_the_same_and_apart(workcell: Workcell, trajectories: list[Array]) -> None:
    old, new = begun(sampler(workcell, trajectories, 0.5, 0.5), 5), Episodes(5, 6)
    state = old.state()
    new.restore(state)
    for name, values in old.state().items():
        np.testing.assert_array_equal(new.state()[name], values)
    new.move(0, new.poses[1], new.joints[1])
    assert old.steps[0] == state["steps"][0] == 0


def test_the_generator_fixes_the_starts(workcell: Workcell, trajectories: list[Array]) -> None:
    one, two, other = (begun(sampler(workcell, trajectories, 0.8, 0.3), 10, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.poses, two.poses)
    assert not np.array_equal(one.poses, other.poses)
