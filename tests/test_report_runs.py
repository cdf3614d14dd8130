import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from report_runs import knife_parts, write_evaluation, write_run

from koopdqn.app.commands.report import all_presets
from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.files import sha256_of
from koopdqn.intent.bend import Bend
from koopdqn.report.runs import DEFAULT, PAPER, find_runs, group_runs
from koopdqn.rl.policy import write_corrected

if TYPE_CHECKING:
    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.report.runs import Presets


@pytest.fixture(scope="module")
def presets() -> "Presets":
    return all_presets()


def test_finished_runs_are_found_with_what_shaped_them(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations"
) -> None:
    write_run(tmp_path / "a" / "train", parts, demonstrations, seed=3)
    write_run(tmp_path / "ablations" / "line", parts, demonstrations)
    unfinished = write_run(tmp_path / "b", parts, demonstrations)
    (unfinished / "policy.safetensors").unlink()
    [run], skipped = find_runs([tmp_path, tmp_path / "a"])
    assert (run.folder, run.seed, run.evaluation) == (tmp_path / "a" / "train", 3, None)
    assert run.task == parts.task
    assert run.arm == parts.arm
    assert skipped == []


def test_a_folder_of_ablations_is_searched_when_it_is_named(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations"
) -> None:
    folder = write_run(tmp_path / "ablations" / "line" / "0", parts, demonstrations)
    assert [run.folder for run in find_runs([tmp_path / "ablations"])[0]] == [folder]


def test_a_knife_task_comes_back_from_the_policys_metadata(tmp_path: Path, demonstrations: "Demonstrations") -> None:
    knife = knife_parts()
    write_run(tmp_path / "run", knife, demonstrations)
    [run], _ = find_runs([tmp_path])
    assert described(run.task) == described(knife.task)


@pytest.mark.parametrize("name", ["policy.safetensors", "train.json", "demos.hdf5"])
def test_a_damaged_run_is_left_out_with_the_reason(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations", name: str
) -> None:
    good, bad = (write_run(tmp_path / folder, parts, demonstrations) for folder in ("good", "bad"))
    if name == "demos.hdf5":
        (bad / name).unlink()
    else:
        (bad / name).write_bytes(b"{}")
    runs, [skipped] = find_runs([tmp_path])
    assert [run.folder for run in runs] == [good]
    assert skipped.folder == str(bad)
    assert name in skipped.reason


def test_a_run_has_the_newest_evaluation_that_names_it(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations"
) -> None:
    run = write_run(tmp_path / "runs" / "train", parts, demonstrations)
    write_run(tmp_path / "runs" / "other", parts, demonstrations)
    write_evaluation(tmp_path / "runs" / "old", parts, str(run), age=10)
    # As it was named from the folder above, wherever the report is made.
    newest = write_evaluation(tmp_path / "runs" / "new", parts, "runs/train", age=5)
    write_evaluation(tmp_path / "runs" / "foreign", parts, "runs/elsewhere", age=0)
    runs, _ = find_runs([tmp_path])
    assert {found.folder.name: found.evaluation_file for found in runs} == {"train": newest, "other": None}


def test_an_evaluation_among_obstacles_that_were_added_is_not_taken_for_the_runs(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations"
) -> None:
    run = write_run(tmp_path / "train", parts, demonstrations)
    own = write_evaluation(tmp_path / "own", parts, str(run), age=10)
    among = write_evaluation(tmp_path / "among", parts, str(run), age=5)
    among.write_text(json.dumps(json.loads(among.read_text()) | {"as_trained": False}))
    [found], _ = find_runs([tmp_path])
    assert found.evaluation_file == own


def test_an_evaluation_of_an_earlier_policy_is_not_taken_for_the_runs(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations"
) -> None:
    run = write_run(tmp_path / "train", parts, demonstrations)
    own = write_evaluation(tmp_path / "own", parts, str(run), age=10)
    policy = run / "policy.safetensors"
    own.write_text(json.dumps(json.loads(own.read_text()) | {"policy": sha256_of(policy)}))
    [found], _ = find_runs([tmp_path])
    assert found.evaluation_file == own
    other = write_evaluation(tmp_path / "other", parts, str(run), age=5)
    other.write_text(json.dumps(json.loads(other.read_text()) | {"policy": "0" * 64}))
    [found], _ = find_runs([tmp_path])
    assert found.evaluation_file == own
    policy.write_bytes(write_run(tmp_path / "another", parts, demonstrations, 7).joinpath(policy.name).read_bytes())
    shutil.rmtree(tmp_path / "another")
    [found], _ = find_runs([tmp_path])
    assert found.evaluation_file is None


