"""An arm of any MJCF file: seven joints by damped least squares, six in closed form, and what a file must say."""

import hashlib
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from parts import load_parts
from small_run import SMALL

from koopdqn import pose
from koopdqn.app import cli
from koopdqn.app.api import load_config, open_workcell
from koopdqn.app.hydra.overrides import prepare
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.evaluation.dynamics import Execution, play
from koopdqn.pose import Array
from koopdqn.resources import asset_path
from koopdqn.robot.arm import Arm
from koopdqn.robot.mjcf import MjcfArm, recorded_arm
from koopdqn.robot.scene import SceneBuilder
from koopdqn.settings import load_settings
from koopdqn.tasks.workcell import Reachability, Workcell, build_scene

SEVEN = Path(__file__).with_name("seven.xml")
MENAGERIE = os.environ.get("MENAGERIE_ROOT", "")
FROM_MENAGERIE = {
    "panda": "franka_emika_panda/panda_nohand.xml",
    "xarm7": "ufactory_xarm7/xarm7_nohand.xml",
    "ur5e": "universal_robots_ur5e/ur5e.xml",
}


def arm_of(path: Path, site: str = "flange", *more: str) -> MjcfArm:
    arm = load_config("robot=mjcf", f"robot.path='{path}'", f"robot.site={site}", *more).robot
    assert isinstance(arm, MjcfArm)
    return arm


@pytest.fixture(scope="module")
def seven() -> MjcfArm:
    return arm_of(SEVEN)


def postures(arm: Arm, count: int) -> Array:
    """Joint angles (count, n) within the ranges, not at their ends."""
    lower, upper = np.maximum(arm.joint_lower, -np.pi), np.minimum(arm.joint_upper, np.pi)
    return np.random.default_rng(3).uniform(0.9 * lower + 0.1 * upper, 0.1 * lower + 0.9 * upper, (count, len(lower)))


def check_arm(arm: MjcfArm) -> None:
    """Assert that forward is MuJoCo's, and that the inverse reaches what is near without a jump."""
    model = mujoco.MjModel.from_xml_path(str(arm.mjcf))
    data, joints = mujoco.MjData(model), postures(arm, 60)
    address = [model.joint(name).qposadr[0] for name in arm.joint_names]
    poses = arm.forward(joints)
    for row, found in zip(joints, poses, strict=True):
        data.qpos[address] = row
        mujoco.mj_kinematics(model, data)
        site = data.site(arm.flange_site)
        assert np.abs(found[:3] - site.xpos).max() < 1e-9
        assert np.abs(pose.to_matrix(found[3:]) - site.xmat.reshape(3, 3)).max() < 1e-9
    near = joints + np.random.default_rng(4).uniform(-0.01, 0.01, joints.shape)
    found = arm.inverse_batch(poses, near)
    assert pose.position_distance(arm.forward(found), poses).max() < 1e-7
    assert pose.rotation_distance(arm.forward(found), poses).max() < 1e-7
    assert np.median(np.abs(found - near).max(axis=1)) < 0.05
    assert (found >= np.array(arm.joint_lower)).all()
    assert (found <= np.array(arm.joint_upper)).all()


def test_seven_joints_reach_what_is_near_within_their_limits(seven: MjcfArm) -> None:
    assert len(seven.joint_names) == 7
    assert seven.kinematics == "numeric"
    assert seven.torque_limits == (150.0,) * 4 + (40.0,) * 3
    assert seven.home == (0.0, 0.1, 0.0, 1.7, 0.0, -0.2, 0.0)
    check_arm(seven)


def test_one_pose_and_many_give_the_same(seven: MjcfArm) -> None:
    joints = postures(seven, 5)
    poses, seeds = seven.forward(joints), joints + 0.01
    for row, (target, seed) in enumerate(zip(poses, seeds, strict=True)):
        result = seven.inverse(target, seed)
        assert result.success
        assert np.linalg.norm(seven.forward(result.joints)[:3] - target[:3]) < 1e-7
        assert np.abs(result.joints - seven.inverse_batch(poses, seeds)[row]).max() < 1e-9


