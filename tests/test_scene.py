from collections.abc import Callable

import mujoco
import numpy as np
import pytest
from parts import Parts

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.robot.scene import SceneBuilder
from koopdqn.robot.ur import URArm
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.workcell import Workcell, build_scene


class _SameTwice(ShelfTask):
    """A shelf that MuJoCo cannot compile."""

    def furnish(self, scene: SceneBuilder) -> None:
        super().furnish(scene)
        super().furnish(scene)


def test_mujoco_and_the_closed_form_agree_where_the_flange_is(workcell: Workcell, arm: URArm) -> None:
    for joints in np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (200, 6)):
        seen, computed = workcell.scene.flange_pose(joints), arm.forward(joints)
        assert pose.position_distance(seen, computed) < 1e-9
        assert pose.rotation_distance(seen, computed) < 1e-9


def test_an_arms_own_lengths_are_those_of_the_scene(arm: URArm) -> None:
    lengths = {"d1": 0.091, "a2": -0.4261, "a3": -0.3915, "d4": 0.111, "d5": 0.0952, "d6": 0.0853}
    calibrated = arm.model_copy(update=lengths)
    scene = SceneBuilder(calibrated).build()
    for joints in np.random.default_rng(0).uniform(-2 * np.pi, 2 * np.pi, (20, 6)):
        seen, computed = scene.flange_pose(joints), calibrated.forward(joints)
        assert pose.position_distance(seen, computed) < 1e-9
        assert pose.rotation_distance(seen, computed) < 1e-9


def test_the_room_is_no_larger_than_the_distance_between_tool_and_furniture(workcell: Workcell) -> None:
    scene, most = workcell.scene, 0.05
    model, collides = scene.model, scene.model.geom_contype > 0
    fixed = [i for i in np.flatnonzero(collides) if model.geom_bodyid[i] == 0 and "shelf" in model.geom(i).name]
    tool = [i for i in np.flatnonzero(collides) if "/tool" in model.body(model.geom_bodyid[i]).name]
    assert fixed
    assert tool
    near = 0
    _, begun, _ = workcell.reachability.draw_starts(workcell.task, np.random.default_rng(3), 20)
    for joints in begun:
        # Aside, toward a wall, until it is touched.
        for turn in np.linspace(0.0, 0.25, 12):
            there = joints + np.array([turn, 0, 0, 0, 0, 0])
            scene.place(there)
            between = min(mujoco.mj_geomDistance(model, scene.data, a, b, most, None) for a in fixed for b in tool)
            if 0.0 < between < most:
                assert scene.rooms(there, most)[1] <= between + 1e-6
                near += 1
    assert near > 20


def test_the_room_to_the_floor_is_no_larger_than_the_distance(workcell: Workcell) -> None:
    scene, most = workcell.scene, 0.02
    model, floor = scene.model, scene.model.geom("floor").id
    moving = [i for i in np.flatnonzero(model.geom_contype > 0) if model.geom_bodyid[i]]
    near = 0
    # Out over nothing but the floor, lower and lower.
    for lift in np.linspace(0.8, 0.9, 100):
        joints = np.array([-1.5, lift, 0.3, 0.0, 0.0, 0.0])
        scene.place(joints)
        between = min(mujoco.mj_geomDistance(model, scene.data, each, floor, most, None) for each in moving)
        if 0.0 < between < most:
            assert scene.rooms(joints, most)[1] <= between + 1e-6
            near += 1
    assert near > 3


def test_mujoco_finds_the_flange_where_a_batch_of_inverses_was_to_bring_it(workcell: Workcell, arm: URArm) -> None:
    rng = np.random.default_rng(1)
    targets = arm.forward(rng.uniform(-2 * np.pi, 2 * np.pi, (200, 6)))
    for joints, target in zip(arm.inverse_batch(targets, rng.uniform(-6.0, 6.0, (200, 6))), targets, strict=True):
        seen = workcell.scene.flange_pose(joints)
        assert pose.position_distance(seen, target) < 1e-9
        assert pose.rotation_distance(seen, target) < 1e-9


