"""Robot programs: limits kept at every sample, the learned path reproduced, refusals that name place and reason."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from helpers_shelf import shelf, taught
from parts import as_demonstrations
from program_reader import Timed, read_joint_trajectory, read_movep, read_servoj, transforms
from scipy.interpolate import make_interp_spline
from scipy.spatial.distance import cdist

from koopdqn import pose
from koopdqn.app.api import load_config
from koopdqn.app.commands import program as command
from koopdqn.app.commands.program import export_program
from koopdqn.artifact import described
from koopdqn.demonstrations.dataset import Placement
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.paths import SmoothPath, arc_lengths, hausdorff
from koopdqn.pose import Array
from koopdqn.programs.program import Program, make_program
from koopdqn.programs.ros import write_bag, write_json_trajectory, write_yaml_trajectory
from koopdqn.programs.schema import ProgramFile
from koopdqn.programs.settings import ProgramSettings
from koopdqn.programs.timing import Limits, smoothed, steady, timed
from koopdqn.programs.urscript import write_movep, write_rtde, write_servoj
from koopdqn.robot.scene import SceneBuilder
from koopdqn.robot.ur import URArm
from koopdqn.tasks.actions import nearest_actions
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import demonstrator_next_poses
from koopdqn.tasks.workcell import Reachability, Workcell

STEP_LIMIT = 900
SETTINGS = load_config().program
# The nominal start as the arm takes it, with the last joint a whole turn on.
WOUND = (2.4969829894, -1.3671899187, 1.3945485448, -0.0273586261, 0.9261866626, -1.5707963268 + 2.0 * np.pi)
STARTS: dict[str, Any] = {
    "nominal": "nominal",
    "pose": (0.505, -0.175, 0.42, 0.70710678, 0.0, 0.70710678, 0.0),
    "joints": WOUND,
}


def policy(poses: Array, starts: Array) -> np.ndarray:
    """Always the action nearest to what the person would do: a path in the agent's stairs."""
    task = shelf().task
    return nearest_actions(poses, demonstrator_next_poses(task, poses, starts), task)


def settings(**fields: object) -> ProgramSettings:
    return ProgramSettings.model_validate({**dict(SETTINGS), **fields})


def made(cell: Workcell, placement: Placement | None = None, **fields: object) -> Program:
    return make_program(cell, policy, settings(**fields), STEP_LIMIT, placement)


@cache
def program(start: str = "nominal") -> Program:
    return made(shelf(), start=STARTS[start])


def finer(rows: Array, times: int = 8) -> Array:
    """Return rows (N, D) with others between them."""
    at = np.linspace(0.0, len(rows) - 1.0, times * (len(rows) - 1) + 1)
    return np.stack([np.interp(at, np.arange(len(rows)), column) for column in rows.T], axis=1)


def assert_follows(joints: Array, path: Array, millimetres: float = 1.0, degrees: float = 0.2) -> None:
    """Check that joints (N, 6) lead along poses (M, 7): each has one of the other within both distances."""
    found, wanted = transforms(finer(joints)), finer(path)
    turned = pose.from_matrix(found[:, :3, :3])
    cosine = np.abs(turned @ pose.normalized(wanted[:, pose.QUATERNION]).T)
    far = np.degrees(2.0 * np.arccos(cosine.clip(0.0, 1.0))) / degrees
    far = np.maximum(far, 1e3 * cdist(found[:, :3, 3], wanted[:, pose.POSITION]) / millimetres)
    assert far.min(axis=0).max() < 1.0
    assert far.min(axis=1).max() < 1.0


def assert_within_limits(read: Timed, limits: Limits) -> None:
    """Check every sample by differences, the rest before and after included; the clock must be even."""
    (period,) = {round(float(step), 9) for step in np.diff(read.times)}
    ends = np.repeat(read.joints[:1], 3, axis=0), np.repeat(read.joints[-1:], 3, axis=0)
    rested = np.concatenate([ends[0], read.joints, ends[1]])
    for order, most in enumerate((limits.speed, limits.acceleration, limits.jerk), start=1):
        assert (np.abs(np.diff(rested, n=order, axis=0)) / period**order <= most).all(), order
    tool = transforms(read.joints)[:, :3, 3]
    assert (np.linalg.norm(np.diff(tool, axis=0), axis=1) / period <= limits.tool_speed).all()