def test_most_poses_are_found_from_home_and_each_solution_is_one(seven: MjcfArm) -> None:
    poses = seven.forward(postures(seven, 60))
    found = seven.inverse_batch(poses, np.tile(seven.home, (60, 1)))
    assert np.isnan(found).any(axis=1).mean() < 0.1
    solutions = seven.solutions(poses[0])
    assert len(solutions) > 1
    assert pose.position_distance(seven.forward(solutions), poses[0]).max() < 1e-7
    steps = np.abs(solutions - np.array(seven.home)).max(axis=1)
    assert (np.diff(steps) >= 0).all()


def test_a_way_along_a_joint_limit_is_taken_by_the_other_joints(seven: MjcfArm) -> None:
    joints = np.array(seven.home)
    joints[0] = seven.joint_upper[0]
    start = seven.forward(joints)
    turned = pose.compose(pose.make([0, 0, 0], pose.from_rotation_vector([0, 0, 0.02])), start)
    result = seven.inverse(turned, joints)
    assert result.success
    assert result.joints[0] <= seven.joint_upper[0]


def test_what_is_out_of_reach_is_told(seven: MjcfArm) -> None:
    target = pose.make([2.0, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0])
    result = seven.inverse(target, seven.home)
    assert not result.success
    assert "out of reach" in result.reason
    assert not len(seven.solutions(target))


def test_a_ur_from_its_file_is_the_ur_in_closed_form() -> None:
    pytest.importorskip("eaik")
    closed = load_config("robot=ur5e").robot
    arm = arm_of(asset_path("ur/ur5e.xml"), "attachment_site")
    assert arm.kinematics == "analytic"
    joints = postures(arm, 100)
    poses, seeds = closed.forward(joints), joints + 0.02
    assert pose.position_distance(arm.forward(joints), poses).max() < 1e-9
    assert np.abs(arm.inverse_batch(poses, seeds) - closed.inverse_batch(poses, seeds)).max() < 1e-6
    assert len(arm.solutions(poses[0])) == len(closed.solutions(poses[0]))
    check_arm(arm_of(asset_path("ur/ur5e.xml"), "attachment_site", "robot.kinematics=numeric"))


def test_without_the_extra_it_is_numeric_or_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "eaik.IK_HP", None)
    path = asset_path("ur/ur5e.xml")
    assert arm_of(path, "attachment_site").kinematics == "numeric"
    with pytest.raises(BadInputError, match=r"koopdqn\[analytic\]"):
        arm_of(path, "attachment_site", "robot.kinematics=analytic")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([], "path: must name the arm's MJCF file, found None"),
        (["robot.path=nowhere.xml", "robot.site=flange"], "found nothing at nowhere.xml"),
        ([f"robot.path={SEVEN}"], "site: must name the site that is the flange, found None"),
        ([f"robot.path={SEVEN}", "robot.site=tool"], "unknown site of seven.xml 'tool'; valid: flange"),
        ([f"robot.path={SEVEN}", "robot.site=flange", "robot.sha256=ab"], "path: must be the file whose SHA-256 is ab"),
        ([f"robot.path={SEVEN}", "robot.site=flange", "robot.home=[0,0]"], "home: must be 7 numbers"),
        ([f"robot.path={SEVEN}", "robot.site=flange", "robot.velocity_limits=0"], "velocity_limits: must be above 0"),
        ([f"robot.path={SEVEN}", "robot.site=flange", "robot.kinematics=analytic"], "kinematics: must be numeric"),
        ([f"robot.path={Path(__file__)}", "robot.site=flange"], "must compile in MuJoCo"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(changes: list[str], words: str) -> None:
    with pytest.raises(BadInputError) as told:
        load_config("robot=mjcf", *changes)
    assert words in str(told.value)
    assert "\n" not in str(told.value)


def test_an_arm_that_slides_or_has_few_joints_is_refused(tmp_path: Path) -> None:
    text = SEVEN.read_text(encoding="utf-8")
    sliding = tmp_path / "sliding.xml"
    sliding.write_text(text.replace('<joint name="A4" ', '<joint name="A4" type="slide" '), encoding="utf-8")
    with pytest.raises(BadInputError, match="6 or more hinges"):
        arm_of(sliding)
    weak = tmp_path / "weak.xml"
    weak.write_text(text.replace(' forcerange="-40 40"', ' forcelimited="false"'), encoding="utf-8")
    with pytest.raises(BadInputError, match="torque_limits: must be given for A5"):
        arm_of(weak)


ACTUATOR = '<general name="A3" joint="A3"/>'
KEY = '<key name="home" qpos="0 0.1 0 1.7 0 -0.2 0"/>'


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({KEY: KEY.replace("1.7", "2.5")}, "home: must lie within -0.2…2.4 rad for A4, found 2.5"),
        ({ACTUATOR: '<motor name="A3" joint="A3"/>'}, "the actuator of A3 must be a position actuator"),
        ({ACTUATOR: ""}, "an actuator for every joint, found none for A3"),
        ({'<body name="base" gravcomp="1">': '<body name="base"><freejoint/>', KEY: ""}, "found a free joint"),
        ({'<joint name="A3"/>': "<joint/>", ACTUATOR: ""}, "hinges that have names, found 7, 1 without a name"),
    ],
)
def test_what_an_arm_of_a_file_lacks_is_told_when_it_is_loaded(
    tmp_path: Path, changes: dict[str, str], words: str
) -> None:
    text = SEVEN.read_text(encoding="utf-8")
    for before, after in changes.items():
        assert before in text
        text = text.replace(before, after)
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    with pytest.raises(BadInputError, match=re.escape(words)):
        arm_of(tmp_path / "arm.xml")