def test_a_corrected_run_is_left_out(tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations") -> None:
    run = write_run(tmp_path / "train", parts, demonstrations)
    policy = run / "policy.safetensors"
    line = np.linspace([0.45, -0.2, 0.45], [0.38, -0.12, 0.47], 30)
    write_corrected(tmp_path / "corrected", policy, Bend.none(line))
    (tmp_path / "corrected").replace(policy)
    runs, [skipped] = find_runs([tmp_path])
    assert runs == []
    assert "corrected by hand" in skipped.reason


def test_an_evaluation_of_another_release_is_left_out_with_the_reason(
    tmp_path: Path, parts: "Parts", demonstrations: "Demonstrations"
) -> None:
    run = write_run(tmp_path / "train", parts, demonstrations)
    file = write_evaluation(tmp_path / "eval", parts, str(run))
    content = json.loads(file.read_text())
    del content["success_rate"]
    file.write_text(json.dumps(content))
    [found], [skipped] = find_runs([tmp_path])
    assert found.evaluation is None
    assert "success_rate" in skipped.reason


def test_a_folder_that_does_not_exist_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"report\.runs: must name folders that exist, found"):
        find_runs([tmp_path / "nowhere"])
    assert find_runs([tmp_path], elsewhere=[tmp_path / "nowhere"]) == ([], [])


def test_runs_are_grouped_by_preset_and_ordered_by_seed(
    tmp_path: Path, parts: "Parts", paper: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    for seed in (2, 0, 1):
        write_run(tmp_path / f"default{seed}", parts, demonstrations, seed)
    write_run(tmp_path / "paper", paper, demonstrations, 5)
    groups, left_out = group_runs(find_runs([tmp_path])[0], presets)
    assert {place: [run.seed for run in runs] for place, runs in groups.items()} == {
        ("shelf", DEFAULT): [0, 1, 2],
        ("shelf", PAPER): [5],
    }
    assert groups["shelf", DEFAULT][0].seed == 0
    assert left_out == []


def test_of_one_seed_the_evaluated_run_is_shown_and_else_the_newest(
    tmp_path: Path, parts: "Parts", paper: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    write_run(tmp_path / "old", parts, demonstrations, age=10)
    write_run(tmp_path / "new", parts, demonstrations, age=0)

    def shown() -> tuple[list[str], list[str]]:
        groups, left_out = group_runs(find_runs([tmp_path])[0], presets)
        return [run.folder.name for run in groups["shelf", DEFAULT]], [Path(item.folder).name for item in left_out]

    assert shown() == (["new"], ["old"])
    write_evaluation(tmp_path / "eval", parts, str(tmp_path / "old"))
    assert shown() == (["old"], ["new"])


def test_of_two_configurations_that_of_the_config_tree_is_shown_and_else_the_larger(
    tmp_path: Path, parts: "Parts", paper: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    def other(coverage: float) -> "Parts":
        return replace(parts, trust=parts.trust.model_copy(update={"coverage": coverage}))

    for seed in range(2):
        write_run(tmp_path / f"two{seed}", other(0.5), demonstrations, seed, age=10)
    write_run(tmp_path / "one", other(0.6), demonstrations)
    groups, left_out = group_runs(find_runs([tmp_path])[0], presets)
    assert [run.folder.name for run in groups["shelf", DEFAULT]] == ["two0", "two1"]
    assert [Path(item.folder).name for item in left_out] == ["one"]
    write_run(tmp_path / "present", parts, demonstrations, 4, age=20)
    groups, left_out = group_runs(find_runs([tmp_path])[0], presets)
    assert [run.folder.name for run in groups["shelf", DEFAULT]] == ["present"]
    assert len(left_out) == 3


def test_a_run_of_no_preset_is_left_out(
    tmp_path: Path, parts: "Parts", paper: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    write_run(tmp_path / "mixed", replace(parts, agent=paper.agent), demonstrations)
    groups, [left_out] = group_runs(find_runs([tmp_path])[0], presets)
    assert groups == {}
    assert "agent paper, intent pose" in left_out.reason


def test_a_run_that_someone_else_answered_is_left_out(
    tmp_path: Path, parts: "Parts", presets: "Presets", demonstrations: "Demonstrations"
) -> None:
    write_run(tmp_path / "noisy", parts, demonstrations)
    file = tmp_path / "noisy" / "train.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "oracle": "noisy"}))
    groups, [left_out] = group_runs(find_runs([tmp_path])[0], presets)
    assert groups == {}
    assert "oracle noisy" in left_out.reason
