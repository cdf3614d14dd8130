"""The UR5's MJCF model: the published numbers, its frames, its shapes and its actuators."""

from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from dm_control import mjcf
from omegaconf import OmegaConf

from koopdqn import pose as poses
from koopdqn.pose import Array
from koopdqn.robot.ur import URArm
from koopdqn.settings import load_settings

ROOT = Path(__file__).parents[1]
NODE = OmegaConf.to_container(OmegaConf.load(ROOT / "conf" / "robot" / "ur5.yaml"))
ARM = load_settings(cast(dict[Any, Any], NODE), URArm, "robot")
ROBOT = ROOT / "assets" / ARM.asset
SCENE = ROBOT.with_name("scene.xml")
HOME = np.array(ARM.home)

Point = tuple[float, float, float]

# Mass [kg], centre of mass in the link frame [m], principal inertia [kg m²], from the maker's tables.
INERTIALS = {
    "shoulder_link": (3.7, (0, -0.00193, -0.02561), (0.014972, 0.014972, 0.010406)),
    "upper_arm_link": (8.393, (-0.2125, 0, 0.11336), (0.015107, 0.133886, 0.133886)),
    "forearm_link": (2.33, (-0.24225, 0, 0.0265), (0.004095, 0.031217, 0.031217)),
    "wrist_1_link": (1.219, (0, -0.01634, -0.0018), (0.002014, 0.002014, 0.002194)),
    "wrist_2_link": (1.219, (0, 0.01634, -0.0018), (0.001831, 0.001831, 0.002194)),
    "wrist_3_link": (0.1879, (0, 0, -0.001159), (8.06e-5, 8.06e-5, 1.321e-4)),
}
# Ends of the axis in the link frame and radius [m] of the cylinders that cover the real links.
CYLINDERS: dict[str, list[tuple[Point, Point, float]]] = {
    "base": [((0, 0, 0), (0, 0, 0.024), 0.0735)],
    "shoulder_link": [((0, 0, -0.065), (0, 0, 0.0685), 0.0595), ((0, -0.0705, 0), (0, 0.0597, 0), 0.0595)],
    "upper_arm_link": [
        ((0, 0, 0.0707), (0, 0, 0.2044), 0.0597),
        ((-0.425, 0, 0.0707), (-0.425, 0, 0.2044), 0.0597),
        ((0, 0, 0.1359), (-0.425, 0, 0.1359), 0.0503),
    ],
    "forearm_link": [
        ((0, 0, -0.013), (0, 0, 0.071), 0.0585),
        ((-0.392, 0, -0.041), (-0.392, 0, 0.064), 0.039),
        ((0, 0, 0.017), (-0.392, 0, 0.017), 0.0405),
    ],
    "wrist_1_link": [((0, 0, -0.0455), (0, 0, 0.0395), 0.039), ((0, -0.0475, 0), (0, 0.0572, 0), 0.039)],
    "wrist_2_link": [((0, 0, -0.0459), (0, 0, 0.0385), 0.039), ((0, -0.0572, 0), (0, 0.0475, 0), 0.039)],
    "wrist_3_link": [((0, 0, -0.0345), (0, 0, 0), 0.0375)],
}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROBOT))


