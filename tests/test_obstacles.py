"""Obstacles: they stand in the scene with a clearance, and an intent is bent around them with the whole arm."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_shelf import PARTS, reward_of, shelf, taught
from parts import Clerk
from pydantic import ValidationError

from koopdqn import pose
from koopdqn.app import api, cli
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import Greedy
from koopdqn.intent import detour as planning
from koopdqn.intent.bend import Bend, BentIntent
from koopdqn.intent.detour import around_obstacles, detour
from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.base import Asking, Question
from koopdqn.rl.checks import History
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import Policy, PolicyAround
from koopdqn.settings import load_settings
from koopdqn.tasks.obstacles import Obstacle, hull_of_file, read_obstacles
from koopdqn.tasks.rollout import SUCCESS, Episode, roll_out
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import COLLISION, Workcell, build_scene, open_workcell

ON_THE_WAY = {"name": "lamp", "shape": "sphere", "center_m": (0.577, -0.085, 0.59), "radius_m": 0.03}
ASIDE = {**ON_THE_WAY, "center_m": (0.2, -0.6, 0.2)}
CUBE = [[x, y, z] for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (-0.03, 0.03)]


def _with(*obstacles: dict[str, Any]) -> Workcell:
    task = PARTS.task.model_copy(update={"obstacles": tuple(Obstacle.model_validate(each) for each in obstacles)})
    return open_workcell(task, PARTS.arm)


@cache
def _among() -> tuple[Workcell, IntentReward]:
    cell = _with(ON_THE_WAY)
    known = taught()
    return cell, around_obstacles(cell, reward_of(known), known.trajectories)


def _greedy(cell: Workcell, reward: IntentReward, *, unbent: bool = False) -> Episode:
    start = cell.task.nominal_start
    joints = cell.reachability.enter(start).joints
    assert joints is not None
    controller = Greedy(reward.model.unbent if unbent else reward.model, cell.task)
    return roll_out(controller, cell.task, cell.reachability, start[None], joints[None], 800)[0]


@pytest.mark.parametrize("asked", ["in an environment", "once the budget is spent"])
def test_the_scripted_person_would_go_around_obstacles(asked: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if asked == "in an environment":
        lamp = "{name: lamp, shape: sphere, center_m: [0.577, -0.085, 0.59], radius_m: 0.03}"
        config = api.load_config("task=shelf", "demo.count=3", f"++task.obstacles=[{lamp}]")
        shown = api.generate(config)
        fitted = api.fit(config, shown)
        parts = api.environment_parts(config, shown, fitted)
        # And a policy that was trained without obstacles is measured as it is led around them.
        measured: list[Any] = []
        monkeypatch.setattr(api, "evaluate_policy", lambda cell, policy, *rest, **named: measured.append(policy))
        policy = Policy(None, PARTS.task)  # type: ignore[arg-type]  # never asked
        api.evaluate(config, shown, fitted, api.Trained(policy, True, 0, 800, History()))
        assert isinstance(measured[0], PolicyAround)
        reward, feedback = parts.reward, Feedback(parts.reward, parts.oracle, PARTS.feedback)
    else:
        _, reward = _among()
        asking = Asking(budget=1, when_spent="scripted")
        feedback = Feedback(reward, Clerk(lambda question: False), PARTS.feedback, asking)
        feedback.questions = 1
    start = reward.task.nominal_start
    path = reward.model.intended_paths(start[None], 800, reward.task.step_m)[:, 0]
    said = []
    for row in range(0, len(path) - 1, 10):
        question = Question(0, row, path[row], start, 0, path[row + 1], path[row + 1], "far")
        said.append(feedback.ask(question, reward.evaluate_actions(path[[row]], np.array([row]), start[None]), 0).right)
    assert all(said)


@pytest.mark.parametrize(
    "shape",
    [
        {"shape": "box", "size_m": (0.06, 0.06, 0.06)},
        {"shape": "sphere", "radius_m": 0.03},
        {"shape": "cylinder", "radius_m": 0.03, "height_m": 0.06},
        {"shape": "mesh", "vertices_m": CUBE},
    ],
)
def test_what_is_nearer_than_the_clearance_touches(shape: dict[str, Any]) -> None:
    # The bottle hangs 0.15 m before the flange; the thing stands 0.03 m + gap behind its wall, along +x.
    start = PARTS.task.nominal_start
    joints = shelf().reachability.enter(start).joints
    assert joints is not None
    wall = start[0] + PARTS.task.grip_m + PARTS.task.bottle_radius_m
    for gap, touches in ((0.015, True), (0.025, False), (-0.005, True)):
        held = {"name": "thing", "center_m": (wall + gap + 0.03, start[1], start[2]), "clearance_m": 0.02, **shape}
        task = PARTS.task.model_copy(update={"obstacles": (Obstacle.model_validate(held),)})
        scene = build_scene(task, PARTS.arm)
        assert ("obstacle_thing" in scene.contact(joints)) == touches
        assert scene.rooms(joints, 0.05)[0] == pytest.approx(gap - 0.02, abs=1e-3)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"radius_m": None}, "must have radius_m, found none"),
        ({"height_m": 0.1}, "must have radius_m alone, found height_m"),
        ({"shape": "box", "radius_m": None, "size_m": (0.1, 0.0, 0.1)}, "size_m must be above 0"),
        ({"shape": "mesh", "radius_m": None, "vertices_m": CUBE[:3]}, "vertices_m must be 4 to 500 points, found 3"),
        (
            {"shape": "mesh", "radius_m": None, "vertices_m": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]},
            "vertices_m must not lie in one plane, found 4",
        ),
        ({"shape": "mesh", "radius_m": None, "file": "nowhere.stl"}, "found no file"),
        ({"shape": "mesh", "radius_m": None}, "a mesh must have file or vertices_m, found none"),
        ({"center_m": (577, -85, 590)}, "center_m\n.*must be in metres and within 100 m"),
        ({"radius_m": 30}, "radius_m\n.*less than or equal to 10"),
        ({"shape": "box", "radius_m": None, "size_m": (600, 60, 60)}, "size_m\n.*must be in metres and within 100 m"),
        ({"quaternion": (1.0, 1.0, 0.0, 0.0)}, "quaternion must have length 1"),
    ],
)
def test_an_obstacle_that_breaks_a_rule_is_refused(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ValidationError, match=said):
        Obstacle.model_validate({**ON_THE_WAY, **changed})


def test_a_floor_and_a_wall_may_be_farther_than_any_arm() -> None:
    floor = {"shape": "box", "radius_m": None, "size_m": (12.0, 12.0, 0.02), "center_m": (0.0, 0.0, -0.6)}
    wall = {"shape": "box", "radius_m": None, "size_m": (0.1, 20.0, 3.0), "center_m": (-11.0, 0.0, 1.5)}
    things = tuple(Obstacle.model_validate({**ON_THE_WAY, **each}) for each in (floor, {**wall, "name": "wall"}))
    build_scene(PARTS.task.model_copy(update={"obstacles": things}), PARTS.arm)


def test_a_mesh_file_becomes_the_corners_of_its_hull(tmp_path: Path) -> None:
    # Every face of the hull once, as fans of triangles.
    sides = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    faces = [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))]
    lines = [f"v {x + 0.2} {y} {z}" for x, y, z in CUBE] + [f"f {a} {b} {c}" for a, b, c in faces]
    (tmp_path / "cube.obj").write_text("\n".join(lines))
    (tmp_path / "scene.yaml").write_text("- {name: cube, shape: mesh, center_m: [0.5, 0.0, 0.5], file: cube.obj}")
    (found,) = read_obstacles(tmp_path / "scene.yaml")
    assert np.allclose(sorted(found.vertices_m or ()), sorted((x + 0.2, y, z) for x, y, z in CUBE), atol=1e-5)


def test_an_stl_file_in_text_is_read_as_any_other(tmp_path: Path) -> None:
    corners = [(0, 0, 0), (1e-1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)]
    facet = "facet normal 0 0 0\n outer loop\n{}\n endloop\nendfacet\n"
    faces = [[corners[i] for i in face] for face in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3))]
    text = "".join(facet.format("\n".join("  vertex {} {} {}".format(*p) for p in face)) for face in faces)
    (tmp_path / "wedge.stl").write_text(f"solid wedge\n{text}endsolid wedge\n")
    assert sorted(map(tuple, hull_of_file(tmp_path / "wedge.stl"))) == sorted(corners)
    (tmp_path / "flat.stl").write_text("solid flat\n" + facet.format("vertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0"))
    with pytest.raises(ValueError, match="do not lie in one plane"):
        hull_of_file(tmp_path / "flat.stl")
    for number, wrong in enumerate(("vertex 0 0", "vertex abc 0 1")):
        path = tmp_path / f"wrong{number}.stl"
        path.write_text("solid wrong\n" + facet.format(f"vertex 0 0 0\n{wrong}\nvertex 0 1 0"))
        with pytest.raises(ValueError, match=r"three numbers after every vertex, found others in .*wrong\d.stl"):
            hull_of_file(path)


def test_a_binary_stl_file_may_begin_as_one_in_text(tmp_path: Path) -> None:
    corners = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.1)], dtype="<f4")
    sides = [corners[list(face)] for face in ((0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3))]
    faces = [b"\0" * 12 + side.tobytes() + b"\0\0" for side in sides]
    head = b"solid facetiae".ljust(80, b" ") + len(faces).to_bytes(4, "little")
    (tmp_path / "wedge.stl").write_bytes(head + b"".join(faces))
    found = np.array(sorted(map(tuple, hull_of_file(tmp_path / "wedge.stl"))))
    np.testing.assert_allclose(found, np.array(sorted(map(tuple, corners.tolist()))), atol=1e-5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[{name: a, shape: sphere, center_m: [1, 1, 1], radius_m: 3e-2}]", ""),
        ("- &a {name: a, shape: sphere, center_m: [1, 1, 1], radius_m: 0.1}\n- *a\n", "two named a"),
        ("{name: a, shape: sphere, center_m: [1, 1, 1], radius: 0.1}", "must be a list, each item .*found {'name'"),
        (
            "[{name: a, shape: sphere, center_m: [1, 1, 1], radius: 0.1}]",
            "radius; valid: .*clearance_m, file, ",
        ),
        ("hello", "must be a list, each item a group of keys, found {'hello'"),
        ("5", "must be YAML"),
        ("", "must be a list, each item a group of keys, found nothing in it"),
        ("obstacles: ${a}", "must be a list"),
        ("a: [", "must be YAML"),
    ],
)
def test_what_a_file_of_obstacles_may_hold(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "scene.yaml").write_text(text)
    if not said:
        assert read_obstacles(tmp_path / "scene.yaml")[0].radius_m == 0.03
        return
    with pytest.raises(BadInputError, match=said):
        read_obstacles(tmp_path / "scene.yaml")


def test_a_goal_does_not_move_where_obstacles_stand(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text("[{name: a, shape: sphere, center_m: [1, 1, 1], radius_m: 0.1}]")
    given = ["task=demonstrated", "task.goal_half_range_m=[0.05,0.05,0.05]", f"obstacles={tmp_path}/scene.yaml"]
    assert cli.main(["train", *given, "demos=none.csv", f"out={tmp_path}/run"]) == 2
    assert "goal_half_range_m must be null where obstacles stand still" in capsys.readouterr().err


def test_a_file_of_obstacles_becomes_part_of_the_task(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(
        "obstacles:\n- {name: lamp, shape: sphere, center_m: [0.577, -0.085, 0.59], radius_m: 0.03}\n"
    )
    overrides = prepare("train", [f"obstacles={tmp_path / 'scene.yaml'}", "out=unused"]).overrides
    task = load_settings(composed(overrides).task, Task, "task")
    assert task.obstacles == (Obstacle.model_validate(ON_THE_WAY),)
    assert not any(str(tmp_path) in each for each in overrides)
    with pytest.raises(BadInputError, match="found no file"):
        prepare("train", ["obstacles=nowhere.yaml"])


def test_obstacles_on_the_command_line_leave_no_file_to_a_runs_record(tmp_path: Path) -> None:
    corners = "\n".join(f"v {x} {y} {z}" for x, y, z in CUBE)
    (tmp_path / "cube.obj").write_text(f"{corners}\nf 1 2 4\nf 5 7 8\nf 1 5 6\nf 3 4 8\nf 1 3 7\nf 2 6 8\n")
    node = f"name:'true',shape:mesh,center_m:[1,1,1],file:{tmp_path}/cube.obj"
    given = prepare("train", [f"++task.obstacles=[{{{node}}}]", "out=unused"]).overrides
    override = next(each for each in given if "obstacles" in each)
    assert str(tmp_path) not in override
    (found,) = load_settings(composed([override, "command=train", "out=unused"]).task, Task, "task").obstacles
    assert found.name == "true"
    assert len(found.vertices_m or ()) == 8
    plain = "task.obstacles=[{name:a,shape:sphere,center_m:[1,1,1],radius_m:0.1}]"
    assert plain in prepare("train", [plain, "out=unused"]).overrides


def test_a_task_without_obstacles_is_described_as_before_there_were_any() -> None:
    assert "obstacles" not in described(PARTS.task)
    assert described(_among()[0].task.without_obstacles()) == described(PARTS.task)


def test_nothing_is_bent_where_nothing_is_in_the_way() -> None:
    known = taught()
    starts = np.array([rows[0] for rows in known.trajectories])
    assert detour(_with(ASIDE), known.model, starts) is None
    reward = reward_of(known)
    assert around_obstacles(_with(ASIDE), reward, known.trajectories) is reward


def test_the_bent_path_is_clear_and_leads_back_to_the_demonstrated_one() -> None:
    cell, reward = _among()
    assert isinstance(reward.model, BentIntent)
    bend = reward.model.bend
    path = reward.model.intended_paths(cell.task.nominal_start[None], 1000, cell.task.step_m)[:, 0]
    joints, reason = cell.reachability.follow(path)
    assert reason == ""
    assert joints is not None
    assert min(cell.scene.rooms(each, 0.02)[0] for each in joints) > 0.01
    assert pose.norm(bend.offsets[[0, -1]]).max() == 0.0
    moved = np.flatnonzero(pose.norm(bend.offsets) > 0.005)
    # No more than a third of the path is left for one lamp.
    assert 0 < moved[-1] - moved[0] < len(bend.path) * 0.7
    assert cell.task.reached(path[-1:])[0]


def test_the_intent_alone_hits_what_the_bent_intent_goes_around() -> None:
    cell, reward = _among()
    assert _greedy(cell, reward, unbent=True).outcome == COLLISION
    assert _greedy(cell, reward).outcome == SUCCESS


def test_a_state_on_the_bent_path_is_trusted_as_the_one_on_the_path_was() -> None:
    _, reward = _among()
    known = taught()
    (bent,) = reward.model.placed(known.trajectories[:1])
    steps = np.arange(len(bent))
    was = known.trust.contains(known.trajectories[0], steps)
    assert (reward.trust.contains(bent, steps) == was).mean() > 0.95
    assert was.mean() > 0.9


def test_the_path_that_is_kept_clear_is_told_in_the_start_frame() -> None:
    cell, model = shelf(), taught().model
    start, goal = cell.task.nominal_start, cell.task.goal
    # The frame's own start is another, as where paths are regressed on their starts.
    framed = model.within(StartFrame(start[:3] + np.array([0.0, 0.02, 0.0]), goal[:3], follows=True))
    grid = planning._Grid.along(cell, framed, start[None])
    path = framed.intended_paths(start[None], 2000, cell.task.step_m)[:, 0]
    back = framed.start_frame.from_frame(grid.poses, start[None], grid.poses)
    assert np.linalg.norm(back[:, None, :3] - path[None, :, :3], axis=2).min(axis=1).max() < 0.002


def test_a_bent_path_that_the_arm_cannot_follow_is_no_way() -> None:
    grid = planning._Grid.along(shelf(), taught().model, shelf().task.nominal_start[None])
    path = Bend.none(grid.poses[:, pose.POSITION])
    lifted = np.sin(np.linspace(0.0, np.pi, len(path.path)))[:, None] * np.array([0.0, 0.0, 0.2])
    assert grid.refused(path) is None
    refused = grid.refused(Bend(path.path, lifted))
    assert refused is not None
    assert 0.0 < refused < 1.0


def test_a_way_that_the_arm_cannot_follow_is_given_up_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    known, cell = taught(), _with(ON_THE_WAY)
    starts = np.array([rows[0] for rows in known.trajectories])
    first = detour(cell, known.model, starts)
    assert first is not None
    share = float(pose.norm(first.offsets).argmax()) / (len(first.path) - 1)
    middle = first.offsets[round(share * (len(first.path) - 1))]
    refused = planning._Grid.refused

    def unlike_the_first(grid: planning._Grid, bend: Bend) -> float | None:
        near = np.linalg.norm(bend.offsets[round(share * (len(bend.path) - 1))] - middle) < 0.01
        return share if near else refused(grid, bend)

    monkeypatch.setattr(planning._Grid, "refused", unlike_the_first)
    second = detour(cell, known.model, starts)
    assert second is not None
    assert np.linalg.norm(second.offsets[round(share * (len(second.path) - 1))] - middle) >= 0.01


def test_obstacles_that_leave_no_way_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning, "_REACHES", ((2, 0.05, 0.05),))
    known = taught()
    wall = {**ON_THE_WAY, "shape": "box", "radius_m": None, "size_m": (0.3, 0.02, 0.5), "center_m": (0.6, -0.09, 0.6)}
    with pytest.raises(BadInputError, match=r"must leave a way around within 0\.025 m"):
        around_obstacles(_with(wall), reward_of(known), known.trajectories)


@pytest.mark.parametrize(
    "held",
    [
        "- &x {name: a, b: *x}\n",
        "a: &a [1, 1, 1, 1]\n"
        + "".join(
            f"{two}: &{two} [{', '.join([f'*{one}'] * 9)}]\n" for one, two in zip("abcdefgh", "bcdefghi", strict=True)
        ),
        "[" * 50_000,
    ],
)
def test_aliases_that_stand_for_more_than_memory_holds_are_refused(tmp_path: Path, held: str) -> None:
    (tmp_path / "scene.yaml").write_text(held)
    with pytest.raises(BadInputError, match=r"must hold at most 100000 items|must be YAML, found maximum recursion"):
        read_obstacles(tmp_path / "scene.yaml")
