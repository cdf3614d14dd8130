"""What `koopdqn explain` shows: the step that tells most, and what is known of the ten actions there."""

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_shelf import reward_of, shelf, taught
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from parts import straight_poses
from small_run import SMALL

from koopdqn import console, pose
from koopdqn.app import cli
from koopdqn.app.api import load_config
from koopdqn.app.commands import explain
from koopdqn.app.hydra.overrides import prepare
from koopdqn.intent.bend import Bend
from koopdqn.intent.reward import ActionEvaluation
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import write_corrected
from koopdqn.tasks.rollout import RULE_BROKEN, STEP_LIMIT, STUCK, SUCCESS, Episode
from koopdqn.view.explain import Walk, _why, left_at, telling_step
from koopdqn.view.schema import ExplainFile, ExplainSettings

COUNT = 30


def walk(outcome: str, off: Array, detail: str = "", poses: Array | None = None) -> Walk:
    """A path beside a straight reference, ``off`` [steps] away at each pose; its chosen actions have reward 0.5."""
    task = shelf().task
    straight = straight_poses(task.nominal_start[:3], task.goal[:3], COUNT, task.goal[pose.QUATERNION])
    rewards, values = np.full((COUNT, 10), -0.5), np.zeros((COUNT, 10))
    rewards[:, 4], values[:, 4], values[:, 5] = 0.5, 1.0, 0.5
    parts = dict.fromkeys(ActionEvaluation.__dataclass_fields__, np.zeros(0)) | {"reward": rewards}
    evaluation = ActionEvaluation(**parts)
    path = straight if poses is None else poses
    episode = Episode(path, np.zeros((COUNT, 6)), outcome, detail)
    return Walk(episode, straight, "the line", evaluation, values, values.argmax(axis=1), off * task.step_m)


ON = np.zeros(COUNT)


def test_a_path_that_comes_back_has_not_left_and_one_that_stays_away_left_at_the_last_near_pose() -> None:
    off = ON.copy()
    off[5:9] = 20.0
    assert left_at(walk(STEP_LIMIT, off), shelf().task) is None
    off[15:] = 20.0
    gone = walk(STEP_LIMIT, off)
    assert left_at(gone, shelf().task) == 14
    assert telling_step(gone, shelf().task) == (14, "from here on the path stays more than 15 mm away from the line")
    assert left_at(walk(STEP_LIMIT, ON + 20.0), shelf().task) == 0


@pytest.mark.parametrize(
    ("outcome", "detail", "step", "why"),
    [
        ("collision", "bottle touches wall", 29, "the arm cannot carry out this action: collision bottle touches wall"),
        (RULE_BROKEN, "", 28, "this action breaks the rule of the task"),
        (STUCK, "", 28, "this action leaves the pose as it is"),
        (STEP_LIMIT, "", 29, "the step limit is reached 0 mm from the goal"),
    ],
)
def test_a_failure_on_the_path_is_explained_by_what_ends_it(outcome: str, detail: str, step: int, why: str) -> None:
    found, told = telling_step(walk(outcome, ON, detail), shelf().task)
    assert found == step
    assert told.startswith(why)


def test_a_path_in_circles_is_explained_where_the_circle_begins() -> None:
    task = shelf().task
    poses = straight_poses(task.nominal_start[:3], task.goal[:3], COUNT, task.goal[pose.QUATERNION])
    poses[20:] = poses[10:20]
    step, why = telling_step(walk(STEP_LIMIT, ON, poses=poses), task)
    assert (step, why) == (10, "10 steps later the path is here again, and goes in circles")


def test_a_success_is_explained_by_its_worst_action_or_else_by_its_closest_call() -> None:
    good = walk(SUCCESS, ON)
    good.values[12, 5] = 0.9
    assert telling_step(good, shelf().task)[0] == 12
    good.evaluation.reward[17, 4] = -0.25
    step, why = telling_step(good, shelf().task)
    assert step == 17
    assert "(-0.25)" in why


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped long before it could learn."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert cli.main(["train", *SMALL, "train.max_steps=2000", f"out={folder}"]) == 1
    return folder


