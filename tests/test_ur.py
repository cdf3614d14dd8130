"""Closed-form kinematics of the UR family, against an independently written Denavit–Hartenberg product."""

import math
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from koopdqn import pose as poses
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm
from koopdqn.robot.ur import URArm
from koopdqn.settings import load_settings

CONF = Path(__file__).parents[1] / "conf" / "robot" / "ur5.yaml"
NODE = cast(dict[Any, Any], OmegaConf.to_container(OmegaConf.load(CONF)))
ARM = load_settings(NODE, URArm, "robot")
HOME = np.array(ARM.home)
TURN = 2.0 * math.pi

# The maker's table for the UR5: d [m], a [m], α [rad].
DH_TABLE = (
    (0.089159, 0.0, math.pi / 2),
    (0.0, -0.425, 0.0),
    (0.0, -0.39225, 0.0),
    (0.10915, 0.0, math.pi / 2),
    (0.09465, 0.0, -math.pi / 2),
    (0.0823, 0.0, 0.0),
)

angles = st.floats(-TURN, TURN, allow_nan=False)
joint_vectors = st.lists(angles, min_size=6, max_size=6).map(np.array)


def dh_product(joints: Array) -> Array:
    """The flange transform (4, 4): ∏ Rz(θ) Tz(d) Tx(a) Rx(α)."""
    result = np.eye(4)
    for theta, (d, a, alpha) in zip(joints, DH_TABLE, strict=True):
        ct, st_, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        result = result @ np.array(
            [
                [ct, -st_ * ca, st_ * sa, a * ct],
                [st_, ct * ca, -ct * sa, a * st_],
                [0.0, sa, ca, d],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    return result


def with_fields(**fields: object) -> URArm:
    return load_settings(NODE | fields, URArm, "robot")


def random_joints(seed: int, number: int = 1000) -> Array:
    return np.random.default_rng(seed).uniform(-TURN, TURN, (number, 6))


def assert_reaches(joints: Array, pose: Array, tolerance: float = 1e-9) -> None:
    transform = dh_product(joints)
    np.testing.assert_allclose(transform[:3, 3], pose[:3], atol=tolerance, rtol=0)
    np.testing.assert_allclose(transform[:3, :3], poses.to_matrix(pose[3:]), atol=2 * tolerance, rtol=0)


def test_the_config_describes_an_arm() -> None:
    assert isinstance(ARM, Arm)
    assert np.asarray(ARM.velocity_limits) == pytest.approx(np.full(6, math.pi), abs=1e-15)
    assert ARM.torque_limits == (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)
    assert ARM.joint_upper == tuple(-limit for limit in ARM.joint_lower) == (TURN,) * 6


def test_flange_at_zero_is_where_the_maker_says() -> None:
    np.testing.assert_allclose(ARM.forward(np.zeros(6))[:3], [-0.81725, -0.19145, -0.0055], atol=1e-5)


def test_home_holds_the_flange_in_front_and_level() -> None:
    half = math.sqrt(0.5)
    np.testing.assert_allclose(ARM.forward(HOME)[:3], [0.45, 0.1, 0.5], atol=1e-12)
    np.testing.assert_allclose(poses.canonical(ARM.forward(HOME)[3:]), [half, 0.0, half, 0.0], atol=1e-12)


def test_forward_agrees_with_the_dh_product() -> None:
    joints = random_joints(1)
    found = ARM.forward(joints)
    for row, pose in zip(joints, found, strict=True):
        assert_reaches(row, pose)


def test_forward_is_vectorised_over_leading_axes() -> None:
    joints = random_joints(2, 12).reshape(3, 4, 6)
    found = ARM.forward(joints)
    assert found.shape == (3, 4, 7)
    for index in np.ndindex(3, 4):
        np.testing.assert_allclose(found[index], ARM.forward(joints[index]), atol=1e-15)


def test_inverse_seeded_at_a_solution_returns_it() -> None:
    joints = random_joints(3)
    for row, pose in zip(joints, ARM.forward(joints), strict=True):
        result = ARM.inverse(pose, row)
        assert result.success
        np.testing.assert_allclose(result.joints, row, atol=1e-9, rtol=0)


def test_inverse_from_any_seed_recovers_the_pose_within_the_limits() -> None:
    for pose, seed in zip(ARM.forward(random_joints(4)), random_joints(5), strict=True):
        result = ARM.inverse(pose, seed)
        assert result.success
        assert result.reason == ""
        assert_reaches(result.joints, pose)
        assert np.all(np.abs(result.joints) <= TURN)


@given(joints=joint_vectors, seed=joint_vectors)
def test_inverse_solves_every_pose_the_arm_can_take(joints: Array, seed: Array) -> None:
    # Hypothesis likes zeros and whole turns: singular wrists, straight elbows, angles on a limit.
    pose = ARM.forward(joints)
    result = ARM.inverse(pose, seed)
    assert result.success
    # Where sin q5 is below 1e-7, q6 is the seed's and up to 1e-7 rad remains.
    assert_reaches(result.joints, pose, 1e-9 if abs(math.sin(joints[4])) > 2e-7 else 2.5e-7)


@given(joints=joint_vectors, scale=st.floats(0.1, 10.0), flipped=st.booleans())
def test_length_and_sign_of_the_quaternion_do_not_matter(joints: Array, scale: float, flipped: bool) -> None:
    pose = ARM.forward(joints)
    other = np.concatenate([pose[:3], pose[3:] * (-scale if flipped else scale)])
    reached = ARM.forward(ARM.inverse(other, HOME).joints)
    np.testing.assert_allclose(reached[:3], pose[:3], atol=1e-7)
    if abs(math.sin(joints[4])) > 1e-3 and abs(math.sin(joints[2])) > 1e-3:
        np.testing.assert_allclose(
            sorted(map(tuple, np.round(ARM.solutions(other), 6))), sorted(map(tuple, np.round(ARM.solutions(pose), 6)))
        )


def test_solutions_are_all_branches_nearest_first_and_inverse_takes_the_nearest() -> None:
    counts = set()
    for pose, seed in zip(ARM.forward(random_joints(6, 300)), random_joints(7, 300), strict=True):
        found = ARM.solutions(pose, seed)
        counts.add(len(found))
        steps = np.abs(found - seed).max(axis=1)
        assert np.all(np.diff(steps) >= 0)
        result = ARM.inverse(pose, seed)
        assert np.abs(result.joints - seed).max() == pytest.approx(steps[0], abs=1e-12)
        # Branches often share their largest step: that of joint 1.
        norms = np.linalg.norm(found[steps == steps[0]] - seed, axis=1)
        assert np.linalg.norm(result.joints - seed) == pytest.approx(norms.min(), abs=1e-12)
        for row in found:
            assert_reaches(row, pose)
        residues = np.round(np.stack([np.cos(found), np.sin(found)], axis=-1), 6)
        assert len(np.unique(residues, axis=0)) == len(found)
    assert max(counts) == 8
    assert counts <= {2, 4, 6, 8}


def assert_same_branch(found: Array, alone: Array, seed: Array) -> None:
    """The same largest step and distance from the seed: branches may tie, and rounding then decides."""
    apart = [np.abs(joints - seed) for joints in (found, alone)]
    assert apart[0].max() == pytest.approx(apart[1].max(), abs=1e-6)
    assert np.linalg.norm(apart[0]) == pytest.approx(np.linalg.norm(apart[1]), abs=1e-6)


@given(rows=st.lists(st.tuples(joint_vectors, joint_vectors, st.booleans()), min_size=1, max_size=6))
def test_a_batch_is_solved_as_each_pose_alone(rows: list[tuple[Array, Array, bool]]) -> None:
    seeds = np.array([seed for _, seed, _ in rows])
    targets = np.array([ARM.forward(joints) + 2.0 * away * np.eye(7)[0] for joints, _, away in rows])
    for found, target, seed in zip(ARM.inverse_batch(targets, seeds), targets, seeds, strict=True):
        alone = ARM.inverse(target, seed)
        assert np.isnan(found).all() == np.isnan(found).any() == (not alone.success)
        if alone.success:
            assert_reaches(found, target, 2.5e-7)
            assert_same_branch(found, alone.joints, seed)


def test_a_batch_away_from_singularities_has_the_joints_of_each_pose_alone() -> None:
    seeds = random_joints(8, 2000)
    targets = ARM.forward(seeds + np.random.default_rng(9).uniform(-0.01, 0.01, seeds.shape))
    alone = [ARM.inverse(*each) for each in zip(targets, seeds, strict=True)]
    for found, result in zip(ARM.inverse_batch(targets, seeds), alone, strict=True):
        np.testing.assert_allclose(found, result.joints, atol=1e-9, rtol=0)


def test_a_batch_keeps_narrow_limits() -> None:
    arm = with_fields(joint_lower=(HOME - 0.5).tolist(), joint_upper=(HOME + 0.5).tolist())
    targets = ARM.forward(HOME + np.random.default_rng(10).uniform(-0.8, 0.8, (300, 6)))
    seeds = np.tile(HOME, (300, 1))
    found, within = arm.inverse_batch(targets, seeds), [arm.inverse(target, HOME).success for target in targets]
    assert 0 < sum(within) < len(within)
    np.testing.assert_array_equal(~np.isnan(found[:, 0]), within)
    assert np.all((np.abs(found - HOME) <= 0.5) | np.isnan(found))


@pytest.mark.parametrize(
    ("targets", "seeds", "message"),
    [
        (np.zeros(7), np.zeros((1, 6)), r"shapes \(N, 7\) and \(N, 6\), found \(7,\), \(1, 6\)"),
        (np.zeros((2, 7)), np.zeros((1, 6)), r"found \(2, 7\), \(1, 6\)"),
        (np.zeros((1, 7)), np.zeros((1, 6)), "longer than 1e-12"),
        (np.full((1, 7), np.nan), np.zeros((1, 6)), "must be finite"),
    ],
)
def test_what_is_no_batch_is_refused(targets: Array, seeds: Array, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ARM.inverse_batch(targets, seeds)


def test_solutions_without_a_seed_lie_nearest_home() -> None:
    pose = ARM.forward(HOME)
    np.testing.assert_allclose(ARM.solutions(pose)[0], HOME, atol=1e-9)
    np.testing.assert_array_equal(ARM.solutions(pose), ARM.solutions(pose, HOME))


def test_whole_turns_follow_the_seed() -> None:
    pose = ARM.forward(HOME)
    turned = HOME - TURN * np.sign(HOME)
    assert np.all(np.abs(turned) <= TURN)
    np.testing.assert_allclose(ARM.inverse(pose, turned).joints, turned, atol=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e-9, 1e-8, 1e-7, 1e-6, 1e-5, 3e-4, 1e-3])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.6, 0.0, -0.8], [0.48, 0.6, 0.64]])