def test_a_motion_of_hours_is_refused_before_it_is_made() -> None:
    with pytest.raises(WorkFailedError, match=r"must last at most 1000000 periods of .*program\.tool_speed_m_s"):
        made(shelf(), tool_speed_m_s=1e-9)


@pytest.mark.parametrize("start", STARTS)
def test_urscript_read_back_starts_as_given_keeps_the_limits_and_follows_the_path(start: str, tmp_path: Path) -> None:
    given = program(start)
    write_servoj(tmp_path / "program.script", given)
    first, stream = read_servoj(tmp_path / "program.script")
    assert_within_limits(stream, given.limits)
    assert_follows(stream.joints, given.smooth)
    if start == "joints":
        np.testing.assert_allclose(first, STARTS[start], atol=1e-9)
    elif start == "pose":
        np.testing.assert_allclose(transforms(first[None])[0, :3, 3], STARTS[start][:3], atol=1e-8)
    assert np.abs(np.diff(stream.joints, axis=0)).max() < 0.1


@pytest.mark.parametrize("name", ["trajectory.yaml", "trajectory.json"])
def test_a_joint_trajectory_read_back_follows_the_path_and_its_speeds_are_its_own(name: str, tmp_path: Path) -> None:
    given = program("joints")
    write = write_yaml_trajectory if name.endswith("yaml") else write_json_trajectory
    write(tmp_path / name, given)
    names, positions, velocities, accelerations = read_joint_trajectory(tmp_path / name)
    assert names == list(shelf().arm.joint_names)
    np.testing.assert_allclose(positions.joints[0], WOUND, atol=1e-9)
    assert_within_limits(positions, given.limits)
    assert_follows(positions.joints, given.smooth)
    assert (np.abs(velocities.joints) <= given.limits.speed).all()
    assert (np.abs(accelerations.joints) <= given.limits.acceleration).all()
    # As ROS's controllers ask of the last point.
    assert not velocities.joints[[0, -1]].any()
    assert not accelerations.joints[[0, -1]].any()
    middle = 0.5 * (velocities.joints[1:] + velocities.joints[:-1])
    np.testing.assert_allclose(middle * given.motion.period, np.diff(positions.joints, axis=0), atol=1e-4)


@pytest.mark.parametrize("uneven", [False, True])
def test_at_the_speed_of_movep_joints_keep_their_limits(uneven: bool) -> None:
    given = program()
    rows = given.followed
    if uneven:
        # Rows as near together as where the tool turns while it moves.
        place = np.linspace(0.0, 1.0, len(rows))
        at = (len(rows) - 1) * (place - 0.12 * np.sin(6 * np.pi * place) / np.pi)
        rows = np.asarray(make_interp_spline(np.arange(len(rows)), rows, k=5)(at))
    speed, acceleration = steady(rows, shelf().arm.forward, given.limits)
    path = make_interp_spline(np.arange(len(rows)), rows, k=5)
    fine = np.linspace(0.0, len(rows) - 1.0, 200 * len(rows))
    way = arc_lengths(shelf().arm.forward(path(fine))[:, :3])
    period = 0.004
    joints = path(np.interp(np.arange(0.0, way[-1] / speed, period), way / speed, fine))
    limits = (given.limits.speed, given.limits.acceleration, given.limits.jerk)
    used = [float((np.abs(np.diff(joints, n=n, axis=0)) / period**n / most).max()) for n, most in enumerate(limits, 1)]
    assert max(used) <= 1.0
    assert max(*used, speed / given.limits.tool_speed) > 0.3, "no slower than it has to be"
    assert acceleration > 0.0