@pytest.fixture
def data(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return data


def site_pose(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    site = data.site(ARM.flange_site)
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, site.xmat)
    return poses.make(site.xpos, quaternion)


def geoms(model: mujoco.MjModel, body: str, group: int) -> list[int]:
    number = model.body(body).id
    return [g for g in range(model.ngeom) if model.geom_bodyid[g] == number and model.geom_group[g] == group]


def no_warnings(data: mujoco.MjData) -> bool:
    return all(warning.number == 0 for warning in data.warning)


def test_flange_site_agrees_with_the_closed_form(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    joints = np.random.default_rng(0).uniform(ARM.joint_lower, ARM.joint_upper, (1000, 6))
    expected = ARM.forward(joints)
    found = []
    for row in joints:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        found.append(site_pose(model, data))
    assert poses.position_distance(found, expected).max() < 1e-9
    assert poses.rotation_distance(found, expected).max() < 1e-9


def test_masses_and_inertias_are_the_published_ones(model: mujoco.MjModel) -> None:
    for name, (mass, centre, inertia) in INERTIALS.items():
        body = model.body(name)
        assert body.mass[0] == mass
        np.testing.assert_allclose(body.ipos, centre, atol=1e-15)
        # MuJoCo sorts principal moments; turn them back into the link frame.
        rotation = poses.to_matrix(body.iquat)
        np.testing.assert_allclose(rotation @ np.diag(body.inertia) @ rotation.T, np.diag(inertia), atol=1e-12)


def test_names_and_limits_are_those_of_the_config(model: mujoco.MjModel) -> None:
    assert [model.joint(i).name for i in range(model.njnt)] == list(ARM.joint_names)
    assert [model.actuator(i).trnid[0] for i in range(model.nu)] == list(range(6))
    np.testing.assert_array_equal(model.jnt_range, np.transpose([ARM.joint_lower, ARM.joint_upper]))
    np.testing.assert_array_equal(model.actuator_ctrlrange, model.jnt_range)
    assert model.jnt_limited.all()
    assert model.actuator_forcelimited.all()
    np.testing.assert_array_equal(model.actuator_forcerange[:, 1], ARM.torque_limits)
    np.testing.assert_array_equal(model.actuator_forcerange[:, 0], -np.array(ARM.torque_limits))
    np.testing.assert_array_equal(model.dof_armature, 0.1)
    np.testing.assert_array_equal(model.body_gravcomp[1:], 1.0)


def test_every_joint_lags_alike(model: mujoco.MjModel) -> None:
    stiffness, damping = -model.actuator_biasprm[:, 1], -model.actuator_biasprm[:, 2]
    np.testing.assert_array_equal(stiffness, model.actuator_gainprm[:, 0])
    np.testing.assert_allclose(damping / stiffness, 0.02)


def test_home_is_that_of_the_config_and_touches_nothing(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    np.testing.assert_array_equal(data.qpos, HOME)
    np.testing.assert_array_equal(data.ctrl, HOME)
    assert data.ncon == 0
    np.testing.assert_allclose(site_pose(model, data)[:3], [0.45, 0.1, 0.5], atol=1e-12)


@pytest.mark.parametrize("body", CYLINDERS)
def test_collision_cylinders_are_those_that_cover_the_real_links(model: mujoco.MjModel, body: str) -> None:
    found = []
    for g in geoms(model, body, group=3):
        assert model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER
        assert model.geom_contype[g] == model.geom_conaffinity[g] == 1
        along = poses.rotate(model.geom_quat[g], [0.0, 0.0, model.geom_size[g, 1]])
        found.append((model.geom_pos[g] - along, model.geom_pos[g] + along, model.geom_size[g, 0]))
    assert len(found) == len(CYLINDERS[body])
    for start, end, radius in CYLINDERS[body]:
        assert any(
            abs(r - radius) < 1e-9
            and min(np.abs([a - start, b - end]).max(), np.abs([a - end, b - start]).max()) < 1e-9
            for a, b, r in found
        )


@pytest.mark.parametrize("body", CYLINDERS)
def test_what_is_seen_of_a_link_lies_within_1_mm_of_its_collision_shape(model: mujoco.MjModel, body: str) -> None:
    turn = np.linspace(0, 2 * np.pi, 25)
    ring = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=-1)
    for g in geoms(model, body, group=2):
        assert model.geom_contype[g] == model.geom_conaffinity[g] == 0
        size = model.geom_size[g]
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CYLINDER:
            local = np.concatenate([ring * size[0] + [0, 0, z] for z in np.linspace(-size[1], size[1], 9)])
        else:
            assert model.geom_type[g] == mujoco.mjtGeom.mjGEOM_ELLIPSOID
            heights = np.linspace(-1, 1, 9)
            local = np.concatenate([(ring * np.sqrt(1 - z * z) + [0, 0, z]) * size for z in heights])
        points = model.geom_pos[g] + poses.rotate(model.geom_quat[g], local)
        outside = np.full(len(points), np.inf)
        for start, end, radius in CYLINDERS[body]:
            axis = np.subtract(end, start)
            length = np.linalg.norm(axis)
            along = (points - start) @ (axis / length)
            across = np.linalg.norm(points - start - along[:, None] * axis / length, axis=1)
            beyond = np.maximum(np.abs(along - length / 2) - length / 2, 0.0)
            outside = np.minimum(outside, np.hypot(beyond, np.maximum(across - radius, 0.0)))
        assert outside.max() < 1e-3


def test_base_and_shoulder_do_not_collide_while_folded_links_do(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    data.qpos[:] = [0.0, -1.0, 3.0, 0.0, 0.0, 0.0]
    mujoco.mj_forward(model, data)
    bodies = {tuple(sorted(model.geom_bodyid[c.geom])) for c in data.contact}
    assert bodies
    neighbours = {(i, i + 1) for i in range(1, 7)}
    assert not bodies & neighbours


def test_gravity_compensation_leaves_no_sag(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    for joints in (HOME, np.array([0.0, 0.0, 0.0, 0.0, 0.3, 0.0])):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = data.ctrl[:] = joints
        for _ in range(1000):
            mujoco.mj_step(model, data)
        assert poses.position_distance(site_pose(model, data), ARM.forward(joints)) < 1e-4
        assert no_warnings(data)


def follow(model: mujoco.MjModel, lead: float) -> tuple[float, float]:
    """Follow a straight 0.45 m line in 2 s; return the largest distance [mm] from the set point and from the line.

    ``lead`` [s] is how far the set point runs ahead along the joint velocity.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    step = model.opt.timestep
    share = np.clip(np.arange(1251) * step / 2.0, 0.0, 1.0)
    share = 10 * share**3 - 15 * share**4 + 6 * share**5
    target = np.tile(ARM.forward(HOME), (len(share), 1))
    target[:, :3] += share[:, None] * [0.0, -0.4, -0.2]
    joints = [HOME]
    for pose in target:
        result = ARM.inverse(pose, joints[-1])
        assert result.success
        joints.append(result.joints)
    path = np.array(joints[1:])
    velocity = np.gradient(path, step, axis=0)
    reached = np.empty((len(path), 3))
    for k in range(len(path)):
        data.ctrl[:] = path[k] + lead * velocity[k]
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        reached[k] = data.site(ARM.flange_site).xpos
    assert no_warnings(data)
    direction = np.array([0.0, -0.4, -0.2]) / np.hypot(0.4, 0.2)
    offset = reached - target[0, :3]
    from_line = np.linalg.norm(offset - (offset @ direction)[:, None] * direction, axis=1)
    return 1e3 * np.linalg.norm(reached - target[:, :3], axis=1).max(), 1e3 * from_line.max()


def test_tracking_lags_by_the_ratio_of_the_gains_and_no_more(model: mujoco.MjModel) -> None:
    # The peak speed of this line is 0.42 m/s: 20 ms of it are 8.4 mm, which leading by 20 ms takes away.
    plain, plain_from_line = follow(model, lead=0.0)
    led, led_from_line = follow(model, lead=0.02)
    assert plain == pytest.approx(0.02 * 1.875 * np.hypot(400, 200) / 2.0, rel=0.1)
    assert led < 1.0
    assert max(plain_from_line, led_from_line) < 0.2


def test_a_second_of_control_noise_gives_no_warning(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    rng = np.random.default_rng(0)
    while data.time < 1.0:
        data.ctrl[:] = rng.uniform(model.actuator_ctrlrange[:, 0], model.actuator_ctrlrange[:, 1])
        mujoco.mj_step(model, data)
        assert np.all(np.abs(data.actuator_force) <= ARM.torque_limits)
    assert no_warnings(data)
    assert np.isfinite(data.qpos).all()


def test_the_scene_holds_the_arm_free_of_contact() -> None:
    scene = mujoco.MjModel.from_xml_path(str(SCENE))
    data = mujoco.MjData(scene)
    mujoco.mj_resetDataKeyframe(scene, data, scene.key("home").id)
    mujoco.mj_forward(scene, data)
    assert data.ncon == 0
    np.testing.assert_allclose(site_pose(scene, data), ARM.forward(HOME), atol=1e-9)


def test_it_attaches_through_mjcf_beside_a_free_body() -> None:
    robot = mjcf.from_path(str(ROBOT))
    arena = mjcf.RootElement(model="arena")
    box = arena.worldbody.add("body", name="box", pos=[1.0, 0.0, 0.5])
    box.add("freejoint")
    box.add("geom", type="box", size=[0.05, 0.05, 0.05])
    for key in robot.find_all("key"):
        key.remove()
    arena.attach(robot)
    physics = mjcf.Physics.from_mjcf_model(arena)
    assert physics.model.nkey == 0
    assert physics.model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    np.testing.assert_array_equal(physics.bind(robot.find_all("body")).gravcomp, 1.0)
    joints = physics.bind([robot.find("joint", name) for name in ARM.joint_names])
    with physics.reset_context():
        joints.qpos = HOME
    site = physics.bind(robot.find("site", ARM.flange_site))
    np.testing.assert_allclose(site.xpos, ARM.forward(HOME)[:3], atol=1e-9)
    assert physics.data.ncon == 0


def test_the_model_needs_no_other_file() -> None:
    alone = mujoco.MjModel.from_xml_string(ROBOT.read_text(encoding="utf-8"))
    assert alone.nmesh == alone.ntex == alone.nhfield == 0