@pytest.mark.parametrize("q6", [-2.0, 0.0, 1.3])
def test_a_path_through_the_wrist_singularity_has_no_jump(offset: float, direction: list[float], q6: float) -> None:
    middle = np.array([0.3, -1.4, 1.5, -0.4, 0.0, q6])
    distance = np.arange(-30, 31)[:, None] * 0.002 + offset
    centre = ARM.forward(middle)
    path = poses.make(centre[:3] + distance * np.array(direction), centre[3:])
    joints = middle + np.array([0.1, -0.1, 0.1, 0.1, 0.1, 0.0])
    walked = []
    for pose in path:
        result = ARM.inverse(pose, joints)
        assert result.success
        assert_reaches(result.joints, pose, 1.1e-7)
        joints = result.joints
        walked.append(joints)
    steps = np.abs(np.diff(walked, axis=0))
    assert np.rad2deg(steps.max()) < 2.0
    signs = np.sign(np.array(walked)[:, 4])
    assert signs[0] == -signs[-1] != 0


@given(noise=st.lists(st.floats(-1e-9, 1e-9), min_size=4, max_size=4), q6=st.floats(-3.0, 3.0))
def test_noise_at_the_wrist_singularity_does_not_turn_the_wrist(noise: list[float], q6: float) -> None:
    seed = np.array([0.3, -1.4, 1.5, -0.4, 0.0, q6])
    pose = ARM.forward(seed)
    pose[3:] += noise
    assert np.abs(ARM.inverse(pose, seed).joints - seed).max() < 1e-6