def test_the_digest_is_also_of_what_a_file_includes_and_names(tmp_path: Path, seven: MjcfArm) -> None:
    assert seven.sha256 == hashlib.sha256(SEVEN.read_bytes()).hexdigest()
    (tmp_path / "inner.xml").write_text(SEVEN.read_text(encoding="utf-8"), encoding="utf-8")
    top = tmp_path / "arm.xml"
    top.write_text(
        '<mujoco><include file="inner.xml"/><compiler meshdir="parts"/>'
        '<asset><mesh name="block" file="block.obj"/></asset></mujoco>',
        encoding="utf-8",
    )
    (tmp_path / "parts").mkdir()
    mesh = tmp_path / "parts" / "block.obj"
    mesh.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    alone = hashlib.sha256(top.read_bytes()).hexdigest()
    # As an earlier koopdqn wrote it.
    assert arm_of(top, "flange", f"robot.sha256={alone}").sha256 == arm_of(top).sha256 != alone
    node = {**described(arm_of(top)), "sha256": alone}
    assert recorded_arm(node, arm_of(top)) == arm_of(top)
    known = arm_of(top).sha256
    for file in (mesh, tmp_path / "inner.xml"):
        text = file.read_text(encoding="utf-8")
        file.write_text(text.replace(" 1\n", " 0.9\n", 1).replace("-2.9 2.9", "-2.8 2.9"), encoding="utf-8")
        with pytest.raises(BadInputError, match=f"path: must be the file whose SHA-256 is {known}"):
            arm_of(top, "flange", f"robot.sha256={known}")
        file.write_text(text, encoding="utf-8")
        assert arm_of(top).sha256 == known


def test_artifacts_hold_the_files_digest_and_not_where_it_lies(seven: MjcfArm) -> None:
    node = described(seven)
    assert "path" not in node
    assert str(SEVEN.parent) not in str(node)
    again: Any = load_settings({**node, "path": SEVEN}, Arm, "robot")
    assert again == seven
    with pytest.raises(BadInputError, match="path: must name"):
        load_settings(node, Arm, "robot")


def test_a_record_may_not_name_a_file_elsewhere(tmp_path: Path) -> None:
    record = tmp_path / ".hydra" / "overrides.yaml"
    record.parent.mkdir()
    record.write_text("- command=train\n- robot=mjcf\n- robot.path=/etc/passwd\n", encoding="utf-8")
    with pytest.raises(BadInputError, match=r"give robot\.path= again"):
        prepare("train", [f"run={tmp_path}"])
    given = prepare("train", [f"run={tmp_path}", "robot.path=mine.xml"]).overrides
    assert [each for each in given if each.startswith("robot.path")] == ["robot.path=mine.xml"]


def followed(folder: Path, text: str) -> Execution:
    """What becomes of a slow turn of the base in the dynamics of an arm of this XML."""
    (folder / "arm.xml").write_text(text)
    arm: Any = load_config(
        "robot=mjcf", f"robot.path='{folder}/arm.xml'", "robot.site=flange", "robot.torque_limits=100"
    ).robot
    scene = build_scene(load_parts().task, arm)
    cell = Workcell(load_parts().task, arm, scene, Reachability(arm, scene))
    way = np.array(arm.home) + 0.002 * np.arange(60.0)[:, None] * np.eye(7)[0]
    return play(cell, way, np.full(59, 0.02))


