from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_runs import knife_parts

from koopdqn import pose
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import straight_path
from koopdqn.evaluation.metrics import reference_paths
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.settings import TARGET, validate
from koopdqn.tasks.actions import COUNT, nearest_actions
from koopdqn.tasks.knife import KnifeTask
from koopdqn.tasks.rollout import SUCCESS, Episode, follow, roll_out
from koopdqn.tasks.task import demonstrator_next_poses
from koopdqn.tasks.workcell import Workcell, open_workcell

LIMIT = 2000


NODE = {key: value for key, value in described(knife_parts().task).items() if key != TARGET}


def knife(**fields: object) -> KnifeTask:
    """Return the knife task with some fields changed and checked anew."""
    return validate(NODE | fields, KnifeTask, "task")


TASK = knife()
TURNED = knife(turn_from=0.2, turn_until=0.6)
DOWN = TASK.goal[pose.QUATERNION]


def limb(start: list[float], end: list[float], radius: float) -> list[dict[str, object]]:
    return [{"name": "limb", "start": start, "end": end, "radius_m": radius, "skin": True}]


def about_the_blade(angle: float) -> Array:
    """Return the quaternion (4,) of the goal's orientation turned by an angle [rad] about the blade."""
    return np.asarray(pose.multiply(DOWN, pose.from_rotation_vector([0.0, 0.0, angle])))


@pytest.fixture(scope="module")
def cell() -> Workcell:
    return open_workcell(TASK, knife_parts().arm)


def milder() -> KnifeTask:
    """The task under a rule a fifth milder in distance and in angle."""
    return knife(rule_distance_m=0.8 * TASK.rule_distance_m, safe_angle_rad=1.2 * TASK.safe_angle_rad)


def test_the_edge_points_straight_down_at_the_goal_and_nearly_up_at_the_start() -> None:
    angles = TASK.blade_angle(np.array([TASK.goal, TASK.nominal_start]))
    np.testing.assert_allclose(np.degrees(angles), [0.0, 160.0], atol=1e-3)
    # Where flange and base are turned alike, the edge points along +x of the base.
    np.testing.assert_allclose(TASK.blade_angle(np.array([pose.IDENTITY])), np.pi / 2)


@given(angle=st.floats(-np.pi, np.pi))
def test_the_blade_angle_is_the_turn_about_the_blade(angle: float) -> None:
    turned = pose.make([0.4, 0.0, 0.4], about_the_blade(angle))
    assert TASK.blade_angle(turned[None])[0] == pytest.approx(abs(angle), abs=1e-6)


@pytest.mark.parametrize(
    ("start", "end", "radius", "wanted"),
    [
        # The blade lies along +x from 110 to 270 mm before the flange, 16 mm to either side of its middle line, in z.
        ([0.47, 0.0, -0.5], [0.47, 0.0, 0.5], 0.05, 0.15),  # an upright pole 200 mm beyond its end
        ([0.19, -0.5, -0.116], [0.19, 0.5, -0.116], 0.02, 0.08),  # a rail across, 100 mm below the edge
        ([0.0, 0.07, 0.016], [0.5, 0.07, 0.016], 0.03, 0.04),  # a rail beside it, at the height of the spine
        ([0.37, 0.0, 0.116], [0.37, 0.0, 0.9], 0.01, np.hypot(0.1, 0.1) - 0.01),  # a pole that ends above its end
        ([0.01, 0.0, -0.5], [0.01, 0.0, 0.5], 0.02, 0.08),  # behind where the blade begins; the grip does not count
    ],
)
def test_the_blade_distance_is_that_worked_out_by_hand(
    start: list[float], end: list[float], radius: float, wanted: float
) -> None:
    task = knife(receiver=limb(start, end, radius))
    here = pose.make(np.zeros(3), DOWN)
    moved = pose.make([-0.3, 0.0, 0.0], DOWN)
    assert task.blade_distance(here[None])[0] == pytest.approx(wanted, abs=1e-9)
    if radius == 0.05:
        assert task.blade_distance(moved[None])[0] == pytest.approx(wanted + 0.3, abs=1e-9)


def test_the_nearest_limb_counts() -> None:
    far, near = limb([0.87, 0, -1], [0.87, 0, 1], 0.05), limb([0.47, 0, -1], [0.47, 0, 1], 0.05)
    here = pose.make(np.zeros(3), DOWN)[None]
    distances = [knife(receiver=limbs).blade_distance(here)[0] for limbs in (far, near, far + near)]
    np.testing.assert_allclose(distances, [0.55, 0.15, 0.15], atol=1e-9)


@pytest.mark.parametrize(
    ("away", "angle", "broken"),
    [(0.16, 0.0, False), (0.16, 9.9, False), (0.16, 10.1, True), (0.16, -170.0, True), (0.18, 180.0, False)],
)
def test_the_rule_is_broken_by_a_blade_both_near_and_turned_away_from_down(
    away: float, angle: float, broken: bool
) -> None:
    """At 170 mm the rule begins; the pole stands ``away`` from the end of the blade."""
    assert TASK.rule_distance_m == 0.17
    task = knife(receiver=limb([0.27 + away + 0.03, 0, -1], [0.27 + away + 0.03, 0, 1], 0.03))
    here = pose.make(np.zeros(3), about_the_blade(np.radians(angle)))
    assert task.rule_broken(here[None])[0] == broken


