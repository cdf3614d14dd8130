"""The other arms of the UR family: closed form, models made from the UR5's, and an independent implementation."""

import importlib
from functools import cache
from itertools import pairwise

import arms
import mujoco
import numpy as np
import pytest

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.robot.scene import SceneBuilder
from koopdqn.robot.ur import URArm

FAMILY = ["ur5", *arms.SHAPES]


@cache
def arm_of(name: str) -> URArm:
    arm = load_config(f"robot={name}").robot
    assert isinstance(arm, URArm)
    return arm


def joints_of(count: int) -> np.ndarray:
    return np.random.default_rng(7).uniform(-np.pi, np.pi, (count, 6))


@pytest.mark.parametrize("name", FAMILY)
def test_forward_and_inverse_agree_with_an_independent_implementation(name: str) -> None:
    other = getattr(importlib.import_module(pytest.importorskip("ur_analytic_ik").__name__), name)
    arm = arm_of(name)
    for joints in joints_of(40):
        matrix = other.forward_kinematics(*joints)
        expected = pose.make(matrix[:3, 3], pose.from_matrix(matrix[:3, :3]))
        found = arm.forward(joints)
        assert pose.position_distance(found, expected) < 1e-9
        assert pose.rotation_distance(found, expected) < 1e-9
        theirs = np.array(other.inverse_kinematics(matrix)).reshape(-1, 6)
        ours = arm.solutions(expected)
        for solution in theirs:
            apart = np.abs(np.angle(np.exp(1j * (ours - solution)))).max(axis=1)
            assert apart.min() < 1e-6, (joints, solution)


@pytest.mark.parametrize("name", FAMILY)
def test_inverse_takes_back_what_forward_gives(name: str) -> None:
    arm, joints = arm_of(name), joints_of(300)
    np.testing.assert_allclose(arm.inverse_batch(arm.forward(joints), joints), joints, atol=1e-6)


@pytest.mark.parametrize("name", FAMILY)
def test_the_models_flange_is_the_closed_forms_and_home_is_free(name: str) -> None:
    arm = arm_of(name)
    scene = SceneBuilder(arm).build()
    joints = joints_of(200)
    found, expected = np.array([scene.flange_pose(row) for row in joints]), arm.forward(joints)
    assert pose.position_distance(found, expected).max() < 1e-9
    assert pose.rotation_distance(found, expected).max() < 1e-9
    assert scene.contact(np.array(arm.home)) == ""


@pytest.mark.parametrize("name", arms.SHAPES)
def test_a_model_is_what_the_script_makes_with_the_arms_own_torques_and_masses(name: str) -> None:
    arm = arm_of(name)
    path = arms.ASSETS / arm.asset
    assert path.read_text(encoding="utf-8") == arms.model_of(name)
    model = mujoco.MjModel.from_xml_path(str(path))
    np.testing.assert_allclose(model.actuator_forcerange[:, 1], arm.torque_limits)
    np.testing.assert_allclose(model.actuator_biasprm[:, 2] / model.actuator_biasprm[:, 1], 0.02)
    np.testing.assert_allclose(model.body_mass[2:], arms.SHAPES[name].masses)


@pytest.mark.parametrize("name", arms.SHAPES)
def test_neighbouring_links_meet(name: str) -> None:
    arm = arm_of(name)
    scene = SceneBuilder(arm).build()
    scene.place(np.array(arm.home))
    model, segment = scene.model, np.zeros(6)
    bodies = ["base", "shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link"]
    shapes = [geom for geom in range(model.ngeom) if model.geom_contype[geom]]
    owner = {geom: model.body(model.geom_bodyid[geom]).name.rsplit("/", 1)[-1] for geom in shapes}
    geoms = {body: [geom for geom in shapes if owner[geom] == body] for body in bodies}
    for inner, outer in pairwise(bodies):
        gap = min(
            mujoco.mj_geomDistance(model, scene.data, a, b, 1.0, segment) for a in geoms[inner] for b in geoms[outer]
        )
        assert gap < 0.002, (inner, outer)