def test_a_tendons_motor_is_not_taken_for_a_joints(tmp_path: Path) -> None:
    finger = (
        '<body name="finger" pos="0 0 0.06"><joint name="finger" type="slide" axis="1 0 0" range="0 0.04"/>'
        '<geom type="box" size="0.005 0.005 0.005" mass="0.01" contype="0" conaffinity="0"/></body>'
    )
    site, hand = '<site name="flange" pos="0 0 0.05"/>', '<position name="hand" tendon="grip" kp="50" kv="5"/>'
    text = SEVEN.read_text().replace(site, site + finger).replace('1.7 0 -0.2 0"', '1.7 0 -0.2 0 0"')
    tendon = '<tendon><fixed name="grip"><joint joint="finger" coef="1"/></fixed></tendon>'
    for first in (True, False):
        motors = tendon + ("<actuator>" + hand if first else "<actuator>")
        made = text.replace("<actuator>", motors).replace("</actuator>", ("" if first else hand) + "</actuator>")
        assert followed(tmp_path, made).tracking_error_mm.max() < 2.0


def test_gravity_that_motors_compensate_counts_once(tmp_path: Path) -> None:
    text = SEVEN.read_text()
    by_motors = re.sub(r'<joint name="(A\d)"', r'<joint name="\1" actuatorgravcomp="true"', text)
    assert by_motors != text
    once, said = followed(tmp_path, text).torque_ratio, followed(tmp_path, by_motors).torque_ratio
    assert said == pytest.approx(once, rel=0.02)


def test_the_shelf_is_reached_by_seven_joints(seven: MjcfArm) -> None:
    config = load_config("task=shelf", "robot=mjcf", f"robot.path='{SEVEN}'", "robot.site=flange")
    workcell = open_workcell(config)
    path = config.task.expert().roll_out(config.task.nominal_start, 500)
    joints, reason = workcell.reachability.follow(path)
    assert not reason
    assert joints is not None
    assert joints.shape == (len(path), 7)
    assert np.abs(np.diff(joints, axis=0)).max() < 0.1
    assert workcell.scene.contact(np.array(seven.home)) == ""


@pytest.mark.skipif(not MENAGERIE, reason="MENAGERIE_ROOT names no folder")
@pytest.mark.parametrize("name", FROM_MENAGERIE)
def test_arms_of_menagerie(name: str) -> None:
    path = Path(MENAGERIE) / FROM_MENAGERIE[name]
    check_arm(arm_of(path, "attachment_site"))
    config = load_config("task=shelf", "robot=mjcf", f"robot.path='{path}'", "robot.site=attachment_site")
    joints, reason = open_workcell(config).reachability.follow(
        config.task.expert().roll_out(config.task.nominal_start, 500)
    )
    assert joints is not None, reason


def in_degrees(text: str) -> str:
    """Return an MJCF text with the ranges of its joints in degrees."""
    return re.sub(
        r'(?<![a-z])range="([^"]*)"',
        lambda found: f'range="{" ".join(f"{np.degrees(float(each)):.12g}" for each in found[1].split())}"',
        text,
    )


VIEW = '<option integrator="Euler"/><statistic extent="1"/><visual><headlight diffuse="1 1 1"/></visual>'
WRITTEN: dict[str, Callable[[str], str]] = {
    "degrees by habit": lambda text: in_degrees(text).replace(' angle="radian"', ""),
    "degrees by name": lambda text: in_degrees(text).replace('angle="radian"', 'angle="degree"'),
    "a view and an integrator of its own": lambda text: text.replace('<option integrator="implicitfast"/>', VIEW),
    "limits told": lambda text: (
        text.replace('autolimits="true"', 'autolimits="false"')
        .replace('<joint axis="0 0 1"', '<joint axis="0 0 1" limited="true"')
        .replace("forcerange=", 'forcelimited="true" forcerange=')
    ),
}