def test_movep_blends_over_at_most_half_of_either_line_and_follows_the_path(tmp_path: Path) -> None:
    given = program()
    write_movep(tmp_path / "program.script", given)
    assert "The controller times movep by itself" in (tmp_path / "program.script").read_text()
    start, places, blends = read_movep(tmp_path / "program.script")
    corners = np.vstack([transforms(start[None])[0, :3, 3], places[:, :3]])
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    assert (blends[:-1] <= 0.5 * np.minimum(lengths[1:], lengths[:-1])).all()
    assert blends[-1] == 0
    # A blend touches both lines at its radius from the corner.
    points = [corners[0]]
    for before, corner, after, blend in zip(corners, corners[1:], corners[2:], blends, strict=False):
        enter, leave = (corner + blend * (to - corner) / np.linalg.norm(to - corner) for to in (before, after))
        share = np.linspace(0.0, 1.0, 9)[:, None]
        points += list((1 - share) ** 2 * enter + 2 * share * (1 - share) * corner + share**2 * leave)
    points.append(corners[-1])
    fine = SmoothPath.along(points, 1e-4).points
    assert hausdorff(fine, finer(given.smooth[:, pose.POSITION])) < 1e-3
    turned = pose.from_rotation_vector(places[:, 3:])
    apart = pose.angle_of(pose.multiply(pose.conjugate(given.smooth[0, pose.QUATERNION]), turned))
    assert np.degrees(apart).max() < 0.2


def test_smoothing_keeps_both_ends_and_every_pose_within_tolerance() -> None:
    rng = np.random.default_rng(3)
    steps = 0.002 * np.eye(3)[rng.integers(0, 3, 200)]
    turns = 0.02 * rng.integers(0, 2, (200, 1)) * np.array([0.0, 0.6, 0.8])
    stairs = pose.make(np.cumsum(steps, axis=0), pose.from_rotation_vector(np.cumsum(turns, axis=0)))
    smooth = smoothed(stairs, 0.003, 0.03)
    np.testing.assert_array_equal(smooth[[0, -1]], stairs[[0, -1]])
    assert pose.position_distance(smooth, stairs).max() <= 0.003
    assert pose.rotation_distance(smooth, stairs).max() <= 0.03
    bend = [np.linalg.norm(np.diff(rows[:, pose.POSITION], n=2, axis=0), axis=1).mean() for rows in (smooth, stairs)]
    assert bend[0] < 0.1 * bend[1]


@pytest.mark.parametrize(
    ("fields", "bound"),
    [
        ({"tool_speed_m_s": 0.02}, "tool_speed"),
        ({"jerk_rad_s3": 2.0}, "jerk"),
        ({"speed_share": 0.02}, "speed"),
        ({"acceleration_rad_s2": 0.1}, "acceleration"),
    ],
)
def test_the_tightest_limit_is_used_and_none_is_broken(fields: dict[str, Any], bound: str) -> None:
    given = made(shelf(), **fields)
    used = {name: float(shares.max()) for name, shares in given.motion.used(given.limits).items()}
    assert max(used.values()) <= 1.0
    assert used[bound] == max(used.values()) > 0.9
    assert given.motion.times[-1] > program().motion.times[-1]


def test_a_known_motion_takes_hardly_more_than_its_least_time() -> None:
    # One joint turns by 1 rad at most 0.5 rad/s, 2 rad/s², 20 rad/s³: 1/0.5 + 0.5/2 + 2/20 s.
    joints = np.zeros((101, 6))
    joints[:, 0] = np.linspace(0.0, 1.0, 101)
    limits = Limits(np.full(6, 0.5), np.full(6, 2.0), np.full(6, 20.0), 10.0)
    motion = timed(joints, shelf().arm.forward, limits, 0.004)
    assert 2.35 <= motion.times[-1] < 1.3 * 2.35
    assert max(float(shares.max()) for shares in motion.used(limits).values()) <= 1.0


def test_a_motion_shorter_than_a_period_is_its_ends() -> None:
    joints = np.zeros((3, 6))
    joints[:, 0] = [0.0, 0.001, 0.002]
    limits = Limits(np.full(6, 3.0), np.full(6, 40.0), np.full(6, 5000.0), 10.0)
    motion = timed(joints, shelf().arm.forward, limits, 0.1)
    np.testing.assert_allclose(motion.joints[[0, -1], 0], [0.0, 0.002], atol=1e-12)
    assert max(float(shares.max()) for shares in motion.used(limits).values()) <= 1.0


