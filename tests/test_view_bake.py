"""What is baked for a page is what MuJoCo says."""

from typing import Any

import mujoco
import numpy as np
import pytest
from helpers_shelf import reward_of, shelf, taught
from helpers_view import motions, shown
from parts import load_parts

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.intent.reward import SOURCES
from koopdqn.pose import POSITION, QUATERNION
from koopdqn.robot.scene import SceneBuilder
from koopdqn.tasks.knife import KnifeTask
from koopdqn.tasks.workcell import build_scene
from koopdqn.view.bake import MOST_FRAMES, baked_scene, baked_trust, frames_of, link_poses, moving_links, rounded
from koopdqn.view.motions import demonstrated_motions, edge_of, strips_of

JOINTS = np.array([[0.1, -1.2, 1.0, -0.4, 0.7, 0.2], [0.0, -1.6, 1.6, -1.6, -1.5, 0.0]])


def test_links_are_where_mujoco_has_the_bodies() -> None:
    scene = shelf().scene
    links = moving_links(scene)
    for joints, row in zip(JOINTS, link_poses(scene, JOINTS), strict=True):
        scene.data.qpos[scene.joint_index] = joints
        mujoco.mj_kinematics(scene.model, scene.data)
        assert row[:, POSITION] == pytest.approx(scene.data.xpos[links])
        assert row[:, QUATERNION] == pytest.approx(scene.data.xquat[links])


def test_geoms_put_on_baked_links_are_where_mujoco_has_them() -> None:
    scene = shelf().scene
    baked = baked_scene(scene)
    links = link_poses(scene, JOINTS[:1])[0]
    scene.place(JOINTS[0])
    places = scene.data.geom_xpos
    assert baked["links"] == 6
    assert {geom["link"] for geom in baked["geoms"]} == {-1, 0, 1, 2, 3, 4, 5}
    for geom in baked["geoms"]:
        own = np.array(geom["pose"])
        here = own if geom["link"] < 0 else pose.compose(links[geom["link"]], own)
        assert np.linalg.norm(places - here[POSITION], axis=1).min() < 3e-4


def test_every_visible_geom_is_baked_once() -> None:
    scene = shelf().scene
    assert len(baked_scene(scene)["geoms"]) == int((scene.model.geom_group < 3).sum())


def test_a_mesh_is_baked_with_its_vertices(arm: Any) -> None:
    class Wedge(SceneBuilder):
        def add(self) -> None:
            corners = [0, 0, 0, 0.2, 0, 0, 0, 0.2, 0, 0, 0, 0.2]
            self._arena.asset.add("mesh", name="wedge", vertex=corners)
            self._arena.worldbody.add("geom", name="wedge", type="mesh", mesh="wedge", pos=[0.5, 0.5, 0.0])

    builder = Wedge(arm)
    builder.add()
    scene = builder.build()
    baked = baked_scene(scene)
    [geom] = [geom for geom in baked["geoms"] if geom["shape"] == "mesh"]
    mesh = baked["meshes"][geom["mesh"]]
    there = pose.rotate(np.array(geom["pose"][3:]), np.array(mesh["vertices"])) + np.array(geom["pose"][:3])
    assert sorted(map(tuple, np.round(there - [0.5, 0.5, 0.0], 2) + 0.0)) == [
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.2),
        (0.0, 0.2, 0.0),
        (0.2, 0.0, 0.0),
    ]
    assert len(mesh["faces"]) == 4


def test_frames_are_few_and_keep_both_ends() -> None:
    for count in (1, 2, MOST_FRAMES, MOST_FRAMES + 1, 5000):
        frames = frames_of(count)
        assert (frames[0], frames[-1]) == (0, count - 1)
        assert len(frames) == min(count, MOST_FRAMES)
        assert (np.diff(frames) > 0).all()


def test_the_tube_is_as_wide_as_it_is_trusted() -> None:
    trust: Any = reward_of(taught()).trust
    baked = baked_trust(trust)
    vertices = np.array(baked["vertices"])
    gap = np.linalg.norm(vertices[:, None] - trust.middle[:, :3], axis=2)
    # Each vertex lies on the ball of its own place.
    assert np.abs(gap - trust.radius[:, 0]).min(axis=1).max() < 2e-4
    assert 0 <= np.array(baked["faces"]).min() <= np.array(baked["faces"]).max() < len(vertices)


