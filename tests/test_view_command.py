"""``koopdqn view`` on the command line: of a run, of demonstrations before any training, and what it refuses."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from small_run import SMALL

from koopdqn.app import cli
from koopdqn.app.api import load_config
from koopdqn.app.commands import view
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5
from koopdqn.errors import BadInputError
from koopdqn.view.page import Shown


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped long before it could learn."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    assert cli.main(["train", *SMALL, "train.max_steps=2000", f"out={folder}"]) == 1
    return folder


def baked(page: Path) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="baked">(.*?)</script>', page.read_text(encoding="utf-8"))
    assert found
    content: dict[str, Any] = json.loads(found[1])
    return content


def test_a_run_is_shown_with_its_starts_and_demonstrations(run: Path, tmp_path: Path) -> None:
    assert cli.main(["view", f"run={run}", "view.starts=2", f"out={tmp_path}/page"]) == 0
    content = baked(tmp_path / "page" / "view.html")
    kinds = [motion["kind"] for motion in content["motions"]]
    assert kinds == ["learned", "intent"] * 2 + ["demonstration"] * 3
    assert len(content["tracks"]) == 3
    assert content["trust"]["faces"]
    assert {geom["name"] for geom in content["scene"]["geoms"]} >= {"bottle_body", "floor"}


def test_a_film_chooses_among_all_demonstrations(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    film = MagicMock()
    monkeypatch.setattr("koopdqn.app.commands.pipeline.film", film)
    monkeypatch.setattr(view, "_FOLLOWED", 1)
    assert cli.main(["view", f"run={run}", "view.starts=1", f"video={tmp_path}/a.gif", f"out={tmp_path}/page"]) == 0
    assert len(film.call_args.args[3]) == 3


def test_the_trust_shown_has_what_answers_added(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    feedback, trusts = MagicMock(), []
    monkeypatch.setattr(view, "feedback_of", lambda *_: feedback)
    monkeypatch.setattr(view, "learned_motions", lambda *_, **__: [])
    monkeypatch.setattr(view, "write_page", lambda folder, _: folder)
    monkeypatch.setattr(Shown, "content", lambda self: trusts.append(self.trust))
    assert cli.main(["view", f"run={run}", f"out={tmp_path}/page", "--json"]) == 0
    assert trusts == [feedback.reward.trust.drawn.return_value]


def test_demonstrations_are_shown_in_the_scene_of_their_own_task(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["view", f"demos={run}/demos.hdf5", f"out={tmp_path}/page", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == {
        "page": str(tmp_path / "page" / "view.html"),
        "video": None,
        "run": None,
        "motions": [
            {"name": f"demonstration {index}", "kind": "demonstration", "remark": "the arm follows to its end"}
            for index in range(3)
        ],
    }
    content = baked(tmp_path / "page" / "view.html")
    assert content["trust"] is None
    assert "bottle_body" in {geom["name"] for geom in content["scene"]["geoms"]}


def test_recordings_of_no_known_task_are_shown_with_the_arm_alone(run: Path, tmp_path: Path) -> None:
    assert cli.main(["export", f"demos={run}/demos.hdf5", f"out={tmp_path}/csv"]) == 0
    assert cli.main(["view", f"demos={tmp_path}/csv/demos.csv", f"out={tmp_path}/page"]) == 0
    content = baked(tmp_path / "page" / "view.html")
    assert {geom["name"] for geom in content["scene"]["geoms"] if geom["link"] < 0} >= {"floor", "pedestal"}
    assert "bottle_body" not in {geom["name"] for geom in content["scene"]["geoms"]}
    assert all(len(motion["links"]) == len(motion["frames"]) for motion in content["motions"])


def test_the_task_that_a_file_names_is_an_option_and_nothing_else(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.yaml").write_text("name: evil\ntarget: evil.Task\n")
    (tmp_path / "evil.py").write_text("import pathlib\npathlib.Path('EXECUTED').touch()\n")
    monkeypatch.syspath_prepend(tmp_path)
    up = "../" * 20
    named = replace(read_hdf5(run / "demos.hdf5"), task=f"{up}{tmp_path.relative_to('/')}/evil")
    write_hdf5(tmp_path / "demos.hdf5", named)
    assert cli.main(["view", "demos=demos.hdf5", "out=page"]) == 0
    assert not (tmp_path / "EXECUTED").exists()


def test_recordings_out_of_reach_are_shown_without_the_arm(run: Path, tmp_path: Path) -> None:
    offset = np.array([3.0, 0, 0, 0, 0, 0, 0])
    far = [replace(item, poses=item.poses + offset) for item in read_hdf5(run / "demos.hdf5").items]
    write_csv(tmp_path / "far.csv", far)
    assert cli.main(["view", f"demos={tmp_path}/far.csv", f"out={tmp_path}/page"]) == 0
    motions = baked(tmp_path / "page" / "view.html")["motions"]
    assert [motion["links"] for motion in motions] == [[]] * len(far)
    assert all("follows 0 of" in motion["remark"] for motion in motions)


def test_the_task_of_a_file_is_as_large_as_the_arm_asks_for() -> None:
    given = ["task=demonstrated", "robot=ur10", "robot.task_scale=1.3", "out=unused"]
    config = Configuration.load(composed(given))
    task, unscaled = view._task_of(config, "shelf"), load_config("task=shelf").task
    assert task is not None
    np.testing.assert_allclose(task.goal[:3], 1.3 * unscaled.goal[:3])


def test_all_demonstrations_are_shown_as_recorded_where_they_are_moved(run: Path, tmp_path: Path) -> None:
    offset = np.array([0.3, 0, 0, 0, 0, 0, 0])
    far = [replace(item, poses=item.poses + offset, joints=None) for item in read_hdf5(run / "demos.hdf5").items]
    write_csv(tmp_path / "far.csv", far)
    given = ["view", "task=demonstrated", f"demos={tmp_path}/far.csv", "demos.place=auto", f"out={tmp_path}/page"]
    assert cli.main(given) == 0
    tracks = baked(tmp_path / "page" / "view.html")["tracks"]
    assert len(tracks) == len(far)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("run={run}", "demos={run}/demos.hdf5"), "demos: koopdqn view takes either run= or demos=, found both"),
        (("demos={run}/demos.hdf5", "video=film.gif"), "video: needs a trained run to show, found demos= alone"),
        (("run={run}", "video=film.avi"), "video: must end in .mp4 or .gif, found 'film.avi'"),
        (("run={run}", "video={run}/demos.png.gif"), "video: must name a new file"),
        (("run={run}", "view.starts=13"), "view.starts: must be less than or equal to 12, found 13"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    expected: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    (run / "demos.png.gif").touch()
    assert cli.main(["view", *(argument.format(run=run) for argument in arguments)]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert expected in error
    assert not list(tmp_path.rglob("view.html"))


def test_video_is_short_for_the_commands_own_key(run: Path) -> None:
    assert "view.video=film.gif" in prepare("view", [f"run={run}", "video=film.gif"]).overrides
    assert "eval.video=true" in prepare("eval", [f"run={run}", "video=true"]).overrides


def test_without_a_run_the_newest_one_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BadInputError, match="must name a trained run, found none given"):
        prepare("view", [])
