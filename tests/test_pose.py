import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from koopdqn import pose
from koopdqn.pose import Array

coordinates = st.floats(-2.0, 2.0, allow_nan=False)
vectors = st.lists(coordinates, min_size=3, max_size=3).map(np.array)
quaternions = (
    st.lists(st.floats(-1.0, 1.0, allow_nan=False), min_size=4, max_size=4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(pose.normalized)
)
poses = st.builds(pose.make, vectors, quaternions)
angles = st.floats(-math.pi, math.pi, allow_nan=False)


def peer(quaternion: Array) -> Rotation:
    """The same rotation as scipy knows it."""
    return Rotation.from_quat(quaternion, scalar_first=True)


def same_rotation(a: Array, b: Array, tolerance: float = 1e-12) -> bool:
    return bool(min(np.abs(a - b).max(), np.abs(a + b).max()) < tolerance)


def test_a_rotation_is_the_same_to_the_last_bit_alone_and_among_many() -> None:
    """Runs with the same seed must not depend on how many poses are computed together."""
    rng = np.random.default_rng(0)
    a, b = (pose.make(rng.normal(size=(500, 3)), rng.normal(size=(500, 4))) for _ in range(2))
    together = (
        pose.compose(a, b),
        pose.rotation_distance(a, b),
        pose.turned_toward(a[:, 3:], b[:, 3:], np.full(500, 0.1)),
    )
    for row in range(0, 500, 7):
        alone = (
            pose.compose(a[row], b[row]),
            pose.rotation_distance(a[row], b[row]),
            pose.turned_toward(a[row, 3:], b[row, 3:], 0.1),
        )
        for one, many in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one, many[row])


@pytest.mark.parametrize("shape", [(), (5,), (64, 10)])
def test_lengths_and_cross_products_are_numpys_own(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(*shape, 3)), rng.normal(size=(*shape, 3))
    np.testing.assert_array_equal(pose.norm(a), np.linalg.norm(a, axis=-1))
    np.testing.assert_array_equal(pose.norm(a, keepdims=True), np.linalg.norm(a, axis=-1, keepdims=True))
    np.testing.assert_array_equal(pose.cross(a, b), np.cross(a, b))


@given(quaternions, quaternions, quaternions)
def test_rotations_form_a_group(a: Array, b: Array, c: Array) -> None:
    one = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(pose.multiply(pose.multiply(a, b), c), pose.multiply(a, pose.multiply(b, c)), atol=1e-14)
    np.testing.assert_array_equal(pose.multiply(a, one), a)
    np.testing.assert_array_equal(pose.multiply(one, a), a)
    np.testing.assert_allclose(pose.multiply(a, pose.conjugate(a)), one, atol=1e-15)
    assert np.linalg.norm(pose.multiply(a, b)) == pytest.approx(1.0, abs=1e-14)


@given(quaternions, quaternions, vectors)
def test_products_and_turned_vectors_agree_with_scipy(a: Array, b: Array, v: Array) -> None:
    assert same_rotation(pose.multiply(a, b), (peer(a) * peer(b)).as_quat(scalar_first=True))
    np.testing.assert_allclose(pose.rotate(a, v), peer(a).apply(v), atol=1e-13)
    np.testing.assert_allclose(pose.rotate(pose.multiply(a, b), v), pose.rotate(a, pose.rotate(b, v)), atol=1e-13)


@given(poses, poses, poses)
def test_poses_form_a_group(a: Array, b: Array, c: Array) -> None:
    left, right = pose.compose(pose.compose(a, b), c), pose.compose(a, pose.compose(b, c))
    np.testing.assert_allclose(left, right, atol=1e-13)
    for product in (pose.compose(a, pose.inverse(a)), pose.compose(pose.inverse(a), a)):
        np.testing.assert_allclose(product[:3], 0.0, atol=1e-13)
        assert same_rotation(product[3:], np.array(pose.IDENTITY)[3:])


@given(quaternions)
def test_matrices_agree_with_scipy_and_come_back(q: Array) -> None:
    matrix = pose.to_matrix(q)
    np.testing.assert_allclose(matrix, peer(q).as_matrix(), atol=1e-14)
    assert same_rotation(pose.from_matrix(matrix), q)
    assert pose.from_matrix(matrix)[0] >= 0