def test_a_path_out_of_reach_fails_cleanly_where_the_elbow_is_straight() -> None:
    joints = np.array([0.2, -1.2, 0.3, -0.5, 1.2, 0.4])
    pose = ARM.forward(joints)
    outcomes = []
    for _ in range(100):
        result = ARM.inverse(pose, joints)
        outcomes.append(result.success)
        if not result.success:
            assert result.reason.startswith("out of reach: the wrist would be ")
            assert "0.0328…0.8173 m" in result.reason
            np.testing.assert_array_equal(result.joints, joints)
        joints = result.joints
        pose[:3] *= 1.0 + 0.002 / np.linalg.norm(pose[:3])
    assert outcomes[0]
    assert not outcomes[-1]
    assert outcomes == sorted(outcomes, reverse=True)


@pytest.mark.parametrize("excess", [-1e-12, 1e-12, 1e-10])
def test_rounding_at_full_stretch_is_forgiven(excess: float) -> None:
    straight = np.array([0.2, -1.2, 0.0, -0.5, 1.2, 0.4])
    pose = ARM.forward(straight)
    along = np.array([-math.cos(0.2) * math.cos(-1.2), -math.sin(0.2) * math.cos(-1.2), -math.sin(-1.2)])
    pose[:3] += excess * along
    result = ARM.inverse(pose, straight)
    assert result.success
    assert poses.position_distance(ARM.forward(result.joints), pose) < 1e-9
    assert len(ARM.solutions(pose, straight)) >= 1