def test_the_fraction_until_safe_counts_the_last_unsafe_pose() -> None:
    angles = np.radians([90.0, 5.0, 30.0, 9.0, 0.0])
    path = np.array([pose.make([0.01 * i, 0.0, 0.4], about_the_blade(angle)) for i, angle in enumerate(angles)])
    assert TASK.measures(path, 0.02)["fraction_until_safe"] == 0.75
    assert TASK.measures(path[3:], 0.02)["fraction_until_safe"] == 0.0
    assert TASK.measures(path[:3], 0.02)["fraction_until_safe"] == 1.0
    # A share of the way: turning on the spot takes steps and comes no nearer.
    standing = path.copy()
    standing[:4, :3] = path[1, :3]
    assert TASK.measures(standing, 0.02)["fraction_until_safe"] == 0.0
    # What never becomes safe is unsafe all the way, however short that is.
    assert TASK.measures(standing[:3], 0.02)["fraction_until_safe"] == 1.0


@given(share=st.lists(st.floats(0, 1), min_size=2, max_size=10).map(sorted))
def test_the_turn_is_made_between_its_two_shares_of_the_path(share: list[float]) -> None:
    task = TURNED
    assert np.all(np.diff(task.turned(np.array(share))) >= 0)
    np.testing.assert_allclose(task.turned(np.array([0.0, 0.2, 0.4, 0.6, 1.0])), [0, 0, 0.5, 1, 1], atol=1e-12)


def test_a_turn_that_ends_before_it_begins_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"turn_until must be over turn_from \(0.6\), found 0.2"):
        knife(turn_from=0.6, turn_until=0.2)


def drawn(cell: Workcell, count: int, seed: int = 40) -> tuple[Array, Array]:
    starts, joints, refused = cell.reachability.draw_starts(cell.task, np.random.default_rng(seed), count)
    assert refused <= 0.1 * count
    return starts, joints


def turned_along(path: Array, share_made: Callable[[Array], Array]) -> Array:
    """Return the positions of a path (T, 7) with its whole turn spread over shares of its length."""
    arc = arc_lengths(path[:, pose.POSITION])
    angle = pose.rotation_distance(path[0], TASK.goal) * share_made(arc / arc[-1])
    begun = np.tile(path[0, pose.QUATERNION], (len(path), 1))
    return pose.make(path[:, pose.POSITION], pose.turned_toward(begun, TASK.goal[pose.QUATERNION], angle))


def successes(episodes: list[Episode]) -> int:
    return sum(episode.outcome == SUCCESS for episode in episodes)


def test_path_and_start_region_are_as_large_as_they_must_be() -> None:
    assert TASK.nominal_path.length >= 0.4
    assert min(TASK.start_half_range_m) >= 0.04


def test_the_person_turns_the_edge_down_before_the_blade_comes_near(cell: Workcell) -> None:
    starts, joints = drawn(cell, 12)
    paths = reference_paths(TASK, starts, LIMIT)
    assert successes(follow(paths, TASK, cell.reachability, joints)) == len(paths)
    for path in paths:
        assert 0.3 < TASK.measures(path, 0.02)["fraction_until_safe"] < 0.55
        unsafe = TASK.blade_angle(path) > TASK.safe_angle_rad
        assert TASK.blade_distance(path[unsafe]).min() > TASK.rule_distance_m + 0.02
        # The rule matters for much of the way.
        assert (TASK.blade_distance(path) < 0.8 * TASK.rule_distance_m).mean() > 0.15


def check_what_learns_nothing_fails(cell: Workcell, count: int) -> None:
    """Check that it fails under a milder rule too, and not by a little."""
    task = milder()
    starts, joints = drawn(cell, count)
    most = 0.05 * count
    lines = [straight_path(start, task.goal, task) for start in starts]
    assert successes(follow(lines, task, cell.reachability, joints)) <= most
    for action in range(COUNT):
        always = partial(lambda chosen, poses, begun: np.full(len(poses), chosen), action)
        assert successes(roll_out(always, task, cell.reachability, starts, joints, LIMIT)) <= most
    for share_made in (lambda share: share, lambda share: np.clip(3.0 * share - 2.0, 0.0, 1.0)):
        paths = [turned_along(path, share_made) for path in reference_paths(task, starts, LIMIT)]
        assert successes(follow(paths, task, cell.reachability, joints)) <= most
        for path in paths:
            unsafe = task.blade_angle(path) > task.safe_angle_rad
            assert task.blade_distance(path[unsafe]).min() < task.rule_distance_m - 0.04
            assert task.rule_broken(path).mean() > 0.15


def test_the_straight_line_constant_actions_and_turning_evenly_or_late_fail(cell: Workcell) -> None:
    check_what_learns_nothing_fails(cell, 6)


@pytest.mark.slow
def test_they_fail_from_a_hundred_starts(cell: Workcell) -> None:
    check_what_learns_nothing_fails(cell, 100)


def test_the_actions_nearest_to_the_person_succeed(cell: Workcell) -> None:
    task, (starts, joints) = cell.task, drawn(cell, 6)

    def nearest(poses: Array, begun: Array) -> np.ndarray:
        return nearest_actions(poses, demonstrator_next_poses(task, poses, begun), task)

    assert successes(roll_out(nearest, task, cell.reachability, starts, joints, LIMIT)) == 6
