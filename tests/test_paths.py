import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.paths import SmoothPath, arc_lengths, at_arc_lengths, mean_poses, turned_as_shown, way_lengths
from koopdqn.pose import Array


def turning(on_the_spot: float, place: float = 0.5, count: int = 101) -> Array:
    """0.2 m along x, and a turn about it by an angle [rad] at a share of the way."""
    move = np.stack([np.linspace(0.0, 0.2, count), np.zeros(count), np.zeros(count)], axis=1)
    row = round(place * (count - 1))
    stand = np.repeat(move[row : row + 1], 60, axis=0)
    angle = np.concatenate([np.zeros(row), np.linspace(0.0, on_the_spot, 60), np.full(count - row, on_the_spot)])
    turn = pose.from_rotation_vector(angle[:, None] * [1.0, 0.0, 0.0])
    return pose.make(np.concatenate([move[:row], stand, move[row:]]), turn)


@pytest.mark.parametrize("angle", [0.5, 1.0, 2.0])
def test_a_turn_on_the_spot_has_its_place_in_the_mean(angle: float) -> None:
    mean = mean_poses([turning(angle), turning(angle)], 200)
    turned = pose.rotation_distance(mean[1:], mean[:-1])
    assert turned.max() < 0.03
    assert turned.sum() == pytest.approx(angle, rel=1e-6)
    assert way_lengths(turning(angle))[-1] == pytest.approx(0.2 + 0.1 * angle)


def test_without_a_turn_on_the_spot_the_way_is_the_arc_length() -> None:
    poses = turning(0.0)
    poses[:, 3:] = pose.from_rotation_vector(np.linspace(0.0, 2.5, len(poses))[:, None] * [0.0, 0.0, 1.0])
    poses = poses[np.concatenate([[True], np.diff(poses[:, 0]) > 0.0])]
    np.testing.assert_array_equal(way_lengths(poses), arc_lengths(poses[:, :3]))


def turned_by_place(x: Array, y: Array) -> Array:
    """Poses (N, 7) at places x, y [m] that turn about x by a function of x alone, from 0.05 m to 0.15 m."""
    u = np.clip((x - 0.05) / 0.1, 0.0, 1.0)
    angle = 2.8 * u**2 * (3.0 - 2.0 * u)
    turn = pose.from_rotation_vector(angle[:, None] * [1.0, 0.0, 0.0])
    return pose.make(np.stack([x, y, np.zeros_like(x)], axis=1), turn)


@given(st.lists(st.floats(-0.03, 0.03), min_size=2, max_size=6, unique=True), st.randoms(use_true_random=False))
def test_a_path_turns_as_shown_at_its_places_however_far_apart_others_begin(
    begins: list[float], random: random.Random
) -> None:
    """By shares of the way, paths begun 60 mm apart are averaged over as much."""
    shown = [turned_by_place(np.linspace(x, 0.3, 180), np.full(180, random.uniform(-0.01, 0.01))) for x in begins]
    turned = turned_as_shown(mean_poses(shown), shown)
    wanted = turned_by_place(turned[:, 0], turned[:, 1])
    assert pose.rotation_distance(turned, wanted).max() < 0.03


def test_what_begins_farther_on_turns_evenly_from_the_paths_first_pose() -> None:
    path, late = (turned_by_place(np.linspace(x, 0.3, 180), np.zeros(180)) for x in (0.0, 0.12))
    turned = turned_as_shown(path, [late, late])
    angle = pose.rotation_distance(turned, path[0])
    share = np.clip(path[:, 0] / 0.12, 0.0, 1.0)
    np.testing.assert_allclose(
        angle[share < 1], (share * pose.rotation_distance(late[0], path[0]))[share < 1], atol=0.15
    )
    # How much of its way is left counts a little too.
    assert pose.rotation_distance(turned, path)[share == 1].max() < 0.1
    np.testing.assert_array_equal(turned[0], path[0])


def test_passages_of_one_place_keep_their_own_turns() -> None:
    """There and back along one line, turned only on the way back."""
    there = turned_by_place(np.linspace(0.0, 0.04, 100), np.zeros(100))
    back = there[::-1].copy()
    # Less than a radian a millimetre, which would be a turn on the spot.
    back[:, 3:] = pose.from_rotation_vector(np.array([0.3, 0.0, 0.0]))
    path = np.concatenate([there, back[1:]])
    turned = turned_as_shown(path, [path, path])
    # A place counts as near another where the ways there differ by less than ten times their distance.
    away = np.abs(np.arange(len(path)) - 99) > 5
    assert pose.rotation_distance(turned, path)[away].max() < 1e-6