def test_what_cannot_be_played_is_refused_with_place_and_reason() -> None:
    with pytest.raises(
        WorkFailedError, match=r"must reach the goal from \[0.53, -0.2, 0.4\] m, found step_limit after 5"
    ):
        make_program(shelf(), policy, SETTINGS, 5)
    with pytest.raises(WorkFailedError, match=r"start at \[0.53, -0.2, -0.9\] m must be free, found"):
        made(shelf(), start=(0.53, -0.2, -0.9, 0.70710678, 0.0, 0.70710678, 0.0))
    with pytest.raises(WorkFailedError, match=r"within program.tracking_m = 1e-06 m .* found .* s of dynamics at \["):
        made(shelf(), tracking_m=1e-6)
    with pytest.raises(WorkFailedError, match=r"rule must hold .* found it broken after 0.000 s at"):
        made(tilted(), start="nominal")


def tilted() -> Workcell:
    """Return the shelf with a rule that nothing keeps, though the policy's steps are not told of it."""
    cell = shelf()

    class Strict(ShelfTask):
        def rule_broken(self, poses: Array) -> np.ndarray:
            # The motion is longer than one step of one episode.
            return np.full(len(poses), len(poses) > 1)

    return replace(
        cell, task=Strict.model_validate({name: getattr(cell.task, name) for name in type(cell.task).model_fields})
    )