@given(vectors)
def test_rotation_vectors_agree_with_scipy(v: Array) -> None:
    assert same_rotation(pose.from_rotation_vector(v), Rotation.from_rotvec(v).as_quat(scalar_first=True))


@given(quaternions)
def test_rotation_vectors_come_back_and_are_at_most_half_a_turn_long(q: Array) -> None:
    vector = pose.to_rotation_vector(q)
    assert np.linalg.norm(vector) <= math.pi + 1e-15
    assert same_rotation(pose.from_rotation_vector(vector), q)


@given(vectors.filter(lambda v: 0.1 < np.linalg.norm(v) < 3.1), st.floats(-300, 0))
def test_rotation_vectors_keep_full_precision_however_small(v: Array, exponent: float) -> None:
    small = v * 10.0**exponent
    found = pose.to_rotation_vector(pose.from_rotation_vector(small))
    np.testing.assert_allclose(found, small, rtol=1e-13, atol=1e-300)


@given(angles, st.floats(-math.pi / 2 + 1e-3, math.pi / 2 - 1e-3), angles)
def test_roll_pitch_yaw_agree_with_scipy_and_come_back(roll: float, pitch: float, yaw: float) -> None:
    q = pose.from_roll_pitch_yaw([roll, pitch, yaw])
    assert same_rotation(q, Rotation.from_euler("xyz", [roll, pitch, yaw]).as_quat(scalar_first=True))
    turns = (pose.to_roll_pitch_yaw(q) - [roll, pitch, yaw]) / (2 * math.pi)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)


@given(angles, st.sampled_from([-math.pi / 2, math.pi / 2]), angles)
def test_roll_pitch_yaw_at_the_singularity_still_give_the_rotation(roll: float, pitch: float, yaw: float) -> None:
    q = pose.from_roll_pitch_yaw([roll, pitch, yaw])
    found = pose.to_roll_pitch_yaw(q)
    assert found[2] == 0.0
    assert same_rotation(pose.from_roll_pitch_yaw(found), q, 1e-7)


@given(poses, poses, poses)
def test_the_distances_obey_the_metric_axioms(a: Array, b: Array, c: Array) -> None:
    for distance in (pose.position_distance, pose.rotation_distance):
        assert distance(a, a) < 1e-15
        assert distance(a, b) == pytest.approx(distance(b, a), abs=1e-15)
        assert distance(a, b) >= 0
        assert distance(a, c) <= distance(a, b) + distance(b, c) + 1e-14


@given(poses, poses)
def test_the_rotation_distance_is_the_angle_between_and_blind_to_sign(a: Array, b: Array) -> None:
    angle = (peer(a[3:]) * peer(b[3:]).inv()).magnitude()
    assert pose.rotation_distance(a, b) == pytest.approx(angle, abs=1e-12)
    flipped = pose.make(b[:3], -b[3:])
    assert pose.rotation_distance(a, flipped) == pytest.approx(pose.rotation_distance(a, b), abs=1e-14)
    assert 0 <= pose.rotation_distance(a, b) <= math.pi


@given(quaternions, st.floats(-12, -1), vectors.filter(lambda v: np.linalg.norm(v) > 0.1))
def test_the_rotation_distance_keeps_small_angles(q: Array, exponent: float, axis: Array) -> None:
    angle = 10.0**exponent
    turned = pose.multiply(pose.from_rotation_vector(angle * axis / np.linalg.norm(axis)), q)
    found = pose.rotation_distance(pose.make(np.zeros(3), q), pose.make(np.zeros(3), turned))
    # Rounding of the product's entries is about 1e-16; arccos would lose everything under 1e-8.
    assert found == pytest.approx(angle, abs=1e-15)


@given(quaternions, quaternions, st.floats(0, 0.5))
def test_a_negative_turn_leads_away_from_the_goal(q: Array, goal: Array, angle: float) -> None:
    here, there = (pose.make(np.zeros(3), each) for each in (q, goal))
    total = float(pose.rotation_distance(here, there))
    assume(1e-3 < total < 2.5)
    turned = pose.make(np.zeros(3), pose.turned_toward(q, goal, -angle))
    assert pose.rotation_distance(turned, there) == pytest.approx(total + angle, abs=1e-9)