@given(st.lists(st.floats(0.0, 2.0), min_size=2, max_size=5))
def test_a_path_turned_as_shown_ends_as_the_others_do(angles: list[float]) -> None:
    shown = [turning(angle, place=0.95) for angle in angles]
    ends = np.array([rows[-1] for rows in shown])
    mean = turned_as_shown(mean_poses(shown), shown)[-1:]
    wanted = pose.make(ends[:, :3].mean(axis=0), ends[:, 3:].mean(axis=0))
    assert pose.rotation_distance(mean, wanted)[0] < 1e-6


numbers = st.floats(-0.4, 0.4, allow_nan=False)
points = st.tuples(numbers, numbers, numbers)


def apart(waypoints: list[tuple[float, float, float]]) -> bool:
    return bool(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).min() > 0.05)


waypoint_lists = st.lists(points, min_size=3, max_size=6).filter(apart)


def straight(length: float = 0.3) -> SmoothPath:
    return SmoothPath.along([[0.1, 0.0, 0.0], [0.1 + length, 0.0, 0.0]])


@given(waypoint_lists)
def test_a_path_passes_its_waypoints_from_first_to_last(waypoints: list[tuple[float, float, float]]) -> None:
    path = SmoothPath.through(waypoints)
    np.testing.assert_allclose(path.points[[0, -1]], [waypoints[0], waypoints[-1]], atol=1e-12)
    for waypoint in waypoints:
        assert np.linalg.norm(path.points - waypoint, axis=1).min() < path.spacing


@settings(max_examples=25)
@given(waypoint_lists, st.floats(5e-4, 5e-3))
def test_points_are_evenly_spaced_along_the_curve(waypoints: list[tuple[float, float, float]], spacing: float) -> None:
    path = SmoothPath.through(waypoints, spacing)
    gaps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    # A chord is never longer than its arc, and hardly shorter where the curve is smooth at this scale.
    assert gaps.max() <= path.spacing * (1 + 1e-9)
    assert np.median(gaps) == pytest.approx(path.spacing, rel=1e-2)
    assert path.spacing <= spacing
    # The finely sampled spline cuts a turning point by less than its sampling.
    assert path.length >= np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum() - 1e-5


@settings(max_examples=25)
@given(waypoint_lists, st.floats(0, 1))
def test_the_point_nearest_to_a_point_of_the_path_is_itself(
    waypoints: list[tuple[float, float, float]], share: float
) -> None:
    path = SmoothPath.through(waypoints)
    on_path = path.at([share * path.length])
    np.testing.assert_allclose(path.at(path.nearest(on_path)), on_path, atol=1e-6)


@settings(max_examples=25)
@given(waypoint_lists, st.lists(points, min_size=1, max_size=5))
def test_no_point_of_the_path_is_nearer_than_the_nearest(
    waypoints: list[tuple[float, float, float]], positions: list[tuple[float, float, float]]
) -> None:
    path = SmoothPath.through(waypoints, 2e-3)
    found = np.linalg.norm(path.at(path.nearest(positions)) - positions, axis=1)
    best = np.linalg.norm(np.array(positions)[:, None] - path.points, axis=2).min(axis=1)
    np.testing.assert_allclose(found, best, atol=1e-7)


def test_positions_beyond_the_ends_are_the_ends() -> None:
    path = straight()
    np.testing.assert_array_equal(path.at([-1.0, 5.0]), path.points[[0, -1]])
    np.testing.assert_allclose(path.nearest([[-9.0, 0, 0], [9.0, 0, 0]]), [0.0, path.length], atol=1e-12)


def test_arc_length_is_measured_along_the_path() -> None:
    path = straight()
    assert path.length == pytest.approx(0.3)
    np.testing.assert_allclose(path.at([0.12]), [[0.22, 0, 0]], atol=path.spacing / 2)
    np.testing.assert_allclose(path.nearest([[0.22, 0.05, -0.02]]), [0.12], atol=path.spacing / 2)


def test_arc_lengths_of_a_known_polyline() -> None:
    corners: Array = np.array([[0.0, 0, 0], [0.3, 0.4, 0], [0.3, 0.4, 0], [0.3, 0.4, 2.0]])
    np.testing.assert_allclose(arc_lengths(corners), [0, 0.5, 0.5, 2.5])


@given(st.lists(st.floats(0.01, 1), min_size=2, max_size=8), st.lists(st.floats(0, 1), min_size=1, max_size=5))
def test_interpolation_along_the_arc_is_linear(gaps: list[float], shares: list[float]) -> None:
    arc = np.concatenate([[0.0], np.cumsum(gaps)])
    values = np.stack([2 * arc + 1, -arc], axis=1)
    wanted = np.array(shares) * arc[-1]
    np.testing.assert_allclose(
        at_arc_lengths(values, arc, wanted), np.stack([2 * wanted + 1, -wanted], axis=1), atol=1e-9
    )