def test_a_contact_on_the_way_is_refused_by_the_names_of_what_touches() -> None:
    cell = shelf()
    builder = SceneBuilder(cell.arm)
    cell.task.furnish(builder)
    middle = program().motion.joints[len(program().motion.joints) // 2]
    bottle = pose.compose(cell.arm.forward(middle), pose.make([0.0, 0.0, 0.15], [1.0, 0.0, 0.0, 0.0]))
    builder.furniture_box("pillar", bottle[:3].tolist(), (0.01, 0.01, 0.01), (1.0, 0.0, 0.0, 1.0))
    scene = builder.build()
    free = cell.reachability
    # The learned path knows nothing of the pillar; the check does.
    blind = replace(cell, scene=scene, reachability=Reachability(free.arm, free.scene, free.posture))
    with pytest.raises(WorkFailedError, match=r"nothing may touch, found .*pillar.* after \d.\d+ s at \["):
        made(blind)


def test_a_start_beyond_a_joints_range_is_bad_input() -> None:
    with pytest.raises(BadInputError, match=r"shoulder_pan_joint must lie within -6\.2832…6\.2832 rad, found 7"):
        made(shelf(), start=(7.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(BadInputError, match="quaternion must have length 1"):
        made(shelf(), start=(0.5, 0.0, 0.4, 2.0, 0.0, 0.0, 0.0))


def free_shelf() -> Workcell:
    """The shelf's task with nothing around the arm."""
    cell = shelf()
    scene = SceneBuilder(cell.arm).build()
    return replace(cell, scene=scene, reachability=Reachability(cell.arm, scene))


def test_the_program_is_made_where_demonstrations_were_recorded() -> None:
    free = free_shelf()
    placement = Placement(np.array([0.03, -0.05, 0.02]), 0.3)
    here, there = made(free), made(free, placement)
    np.testing.assert_allclose(placement.poses(there.motion.poses)[0], here.motion.poses[0], atol=1e-9)
    np.testing.assert_allclose(placement.poses(there.learned), here.learned, atol=1e-9)
    np.testing.assert_allclose(free.arm.forward(there.motion.joints), there.motion.poses, atol=1e-12)


def test_other_files_hold_the_same_samples(tmp_path: Path) -> None:
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    stores = pytest.importorskip("rosbags.typesys")
    given = program()
    write_rtde(tmp_path / "rtde.csv", given)
    table = np.genfromtxt(tmp_path / "rtde.csv", names=True)
    joints = np.stack([table[f"target_q_{index}"] for index in range(6)], axis=1)
    np.testing.assert_allclose(joints, given.motion.joints, atol=1e-9)
    for name, values in (("target_qd", given.motion.velocities), ("target_qdd", given.motion.accelerations)):
        told_values = np.stack([table[f"{name}_{index}"] for index in range(6)], axis=1)
        np.testing.assert_allclose(told_values, values, atol=1e-9)
    tool = np.stack([table[f"target_TCP_pose_{index}"] for index in range(6)], axis=1)
    there = pose.make(tool[:, :3], pose.from_rotation_vector(tool[:, 3:]))
    assert pose.position_distance(there, given.motion.poses).max() < 1e-8
    assert pose.rotation_distance(there, given.motion.poses).max() < 1e-8
    write_bag(tmp_path / "bag", given)
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    with rosbag2.Reader(tmp_path / "bag") as bag:
        told: dict[str, list[object]] = {}
        for connection, _, data in bag.messages():
            told.setdefault(connection.topic, []).append(store.deserialize_cdr(data, connection.msgtype))
    found = [state.position for state in told["/joint_states"]]  # type: ignore[attr-defined]  # a ROS message
    np.testing.assert_array_equal(found, given.motion.joints)
    assert len(told["/tool0_pose"]) == len(given.motion.joints)
    (message,) = told["/joint_trajectory"]
    assert len(message.points) == len(given.motion.joints)  # type: ignore[attr-defined]
    with pytest.raises(BadInputError, match="bag must be new"):
        write_bag(tmp_path / "bag", given)


def test_leaving_a_program_where_it_was_learned_is_advised_where_it_cannot_be_moved_back() -> None:
    far = Placement(np.array([0.0, -2.0, 0.0]), 0.0)
    with pytest.raises(WorkFailedError, match=r"follow the smoothed path.*; program\.frame=placed leaves it"):
        made(free_shelf(), far)
    with pytest.raises(WorkFailedError, match="must reach the goal") as error:
        make_program(free_shelf(), lambda poses, starts: np.full(len(poses), 4), settings(), STEP_LIMIT, far)
    assert "placed" not in str(error.value)


def test_the_command_writes_every_file_it_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, out = tmp_path / "run", tmp_path / "out"
    write_hdf5(run / "demos.hdf5", as_demonstrations("shelf", [program().learned]))
    (run / "train.json").write_text(f'{{"step_limit": {STEP_LIMIT}}}')
    (run / "policy.safetensors").write_bytes(b"any")
    monkeypatch.setattr("koopdqn.app.commands.trained.read_policy", lambda path, task, anywhere: (policy, {}))
    monkeypatch.setattr("koopdqn.app.commands.trained.around", lambda policy, model: policy)
    monkeypatch.setattr("koopdqn.app.commands.trained.read_intent", lambda path, task: taught())
    person = "{position_m: [1.5, 0, 0.3], radius_m: 0.3, speed_m_s: 1.6, reaction_s: 0.1, stopping_s: 0.3,"
    person += "stopping_m: 0.05, intrusion_m: 0, person_error_m: 0, arm_error_m: 0, arm_radius_m: 0.08, tool_m: 0.2}"
    config = load_config(
        "program.urscript=movep", "program.formats=[urscript,rtde,robomimic]", f"guard.person={person}"
    )
    with monkeypatch.context() as patch:
        refusing = MagicMock(side_effect=WorkFailedError("no"))
        patch.setitem(command._WRITERS, "robomimic", ("program.hdf5", refusing))
        with pytest.raises(WorkFailedError):
            export_program(config, run, out)
        assert not list(out.iterdir()), "what was written before is not left behind"
    result = export_program(config, run, out)
    report = ProgramFile.model_validate_json((out / "program.json").read_text())
    assert report.model_dump(mode="json") == result.result
    assert report.files == {"urscript": "program.script", "rtde": "rtde.csv", "robomimic": "program.hdf5"}
    assert (out / "program.png").stat().st_size > 10_000
    assert all((out / file).is_file() for file in report.files.values())
    assert "movep(" in (out / "program.script").read_text()
    (item,) = read_hdf5(out / "program.hdf5").items
    assert item.joints is not None
    np.testing.assert_allclose(item.joints, program().motion.joints)
    assert report.samples == len(item)
    assert report.smoothing_mm <= 2.0
    assert report.separation is not None
    assert report.separation.margin_m == report.separation.distance_m - report.separation.required_m


def test_formats_are_named_once(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"must name each format once, found \[rtde, urscript, rtde\]"):
        export_program(load_config("program.formats=[rtde,urscript,rtde]"), tmp_path, tmp_path / "out")


@pytest.mark.parametrize("name", ["UR5\ntextmsg(1)", "a\u2028b", "", "\x85"])
def test_the_name_of_an_arm_is_no_line_of_a_program(name: str) -> None:
    arm = shelf().arm
    assert isinstance(arm, URArm)
    with pytest.raises(ValueError, match="name"):
        URArm.model_validate({**described(arm), "name": name})