@given(quaternions, quaternions, st.floats(0, 4))
def test_turning_goes_along_the_geodesic_and_never_past_the_goal(q: Array, goal: Array, angle: float) -> None:
    there = pose.make(np.zeros(3), goal)
    total = float(pose.rotation_distance(pose.make(np.zeros(3), q), there))
    reached = pose.turned_toward(q, goal, angle)
    turned = pose.make(np.zeros(3), reached)
    assert pose.rotation_distance(turned, there) == pytest.approx(max(total - angle, 0.0), abs=1e-12)
    made = float(pose.rotation_distance(turned, pose.make(np.zeros(3), q)))
    assert made == pytest.approx(min(total, angle), abs=1e-12)
    # Of two equal quaternions the turn between them is zero to rounding only.
    if angle > total + 1e-12:
        np.testing.assert_array_equal(reached, goal)


@given(vectors, vectors, st.floats(0, 8))
def test_moving_goes_straight_and_never_past_the_goal(p: Array, goal: Array, distance: float) -> None:
    total = float(np.linalg.norm(goal - p))
    moved = pose.moved_toward(p, goal, distance)
    assert np.linalg.norm(goal - moved) == pytest.approx(max(total - distance, 0.0), abs=1e-12)
    assert np.linalg.norm(moved - p) == pytest.approx(min(total, distance), abs=1e-12)
    if distance >= total:
        np.testing.assert_array_equal(moved, goal)


def test_stepping_past_any_distance_ends_at_the_goal_for_a_whole_batch() -> None:
    rng = np.random.default_rng(0)
    here = pose.make(rng.normal(size=(5, 3)), rng.normal(size=(5, 4)))
    goal = pose.make(rng.normal(size=3), rng.normal(size=4))
    forever = np.full(5, np.inf)
    assert np.all(pose.moved_toward(here[:, :3], goal[:3], forever) == goal[:3])
    assert np.all(pose.turned_toward(here[:, 3:], goal[3:], forever) == goal[3:])


@given(st.integers(1, 3), st.integers(1, 3))
def test_every_function_is_vectorised_over_leading_axes(rows: int, columns: int) -> None:
    rng = np.random.default_rng([rows, columns])
    a = pose.make(rng.normal(size=(rows, columns, 3)), rng.normal(size=(rows, columns, 4)))
    b = pose.make(rng.normal(size=(rows, columns, 3)), rng.normal(size=(rows, columns, 4)))
    whole = (
        pose.compose(a, b),
        pose.inverse(a),
        pose.to_matrix(a[..., 3:]),
        pose.from_matrix(pose.to_matrix(a[..., 3:])),
        pose.to_roll_pitch_yaw(a[..., 3:]),
        pose.from_roll_pitch_yaw(a[..., :3]),
        pose.rotation_distance(a, b),
    )
    for i, j in np.ndindex(rows, columns):
        x, y = a[i, j], b[i, j]
        single = (
            pose.compose(x, y),
            pose.inverse(x),
            pose.to_matrix(x[3:]),
            pose.from_matrix(pose.to_matrix(x[3:])),
            pose.to_roll_pitch_yaw(x[3:]),
            pose.from_roll_pitch_yaw(x[:3]),
            pose.rotation_distance(x, y),
        )
        for many, one in zip(whole, single, strict=True):
            np.testing.assert_allclose(many[i, j], one, atol=1e-14)


@pytest.mark.parametrize("quaternion", [[0.0, 0, 0, 0], [math.nan, 0, 0, 1], [math.inf, 0, 0, 0]])
def test_what_is_no_rotation_is_refused(quaternion: list[float]) -> None:
    with pytest.raises(ValueError, match="finite and longer"):
        pose.make([0.0, 0, 0], quaternion)


@given(quaternions)
def test_the_canonical_sign_is_one_of_the_two(q: Array) -> None:
    chosen = pose.canonical(q)
    assert chosen[0] >= 0
    np.testing.assert_array_equal(pose.canonical(-q) if q[0] != 0 else pose.canonical(q), chosen)
    assert same_rotation(chosen, q, 1e-15)