def test_a_question_does_not_depend_on_the_one_before(workcell: Workcell, arm: URArm) -> None:
    first, second = np.array(arm.home), np.array(arm.home) + 0.3
    before = workcell.scene.flange_pose(first)
    workcell.scene.contact(second)
    np.testing.assert_array_equal(workcell.scene.flange_pose(first), before)


def test_nothing_touches_at_home_and_a_folded_arm_touches_itself(workcell: Workcell, arm: URArm) -> None:
    assert workcell.scene.contact(np.array(arm.home)) == ""
    folded = np.array([0.0, -1.5, 3.1, 0.0, 0.0, 0.0])
    assert " with " in workcell.scene.contact(folded)


def test_clearance_falls_as_the_bottle_nears_the_lip_and_is_capped(workcell: Workcell) -> None:
    task = workcell.task
    heights = task.goal[2] + np.array([0.02, 0.01, 0.0])
    clearances = []
    for height in heights:
        joints = workcell.reachability.enter(pose.make([*task.goal[:2], height], task.goal[3:])).joints
        assert joints is not None
        clearances.append(workcell.scene.payload_clearance(joints))
    np.testing.assert_allclose(np.diff(clearances), -0.01, atol=1e-6)
    assert workcell.scene.payload_clearance(np.array(workcell.arm.home), at_most=0.001) == 0.001


def test_the_payload_is_not_the_arm_and_the_floor_is_not_furniture(workcell: Workcell) -> None:
    scene = workcell.scene
    names = [scene.model.geom(i).name for i in range(scene.model.ngeom)]
    assert sum("payload_" in name for name in names) == 2
    payload = next(i for i, name in enumerate(names) if "payload_bottle_body" in name)
    assert scene.thing(payload) == "bottle_body"


def test_a_scene_that_does_not_compile_is_bad_input(parts: Parts) -> None:
    broken = _SameTwice.model_construct(**dict(parts.task))
    with pytest.raises(BadInputError, match="scene of task shelf must compile"):
        build_scene(broken, parts.arm)


GREY = (0.5, 0.5, 0.5, 1.0)
NAN = float("nan")


@pytest.mark.parametrize(
    ("add", "said"),
    [
        (lambda s: s.tool_box("b", (0, 0, NAN), (1, 1, 1), GREY, 0.3, payload=True), "b: center must be finite"),
        (lambda s: s.tool_box("b", (0, 0, 0), (1, 1, -0.04), GREY, 0.3), "b: half_size must be above 0"),
        (lambda s: s.tool_box("b", (0, 0, 0), (1, 1, 1), GREY, NAN), "b: mass must be finite, found nan"),
        (lambda s: s.tool_cylinder("c", (0, 0, 0), (0, 0, NAN), 0.1, GREY, 0.3), "c: end must be finite"),
        (lambda s: s.tool_cylinder("c", (0, 0, 0), (0, 0, 1), 0.0, GREY, 0.3), "c: radius must be above 0, found 0.0"),
        (lambda s: s.furniture_box("d", (0, 0, 0), (1, np.inf, 1), GREY), "d: half_size must be finite"),
        (lambda s: s.furniture_capsule("e", (NAN, 0, 0), (0, 0, 1), 0.1, GREY), "e: start must be finite"),
    ],
)
def test_what_is_not_finite_or_has_no_size_does_not_stand_in_a_scene(
    arm: URArm, add: Callable[[SceneBuilder], None], said: str
) -> None:
    with pytest.raises(BadInputError, match=said):
        add(SceneBuilder(arm))


def test_only_the_arms_own_joints_are_moved(workcell: Workcell, arm: URArm) -> None:
    joints: Array = np.linspace(-1, 1, 6)
    workcell.scene.place(joints)
    np.testing.assert_array_equal(workcell.scene.data.qpos[workcell.scene.joint_index], joints)
    assert len(set(workcell.scene.joint_index)) == len(set(workcell.scene.actuator_index)) == len(arm.joint_names)