def explained(run: Path, out: Path, capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    capsys.readouterr()
    assert cli.main(["explain", f"run={run}", "eval.episodes=12", *arguments, f"out={out}", "--json"]) == 0
    content: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert ExplainFile.model_validate(content).model_dump(mode="json") == content
    assert json.loads((out / "explain.json").read_text(encoding="utf-8")) == content
    assert (out / "explain.png").read_bytes().startswith(b"\x89PNG")
    return content


def test_without_a_start_the_first_failure_is_explained(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = explained(run, tmp_path / "a", capsys)
    assert content["outcome"] != SUCCESS
    assert content["step"] <= content["steps"]
    assert content["why_step"] != "it was asked for"
    for start in range(content["start"]):
        assert explained(run, tmp_path / f"b{start}", capsys, f"start={start}")["outcome"] == SUCCESS


def test_a_corrected_run_is_not_explained(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(run, tmp_path / "run")
    line = straight_poses(shelf().task.nominal_start[:3], shelf().task.goal[:3], COUNT, shelf().task.goal[3:])[:, :3]
    write_corrected(tmp_path / "run" / "policy.safetensors", run / "policy.safetensors", Bend.none(line))
    assert cli.main(["explain", f"run={tmp_path}/run", f"out={tmp_path}/out"]) == 2
    assert capsys.readouterr().err.endswith("found a policy led around a correction\n")


def test_a_step_of_a_path_is_explained(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = explained(run, tmp_path / "a", capsys, "start=1", "step=0")
    assert (content["start"], content["step"], content["why_step"]) == (1, 0, "it was asked for")
    actions = content["actions"]
    [chosen] = [action["number"] for action in actions if action["chosen"]]
    assert chosen == int(np.argmax([action["q"] for action in actions]))
    for action in actions:
        assert (action["off"] is None) == (action["source"] == "rule")
        if action["off"] is not None:
            assert (action["reward"] >= 0) == (action["off"] <= 1.0)
    step = shelf().task.step_m
    moved = np.array([action["reached"][:3] for action in actions]) - content["pose"][:3]
    axes = np.repeat(np.eye(3), 2, axis=0) * np.tile([[1.0], [-1.0]], (3, 1))
    np.testing.assert_allclose(moved[4:], step * axes, atol=1e-12)
    assert {content["outcome"], content["detail"], content["steps"]}.isdisjoint({None})
    # The same pose given by hand has the same actions.
    given = explained(run, tmp_path / "b", capsys, "start=1", f"pose={content['pose']}".replace(" ", ""))
    assert given["why_step"] == "the pose was given"
    assert given["start"] == 1
    assert {given[key] for key in ("outcome", "detail", "steps", "step", "left_at", "off_path_mm")} == {None}
    for one, other in zip(actions, given["actions"], strict=True):
        assert one["q"] == pytest.approx(other["q"], abs=1e-5)
        assert one["why"] == other["why"]


def test_a_given_pose_is_on_no_path(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    titles: list[str] = []
    told: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("koopdqn.plots.explain.plot_explanation", lambda path, title, *_, **tracks: titles.append(title))
        for name, turned in (("a", "1,0,0,0"), ("b", "0.6,0.8,0,0")):
            capsys.readouterr()
            console.out.cache_clear()
            place = f"pose=[0.5,-0.2,0.4,{turned}]"
            assert cli.main(["explain", f"run={run}", place, f"out={tmp_path}/{name}"]) == 0
            told.append(capsys.readouterr().out.partition("trusted")[0])
    for text in (*titles, *told):
        assert not any(word in text for word in ("step", "start", "path"))
    assert all("0.5000, -0.2000, 0.4000 m, quaternion 0.6000, 0.8000, 0.0000" in each[1] for each in (titles, told))
    assert len(set(titles)) == 2
    content = json.loads((tmp_path / "a" / "explain.json").read_text(encoding="utf-8"))
    assert content["start"] is None


def test_the_pictures_legend_names_every_sign_and_its_views_say_what_they_show(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []

    def keep(figure: Figure, path: Path, **_: object) -> None:
        drawn.append(figure)
        path.touch()

    monkeypatch.setattr(Figure, "savefig", keep)
    for argument in ("step=0", "pose=[0.5,-0.2,0.4,1,0,0,0]"):
        out = tmp_path / argument[:4]
        assert cli.main(["explain", f"run={run}", "start=0", argument, f"out={out}"]) == 0
    for figure, paths in zip(drawn, ({"learned", "compared with"}, set()), strict=True):
        views = figure.axes[:4]
        assert len({axes.get_title(loc="left") for axes in views}) == 4
        assert {axes.get_xlabel()[1:] for axes in views} | {axes.get_ylabel()[1:] for axes in views} == {" [m]"}
        [legend] = figure.legends
        named = {text.get_text() for text in legend.get_texts()}
        assert named & {"learned", "compared with"} == paths
        assert {"start region", "goal", "the state", "predicted"} <= named
        signs = [{str(line.get_marker()) for line in axes.lines} - {"None"} for axes in views]
        shown = {str(each.get_marker()) for each in legend.findobj(Line2D)} - {"None"}
        assert set().union(*signs) == shown == {"o", "*", "D"}
        # The goal's star is not the prediction's sign.
        assert all("*" not in near for near in signs[2:])


def test_people_are_told_in_a_table(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    console.out.cache_clear()
    assert cli.main(["explain", f"run={run}", "start=0", f"out={tmp_path}/a"]) == 0
    told = capsys.readouterr().out
    for part in ("path     start 0: ", "trusted  ", "9 -z", "explain.png"):
        assert part in told
    assert told.count(" > ") == 1


def test_a_pose_of_few_digits_is_of_length_1() -> None:
    pose = ExplainSettings(start=None, step=None, pose=(0.4, -0.2, 0.45, 0.707, 0.0, 0.707, 0.0)).pose
    assert pose is not None
    assert pose[:3] == (0.4, -0.2, 0.45)
    assert math.hypot(*pose[3:]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("start=12", "explain.start: must be below eval.episodes (12), found 12"),
        ("step=100000", "explain.step: must be at most"),
        ("pose=[0,0,0,1,1,0,0]", "explain.pose: must have a quaternion of length 1 within 0.001, found 1.41421"),
        ("pose=[5,-0.2,0.45,1,0,0,0]", "explain.pose: must be one that the arm can take, found it unreachable"),
        ("pose=[0,0,0]", "explain.pose: must be a list of 7 numbers"),
    ],
)
def test_what_cannot_be_explained_is_refused_in_one_line(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], argument: str, expected: str
) -> None:
    assert cli.main(["explain", f"run={run}", "eval.episodes=12", argument, f"out={tmp_path}/a"]) == 2
    assert expected in capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.parametrize(("outcome", "left_out"), [(SUCCESS, 1), (STUCK, 1), (RULE_BROKEN, 1), (STEP_LIMIT, 0)])
def test_a_pose_from_which_no_action_follows_is_not_explained(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    outcome: str,
    left_out: int,
) -> None:
    found = explain._episode

    def ended(*given: Any) -> tuple[int, Episode]:
        number, episode = found(*given)
        return number, replace(episode, outcome=outcome)

    monkeypatch.setattr(explain, "_episode", ended)
    last = explained(run, tmp_path / "a", capsys, "start=1")["steps"] - left_out
    assert explained(run, tmp_path / "b", capsys, "start=1", f"step={last}")["step"] == last
    assert cli.main(["explain", f"run={run}", "start=1", f"step={last + 1}", f"out={tmp_path}/c"]) == 2
    assert f"must be at most {last}, the last step of this path, found {last + 1}" in capsys.readouterr().err


def test_its_own_keys_need_no_prefix_and_those_of_others_stay(run: Path) -> None:
    own = prepare("explain", [f"run={run}", "start=1", "step=2"]).overrides
    assert {"explain.start=1", "explain.step=2"} <= set(own)
    assert "program.start=nominal" in prepare("export", [f"run={run}", "start=nominal"]).overrides


def test_what_was_named_as_better_is_told_as_a_yes() -> None:
    feedback = Feedback(reward_of(taught()), ScriptedOracle(shelf().task), load_config().feedback)
    # Where nothing is trusted.
    here = shelf().task.nominal_start[None] + np.array([0.0, 0.0, 0.15, 0.0, 0.0, 0.0, 0.0])
    found = feedback.evaluate_actions(here, np.zeros(1, dtype=np.int64), here)
    # "No, +y would have been right" is remembered as two answers of one number.
    for action, right in ((4, False), (6, True)):
        margin, reached = float(found.margin[0, action]), found.local_reached[0, action]
        feedback.answers.add(7, found.local[0], action, reached, right=right, margin=margin, expected=False)
    found = feedback.evaluate_actions(here, np.zeros(1, dtype=np.int64), here)
    told = [_why(found, 0, action, feedback, taught().trajectories) for action in (4, 6)]
    assert "answer 7 said no to +x" in told[0]
    assert "answer 7 said yes to +y" in told[1]