def test_a_wrist_centre_inside_the_base_cylinder_is_out_of_reach() -> None:
    # The wrist centre lies d6 behind the flange; level at x = d6 it stands on the base axis.
    pose = poses.make([0.0823 + 0.05, 0.0, 0.5], [math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
    result = ARM.inverse(pose, HOME)
    assert not result.success
    expected = "out of reach: the wrist centre would be 0.0500 m from the base axis, at least 0.1091 m (d4) needed"
    assert result.reason == expected
    assert ARM.solutions(pose).shape == (0, 6)


def test_narrow_limits_are_kept_or_named() -> None:
    lower, upper = HOME - 0.5, HOME + 0.5
    arm = with_fields(joint_lower=lower.tolist(), joint_upper=upper.tolist())
    inside = HOME + np.random.default_rng(8).uniform(-0.45, 0.45, (200, 6))
    for joints, pose in zip(inside, arm.forward(inside), strict=True):
        result = arm.inverse(pose, HOME)
        assert result.success
        assert np.all((lower <= result.joints) & (result.joints <= upper))
        assert np.all((lower <= arm.solutions(pose)) & (arm.solutions(pose) <= upper))
        assert_reaches(result.joints, arm.forward(joints))
    result = arm.inverse(arm.forward(HOME + 0.8 * np.eye(6)[0]), HOME)
    assert not result.success
    assert result.reason.startswith("joint limit: shoulder_pan_joint would be at ")
    np.testing.assert_array_equal(result.joints, HOME)


def test_a_seed_beyond_the_limits_is_brought_back() -> None:
    pose = ARM.forward(HOME)
    for turns in (-30.0, -3.0, 2.0, 17.0):
        result = ARM.inverse(pose, HOME + turns * TURN)
        assert result.success
        assert np.all(np.abs(result.joints) <= TURN)
        assert_reaches(result.joints, pose)


def test_the_solution_belongs_to_the_caller_but_is_read_only() -> None:
    result = ARM.inverse(ARM.forward(HOME), HOME)
    with pytest.raises(ValueError, match="read-only"):
        result.joints[0] = 0.0


@pytest.mark.parametrize(
    ("pose", "seed", "message"),
    [
        (np.zeros(6), HOME, r"pose must have shape \(7,\), found \(6,\)"),
        (np.zeros(7), HOME, "quaternion longer than 1e-12"),
        ([math.nan, 0, 0, 1, 0, 0, 0], HOME, "pose must be finite"),
        ([0, 0, 0, 1, 0, 0, 0], np.zeros((1, 6)), r"joints must have shape \(6,\), found \(1, 6\)"),
        ([0, 0, 0, 1, 0, 0, 0], [math.inf, 0, 0, 0, 0, 0], "joints must be finite"),
    ],
)
def test_what_is_no_pose_or_no_seed_is_refused(pose: Array, seed: Array, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ARM.inverse(pose, seed)
    with pytest.raises(ValueError, match=message):
        ARM.solutions(pose, seed)


def test_forward_refuses_other_numbers_of_joints() -> None:
    with pytest.raises(ValueError, match=r"shape \(\.\.\., 6\), found \(2, 5\)"):
        ARM.forward(np.zeros((2, 5)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"a2": 0.0}, "a2: must be below 0 m, as in the maker's table, found 0.0"),
        ({"a3": 0.39}, "a3: must be below 0 m, as in the maker's table, found 0.39"),
        ({"joint_names": ["a"] * 6}, "joint_names: must be 6 different names"),
        (
            {"velocity_limits": [1.0, 1.0, 0.0, 1.0, 1.0, 1.0]},
            "velocity_limits: must be above 0 rad/s for elbow_joint, found 0.0",
        ),
        ({"torque_limits": [1.0, 1.0, -2.0, 1.0, 1.0, 1.0]}, "torque_limits: must be above 0 Nm for .*, found -2"),
        ({"joint_upper": [-7.0] * 6}, "joint_lower: must be below joint_upper for shoulder_pan_joint"),
        ({"home": [7.0] * 6}, "home: must lie within"),
        ({"d7": 1.0}, "d7"),
        ({"d1": float("nan")}, "d1"),
        ({"home": [0.0] * 5}, "home"),
    ],
)
def test_settings_that_make_no_arm_are_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        with_fields(**fields)
