"""Runs of an experiment: what they do, how they go on, and what they came to."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from experiment_parts import SHA, Launcher, experiment, write
from helpers_shown import arc, recorded
from study_runs import Run, least_check

from koopdqn.demonstrations.hdf5 import read_hdf5, write_hdf5

PEOPLE = tuple(recorded(arc(offset)) for offset in (-0.02, 0.0, 0.02))


def run(root: Path, variant: str = "sign", seed: int = 1, case: str = "shelf") -> Run:
    return Run(experiment(), case, variant, seed, root, root / "people")


def held_out(root: Path) -> Run:
    train = ["demos={folder}/shown.hdf5", "task=demonstrated", "task.holdout=1", "seed=100"]
    values = {"finished": "finished", "placed": "result.placed", "dmp_mm": "result.hausdorff_mm.dmp"}
    values |= {"mm": "eval.holdout.hausdorff_mm.policy.0 or eval.path_deviation_mm.mean"}
    changed = {"people": True, "train": train, "cases": {}, "variants": {"default": {}}, "values": values}
    return Run(experiment(**changed, tables={}), "set", "default", 1, root, root, PEOPLE)


def test_a_run_trains_then_evaluates_and_is_not_made_again(tmp_path: Path) -> None:
    sign, launcher = run(tmp_path), Launcher()
    assert (sign.finished(), sign.results()) == (False, [])
    assert sign.carry_out(launcher) == ""
    train, measured = (tmp_path / "shelf" / "sign" / "1" / name for name in ("train", "eval"))
    assert launcher.calls == [
        ("train", ["task=shelf", "seed=1", "reward.shape=sign", f"out={train}"]),
        ("eval", [f"run={train}", "eval.seed=40", "eval.baselines=false", f"out={measured}"]),
    ]
    [result] = sign.results()
    assert (result.case, result.line, result.seed) == ("shelf", "sign", 1)
    expected = {"learned": True, "success_rate": 0.9, "deviation_mm": 5.0, "oracle_queries": 7, "demonstrations": SHA}
    assert result.values == expected
    assert sign.carry_out(launcher) == ""
    assert len(launcher.calls) == 2


@pytest.mark.parametrize(("name", "command"), [("wide", "eval"), ("dmp", "imitate")])
def test_what_shares_a_training_makes_it_if_it_is_missing(tmp_path: Path, name: str, command: str) -> None:
    sharing, default, launcher = run(tmp_path, name), run(tmp_path, "default"), Launcher()
    assert sharing.chain == default.chain != run(tmp_path).chain
    assert sharing.carry_out(launcher) == ""
    assert [called for called, _ in launcher.calls] == ["train", command]
    assert f"run={default.folder / 'train'}" in launcher.calls[1][1]
    assert default.carry_out(launcher) == ""
    assert [called for called, _ in launcher.calls][2:] == ["eval"]
    values = sharing.results()[0].values
    assert (values["success_rate"], values["demonstrations"]) == (0.9, SHA)
    # What only imitates has no verdict of its own.
    assert values["learned"] == (True if name == "wide" else None)


def test_baselines_are_lines_of_their_own_that_learned_nothing(tmp_path: Path) -> None:
    default = run(tmp_path, "default")
    default.carry_out(Launcher())
    policy, greedy = default.results()
    assert (policy.line, greedy.line) == ("default", "default/greedy")
    assert greedy.values == {**dict.fromkeys(policy.values), "success_rate": 0.9, "deviation_mm": 5.0}


def test_an_interrupted_training_goes_on_and_a_finished_one_is_only_evaluated(tmp_path: Path) -> None:
    sign, launcher = run(tmp_path), Launcher()
    train = sign.folder / "train"
    write(train / ".hydra" / "overrides.yaml", [*sign.training.arguments, "command=train", f"out={train}"])
    sign.carry_out(launcher)
    assert launcher.calls[0] == ("train", [f"run={train}"])
    (sign.folder / "eval" / "eval.json").unlink()
    sign.carry_out(launcher)
    assert [command for command, _ in launcher.calls] == ["train", "eval", "eval"]


def test_folders_that_have_moved_are_still_finished(tmp_path: Path) -> None:
    run(tmp_path / "before", "dmp").carry_out(Launcher())
    run(tmp_path / "before", "default").carry_out(Launcher())
    (tmp_path / "before").rename(tmp_path / "after")
    assert run(tmp_path / "after", "dmp").finished()
    assert run(tmp_path / "after", "default").finished()


@pytest.mark.parametrize("record", ["train", "eval"])
def test_what_was_made_with_other_settings_is_set_aside_and_made_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], record: str
) -> None:
    sharing, launcher = [run(tmp_path, name) for name in ("default", "dmp", "wide")], Launcher()
    for each in sharing:
        each.carry_out(launcher)
    path = sharing[0].folder / record / ".hydra" / "overrides.yaml"
    write(path, [*json.loads(path.read_text(encoding="utf-8")), "agent.gamma=0.7"])
    assert not sharing[0].finished()
    assert sharing[0].results() == []
    launcher.calls.clear()
    for each in sharing:
        each.carry_out(launcher)
    assert all(each.finished() for each in sharing)
    # Another training makes what was measured of the former one stale, too.
    made = ["train", "eval", "imitate", "eval"] if record == "train" else ["eval"]
    assert [command for command, _ in launcher.calls] == made
    former = path.parents[2 if record == "train" else 1]
    kept = former.with_name(f"{former.name}.former-1").rglob("overrides.yaml")
    assert any("agent.gamma=0.7" in each.read_text(encoding="utf-8") for each in kept)
    assert "is made anew" in capsys.readouterr().err


def test_imitating_with_other_settings_is_made_anew_and_without_any_it_is_taken(tmp_path: Path) -> None:
    dmp = run(tmp_path, "dmp")
    dmp.carry_out(Launcher())
    path = dmp.folder / "eval" / "imitation.json"
    about = json.loads(path.read_text(encoding="utf-8"))
    write(path, {**about, "settings": [*about["settings"], "eval.seed=41"]})
    assert not dmp.finished()
    del about["settings"]
    write(path, about)
    assert dmp.finished()


def test_a_training_that_does_not_learn_is_a_result_and_a_crash_is_told(tmp_path: Path) -> None:
    sign, other = run(tmp_path), run(tmp_path, seed=2)
    assert sign.carry_out(Launcher(train_status=1)) == ""
    assert sign.results()[0].values["learned"] is False
    told = other.carry_out(Launcher(train_status=2))
    assert told.startswith("shelf sign seed 2: train ended with exit status 2, see ")
    assert other.results() == []


def test_a_demonstration_is_held_out_and_primitives_of_the_others_are_measured_beside(tmp_path: Path) -> None:
    fold, launcher = held_out(tmp_path), Launcher()

    def launch(command: str, arguments: Sequence[str], output: Path) -> int:
        status = launcher(command, arguments, output)
        if command == "train":
            write_hdf5(fold.training.folder / "demos.hdf5", read_hdf5(fold.folder / "shown.hdf5"))
        return status

    assert fold.carry_out(launch) == ""
    shown = read_hdf5(fold.folder / "shown.hdf5")
    assert [item.poses[0, 2] for item in shown.items] == [PEOPLE[index].poses[0, 2] for index in (0, 2, 1)]
    values = fold.results()[0].values
    assert (values["finished"], values["placed"], values["mm"]) == (True, False, 31.0)
    assert 0.0 < values["dmp_mm"] < 5.0
    # What movement primitives came to is kept.
    (fold.training.folder / "demos.hdf5").unlink()
    assert fold.results()[0].values == values


def test_a_set_that_has_changed_is_measured_anew(tmp_path: Path) -> None:
    fold = held_out(tmp_path)
    fold.carry_out(Launcher())
    write(fold.folder / "result.json", {"placed": False, "hausdorff_mm": {"dmp": 1.0}})
    assert replace(fold, people=tuple(PEOPLE)).finished()
    changed = replace(fold, people=(*PEOPLE[:2], recorded(arc(0.03))))
    assert changed.settings != fold.settings
    assert not changed.finished()
    launcher = Launcher()
    changed.carry_out(launcher)
    assert [command for command, _ in launcher.calls] == ["train", "eval"]
    assert (fold.folder.with_name("held-out-1.former-1") / "result.json").is_file()
    np.testing.assert_array_equal(read_hdf5(changed.folder / "shown.hdf5").items[1].poses, arc(0.03))


def test_overrides_of_measurements_may_hold_the_seed(tmp_path: Path) -> None:
    measured = replace(run(tmp_path), experiment=experiment(measure=["eval.seed={seed}"])).measurement
    assert "eval.seed=1" in measured.arguments


def test_only_motions_that_the_arm_cannot_follow_are_moved(tmp_path: Path) -> None:
    fold, calls = held_out(tmp_path), []
    refused, good = Launcher(train_status=2), Launcher()

    def launch(command: str, arguments: Sequence[str], output: Path) -> int:
        calls.append((command, Path(arguments[-1]).name))
        moved = command == "eval" or "demos.place=auto" in arguments
        return (good if moved else refused)(command, arguments, output)

    assert fold.carry_out(launch) == ""
    assert calls == [("train", "run"), ("train", "placed"), ("eval", "eval")]
    write(fold.folder / "result.json", {"placed": True, "hausdorff_mm": {"dmp": 1.0}})
    assert fold.results()[0].values["placed"] is True
    assert fold.finished()
    calls.clear()
    (tmp_path / "crashed").mkdir()
    crashed = replace(fold, root=tmp_path / "crashed")
    crashed.carry_out(Launcher(train_status=3))
    assert not (crashed.folder / "placed").exists()
    assert [result.values["finished"] for result in crashed.results()] == [False]


def test_the_least_check_is_that_after_it_had_learned() -> None:
    checks = [{"env_steps": steps, "success_rate": rate} for steps, rate in ((1, 0.2), (2, 1.0), (3, 0.9), (4, 1.0))]
    assert least_check({"learned_at_env_steps": 2, "checks": checks}) == 0.9
    assert least_check({"learned_at_env_steps": 4, "checks": checks}) is None
    assert least_check({"learned_at_env_steps": None, "checks": checks}) is None
