"""The runner: which runs an experiment has, and what it writes."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import study
from experiment import load
from experiment_parts import CONTENT, PAGE, Launcher, experiment, write
from helpers_shown import arc, recorded
from study import Study, main, printed

from koopdqn.demonstrations.csv import write_csv
from koopdqn.errors import BadInputError, WorkFailedError


def begun(root: Path, **changed: Any) -> Study:
    page = root / "page.md"
    if not page.exists():
        page.write_text(PAGE, encoding="utf-8")
    return Study("small", experiment(page=str(page), **changed), root / "runs", root / "people")


def test_everything_is_measured_with_one_seed_before_the_next(tmp_path: Path) -> None:
    runs = begun(tmp_path, seeds=[2, 1]).runs
    assert [run.name for run in runs][:4] == [
        f"{case} {variant} seed 1" for variant in ("default", "sign") for case in ("shelf", "knife")
    ]
    assert [run.seed for run in runs] == sorted(run.seed for run in runs)
    assert len({run.folder for run in runs}) == len(runs)


def test_variants_may_have_seeds_and_cases_of_their_own() -> None:
    names = {run.name for run in Study("study", load("study"), Path("none")).runs}
    assert {"shelf always-ask seed 102", "shelf default seed 109", "shelf square seed 100"} <= names
    assert not {"shelf always-ask seed 103", "knife square seed 100", "shelf paper seed 100"} & names


def test_only_what_is_named_is_chosen(tmp_path: Path) -> None:
    small = begun(tmp_path)
    assert small.chosen(case=[], variant=[], seed=[]) == small.runs
    [only] = small.chosen(case=["knife"], variant=["sign"], seed=[2])
    assert only.name == "knife sign seed 2"
    with pytest.raises(BadInputError, match="unknown variant 'moon'; valid: default, dmp, sign, wide"):
        small.chosen(variant=["moon"])


def test_a_set_that_is_not_there_is_left_out_and_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "people" / "franka" / "plate.csv", "")
    cases = {name: {"train": ["task=demonstrated"], "file": f"franka/{name}.csv"} for name in ("plate", "pouring")}
    small = begun(tmp_path, cases=cases)
    assert {run.case for run in small.runs} == {"plate"}
    assert f"demos={tmp_path / 'people' / 'franka' / 'plate.csv'}" in small.runs[0].training.arguments
    assert "pouring is left out" in capsys.readouterr().err


def test_every_demonstration_of_every_set_of_people_is_held_out(tmp_path: Path) -> None:
    shown = [recorded(arc(offset)) for offset in (-0.02, 0.0, 0.02)]
    (tmp_path / "people" / "lab").mkdir(parents=True)
    write_csv(tmp_path / "people" / "lab" / "arc.csv", shown)
    runs = begun(tmp_path, people=True, cases={}, variants={"default": {}}).runs
    assert [run.name for run in runs] == [f"lab-arc held out {index}" for index in range(3)]
    assert runs[1].folder == tmp_path / "runs" / "lab-arc" / "held-out-1"


def test_the_tables_grow_run_by_run(tmp_path: Path) -> None:
    small, launcher = begun(tmp_path), Launcher()
    page, kept = tmp_path / "page.md", tmp_path / "runs" / "small.json"
    assert small.measure(small.runs[:1], launch=launcher) == 0
    assert re.findall(r"\| (.*?) \| 1 \|", page.read_text(encoding="utf-8")) == ["the default", "greedy on K"]
    rows = json.loads(kept.read_text(encoding="utf-8"))
    assert [row["variant"] for row in rows] == ["default", "default/greedy"]
    assert small.measure(small.runs[:3], launch=launcher) == 0
    assert [command for command, _ in launcher.calls] == ["train", "eval"] * 3
    rows = json.loads(kept.read_text(encoding="utf-8"))
    assert [(row["case"], row["variant"]) for row in rows] == [
        ("shelf", "default"),
        ("shelf", "default/greedy"),
        ("shelf", "sign"),
        ("knife", "default"),
        ("knife", "default/greedy"),
    ]
    assert rows[2]["settings"] == {
        "train": {"task": "shelf", "seed": "1", "reward.shape": "sign"},
        "eval": {"eval.seed": "40", "eval.baselines": "false"},
    }


def test_what_the_file_of_results_holds_is_not_measured_again(tmp_path: Path) -> None:
    results = {"results": str(tmp_path / "kept.json")}
    small, first = begun(tmp_path, **results), Launcher()
    small.measure(small.runs[:3], launch=first)
    page = (tmp_path / "page.md").read_text(encoding="utf-8")
    (tmp_path / "runs").rename(tmp_path / "lost")
    again, launcher = begun(tmp_path, **results), Launcher()
    again.write()
    assert (tmp_path / "page.md").read_text(encoding="utf-8") == page
    again.measure(again.runs[:4], launch=launcher)
    [training, _] = [arguments for _, arguments in launcher.calls]
    assert {"task=knife", "reward.shape=sign"} <= set(training)
    assert len(json.loads((tmp_path / "kept.json").read_text(encoding="utf-8"))) == 6
    # Other settings, baselines or values: what is held does not answer what is asked for now.
    for changed in (
        {"train": ["seed={seed}", "train.max_steps=5"]},
        {"variants": {"default": {"measure": ["eval.baselines=true"], "baselines": {"floor": "the floor"}}}},
        {"values": {**CONTENT["values"], "seconds": "train.seconds"}},
    ):
        other, launcher = begun(tmp_path, **results, **changed), Launcher()
        other.measure(other.runs[:1], launch=launcher)
        assert [command for command, _ in launcher.calls] == ["train", "eval"]
        (tmp_path / "runs").rename(tmp_path / f"lost-{len(list(tmp_path.iterdir()))}")


def test_what_was_begun_alone_is_gone_on_with(tmp_path: Path) -> None:
    values = {**CONTENT["values"], "finished": "finished"}
    changed: dict[str, Any] = {"results": str(tmp_path / "kept.json"), "values": values}
    small, launcher = begun(tmp_path, **changed), Launcher()
    [sign] = small.chosen(case=["shelf"], variant=["sign"], seed=[1])
    sign.folder.mkdir(parents=True)
    small.write()
    assert '"finished":false' in (tmp_path / "kept.json").read_text(encoding="utf-8").replace(" ", "")
    again = begun(tmp_path, **changed)
    again.measure([sign], launch=launcher)
    assert [command for command, _ in launcher.calls] == ["train", "eval"]


def test_people_without_any_motions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="--data: must hold sets of at least 3 demonstrations, found none below"):
        begun(tmp_path, people=True, cases={}, variants={"default": {}})


def test_results_of_motions_that_are_not_here_stay(tmp_path: Path) -> None:
    changed: dict[str, Any] = {
        "results": str(tmp_path / "kept.json"),
        "cases": {"shelf": {"train": ["task=shelf"]}, "plate": {"train": ["task=demonstrated"], "file": "plate.csv"}},
    }
    write(tmp_path / "people" / "plate.csv", "")
    small = begun(tmp_path, **changed)
    small.measure(small.chosen(variant=["default"], seed=[1]), launch=Launcher())
    page, kept = (tmp_path / name for name in ("page.md", "kept.json"))
    before = page.read_text(encoding="utf-8"), kept.read_text(encoding="utf-8")
    (tmp_path / "people").rename(tmp_path / "gone")
    (tmp_path / "runs").rename(tmp_path / "lost")
    again = begun(tmp_path, **changed)
    assert {run.case for run in again.runs} == {"shelf"}
    again.write()
    assert (page.read_text(encoding="utf-8"), kept.read_text(encoding="utf-8")) == before
    assert '"plate"' in before[1]


@pytest.mark.parametrize("content", ["[1]", '{"case": "shelf"}', '[{"case": "shelf"}]', "3", "[[]]"])
def test_results_that_are_none_are_bad_input(tmp_path: Path, content: str) -> None:
    (tmp_path / "kept.json").write_text(content, encoding="utf-8")
    with pytest.raises(BadInputError, match=r"kept\.json: must be results of an experiment"):
        begun(tmp_path, results=str(tmp_path / "kept.json"))


def test_kept_results_stand_beside_what_is_measured(tmp_path: Path) -> None:
    variants = {"default": {}, "paper": {"kept": {"shelf": [{"success_rate": 0.25}], "knife": [{"success_rate": 0.5}]}}}
    small = begun(tmp_path, variants=variants)
    small.measure(small.runs[:1], launch=Launcher())
    assert [(each.line, each.seed, each.values["success_rate"]) for each in small.results()] == [
        ("default", 1, 0.9),
        ("paper", None, 0.25),
    ]


def test_runs_that_learned_from_different_demonstrations_are_not_put_together(tmp_path: Path) -> None:
    small = begun(tmp_path)
    default, sign = small.chosen(case=["shelf"], variant=["default", "sign"], seed=[1])
    default.carry_out(Launcher())
    sign.carry_out(Launcher(demonstrations="1" * 64))
    with pytest.raises(BadInputError, match="same demonstrations with seed 1, found default and sign to differ"):
        small.results()
    own = begun(
        tmp_path, variants={"default": {}, "sign": {"train": ["reward.shape=sign"], "own_demonstrations": True}}
    )
    assert {each.line for each in own.results()} >= {"sign"}


def test_what_stands_beside_the_tables_is_written_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "page.md").write_text(PAGE + PAGE.replace("part", "here") + PAGE.replace("part", "demo"))
    commands, picture = [["doctor"]], "shelf/default/1/eval/eval.png"
    pictures = {str(tmp_path / "shelf.png"): picture, str(tmp_path / "none.png"): "not/made.png"}
    small = begun(tmp_path, printed={"demo": commands}, machine="here", pictures=pictures)
    write(tmp_path / "runs" / picture, "drawn")
    monkeypatch.setattr(study, "printed", lambda given: f"printed {list(given)}")
    small.finish("Measured here.")
    text = (tmp_path / "page.md").read_text(encoding="utf-8")
    assert "\n\nMeasured here.\n\n" in text
    assert "printed [['doctor']]" in text
    assert (tmp_path / "shelf.png").is_file()
    assert not (tmp_path / "none.png").exists()


def test_what_is_printed_is_standard_output_in_a_folder_of_its_own() -> None:
    text = printed([["demo", "--cfg", "job", "task=shelf"]])
    assert text.startswith("```text\n")
    assert "command: demo" in text
    assert text.endswith("```")
    with pytest.raises(WorkFailedError, match="koopdqn demo task=moon ended with exit status 2"):
        printed([["demo", "task=moon"]])


def test_a_page_that_cannot_be_written_is_found_out_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = tmp_path / "own.yaml"
    write(
        own, {**experiment().model_dump(mode="json"), "page": str(tmp_path / "none.md"), "folder": str(tmp_path / "r")}
    )
    assert main([str(own)]) == 2
    assert "none.md must be readable, the system says" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "r").iterdir()] == ["own.json"]


@pytest.mark.parametrize("given", ["0", "-1", "two", "1.5"])
def test_a_number_of_jobs_that_is_none_is_bad_input(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["study", f"--jobs={given}"])
    assert f"must be a whole number of at least 1, found {given}" in capsys.readouterr().err