@pytest.mark.parametrize("way", WRITTEN)
def test_an_arm_stands_in_its_scene_as_in_its_file_however_that_is_written(tmp_path: Path, way: str) -> None:
    turned = '<body name="link_5" quat="0.5 0.5 -0.5 0.5"'
    text = SEVEN.read_text(encoding="utf-8").replace('<body name="link_5"', turned)
    text = text.replace("<worldbody>", '<asset><mesh name="cap" file="cap.obj"/></asset><worldbody>', 1)
    text = text.replace(turned, f'<geom type="mesh" mesh="cap" mass="0.1"/>{turned}', 1)
    text = text.replace("<compiler ", '<compiler meshdir="meshes" ')
    (tmp_path / "meshes").mkdir()
    corners = [(0, 0, 0), (0.05, 0, 0), (0, 0.05, 0), (0, 0, 0.05)]
    faces = [(1, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)]
    lines = [*(f"v {x} {y} {z}" for x, y, z in corners), *(f"f {a} {b} {c}" for a, b, c in faces)]
    (tmp_path / "meshes" / "cap.obj").write_text("\n".join(lines), encoding="utf-8")
    models = []
    for name, each in (("as_it_is", text), ("written", WRITTEN[way](text))):
        (tmp_path / f"{name}.xml").write_text(each, encoding="utf-8")
        arm = arm_of(tmp_path / f"{name}.xml")
        models.append(SceneBuilder(arm).build().model)
    one, other = models
    for key in ("jnt_range", "jnt_limited", "body_pos", "body_quat", "geom_pos", "geom_quat", "geom_size"):
        np.testing.assert_allclose(getattr(one, key), getattr(other, key), atol=1e-7, err_msg=key)
    for key in ("actuator_forcerange", "actuator_forcelimited", "body_mass", "mesh_vert"):
        np.testing.assert_allclose(getattr(one, key), getattr(other, key), atol=1e-7, err_msg=key)
    assert one.opt.integrator == other.opt.integrator


def test_a_run_with_an_arm_of_a_file_is_read_and_compared_where_that_lies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arm, run = [f"robot.path={SEVEN}", "robot.site=flange"], f"run={tmp_path}/run"
    few = ("eval.episodes=2", "eval.dynamics=false", "eval.baselines=false")
    given = ["robot=mjcf", *arm, *SMALL, "train.max_steps=1500"]
    assert cli.main(["train", *given, f"out={tmp_path}/run"]) == 1
    assert cli.main(["compare", run, run, arm[0], "view.starts=1", "eval.episodes=2", f"out={tmp_path}/both"]) == 0
    assert cli.main(["eval", run, arm[0], "reward.size=2", *few, f"out={tmp_path}/eval"]) == 0
    assert cli.main(["eval", run, "robot=ur5e", "reward.size=2", *few, f"out={tmp_path}/other"]) == 0
    assert "robot" not in capsys.readouterr().err.split("reward")[0]
    # A stopped one says what goes on with it, with the arm's file.
    (tmp_path / "run" / "policy.safetensors").unlink()
    assert cli.main(["eval", run, arm[0], f"out={tmp_path}/none"]) == 2
    assert f"robot.path={SEVEN} goes on" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ('gear="2"', "found gear 2"),
        ('biastype="affine" gainprm="200" biasprm="0 -400 -20"', "found gear 1, gainprm[0] = 200"),
        ('biastype="affine" gainprm="400" biasprm="40 -400 -20"', "biasprm[0] = 40"),
    ],
)
def test_an_actuator_whose_set_point_is_not_the_joints_angle_is_refused(
    tmp_path: Path, changed: str, words: str
) -> None:
    text = SEVEN.read_text(encoding="utf-8")
    actuator = re.search(r'<(position|general)[^>]*joint="A1"[^>]*/>', text)
    assert actuator
    kind = "general" if "gainprm" in changed else actuator[1]
    given = f'<general joint="A1" {changed}/>' if kind == "general" else actuator[0].replace("/>", f" {changed}/>")
    (tmp_path / "arm.xml").write_text(text.replace(actuator[0], given), encoding="utf-8")
    with pytest.raises(BadInputError, match=re.escape(words)):
        arm_of(tmp_path / "arm.xml")


def test_an_element_that_dm_control_does_not_know_is_told(tmp_path: Path) -> None:
    text = SEVEN.read_text(encoding="utf-8")
    site = re.search(r'<site[^>]*name="flange"[^>]*/>', text)
    assert site
    framed = f'<frame pos="0 0 0.1">{site[0]}</frame>'
    (tmp_path / "arm.xml").write_text(text.replace(site[0], framed), encoding="utf-8")
    config = load_config("robot=mjcf", f"robot.path='{tmp_path}/arm.xml'", "robot.site=flange")
    with pytest.raises(BadInputError, match=r"must compile in MuJoCo, which says: .*frame"):
        open_workcell(config)