def test_a_box_is_drawn_as_a_box_and_no_trust_as_nothing() -> None:
    known = taught()
    for option, empty in (("trust=paper", False), ("trust=nowhere", True)):
        settings = load_parts(option).trust
        signs = [np.ones((len(rows) - 1, len(settings.doubts), 2)) for rows in known.trajectories]
        trust: Any = settings.fit(known.trajectories, signs, shelf().task.frame)
        vertices = np.array(baked_trust(trust)["vertices"])
        assert (len(vertices) == 0) == empty
        if not empty:
            away = np.abs(vertices[:, None] - trust.mean[:, :3]) / (trust.settings.sigmas * trust.deviation[:, :3])
            assert np.abs(away.max(axis=2) - 1.0).min(axis=1).max() < 0.05


def test_a_box_without_width_and_a_path_straight_back_are_drawn_too() -> None:
    known = taught()
    settings = load_parts("trust=paper", "trust.position_floor_m=0").trust
    there = known.trajectories[0].copy()
    there[:, 1] = there[0, 1]
    back = np.concatenate([there, there[-2::-1]])
    for rows in (there, back):
        trust: Any = settings.fit([rows], [np.ones((len(rows) - 1, len(settings.doubts), 2))], shelf().task.frame)
        vertices = np.array(baked_trust(trust)["vertices"])
        assert len(vertices)
        assert np.isfinite(vertices).all()


def test_answers_add_balls() -> None:
    trust = reward_of(taught()).trust.extended(shelf().task.goal[None], np.array([0.07]))
    [ball] = baked_trust(trust)["balls"]
    assert ball == {"center": rounded(shelf().task.goal[POSITION]), "radius": 0.07}


def test_learned_motions_are_followed_by_the_intent_alone_from_the_same_start() -> None:
    kinds = [motion.kind for motion in motions()]
    assert kinds == ["learned", "intent"] * 2 + ["demonstration"] * (len(kinds) - 4)
    for learned, intent in (motions()[:2], motions()[2:4]):
        assert intent.poses[0] == pytest.approx(learned.poses[0])
        assert intent.joints[0] == pytest.approx(learned.joints[0])
        assert shelf().task.reached(intent.poses[-1:])[0]


def test_where_rewards_come_from_is_told_for_every_pose() -> None:
    learned = motions()[0]
    assert learned.sources is not None
    assert len(learned.sources) == len(learned.poses)
    names = {SOURCES[source] for source in learned.sources}
    assert "trusted" in names <= set(SOURCES)


def test_distances_are_those_to_the_goal_and_to_the_demonstrators_path() -> None:
    learned = motions()[0]
    goal, own, turn = learned.strips
    assert (goal.name, own.name, turn.unit) == ("to the goal", "from the demonstrator's own path", "°")
    assert goal.values == pytest.approx(1e3 * pose.position_distance(learned.poses, shelf().task.goal))
    assert own.values[0] == pytest.approx(0.0, abs=1e-9)
    assert own.values.max() < 30.0


def test_a_knife_shows_its_edge_and_its_rule() -> None:
    from koopdqn.settings import load_settings
    from koopdqn.tasks.task import Task

    task = load_settings(_composed("task=knife")["task"], Task, "task")
    assert isinstance(task, KnifeTask)
    poses = np.array([task.nominal_start, task.goal])
    edge = edge_of(poses, task)
    assert edge is not None
    # Up at the start, down at the goal.
    assert edge[0, 5] > 0.9
    assert edge[1, 5] < -0.98
    angle, distance = strips_of(poses, task.goal, task)[-2:]
    assert (angle.limit, distance.limit) == pytest.approx((np.degrees(task.safe_angle_rad), 1e3 * task.rule_distance_m))
    scene = build_scene(task, shelf().arm)
    baked = [geom for geom in baked_scene(scene)["geoms"] if geom["name"] == "edge"]
    assert len(baked) == 1


def _composed(*overrides: str) -> Any:
    from koopdqn.app.hydra.compose import composed
    from koopdqn.settings import plain

    return plain(composed([*overrides, "out=unused"]))


def test_what_is_baked_stays_small() -> None:
    for motion in shown().content()["motions"]:
        assert len(motion["frames"]) == len(motion["path"]) <= MOST_FRAMES
        assert len(motion["links"]) <= len(motion["frames"])


def test_joints_of_another_arm_are_not_this_ones() -> None:
    poses, reachability = taught().trajectories[0], shelf().reachability
    own = np.array(reachability.follow_as_far(poses)[0])
    for given in (own, own + 0.1, np.zeros((len(own), 7))):
        item = Demonstration(0.02 * np.arange(float(len(poses))), poses, given)
        (motion,) = demonstrated_motions([item], reachability, shelf().task, 1)
        np.testing.assert_allclose(reachability.arm.forward(motion.joints)[:, :3], poses[:, :3], atol=1e-6)
        assert np.array_equal(motion.joints, given) == (given is own)
