import statistics
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from report_runs import train_report, write_evaluation, write_swept

from koopdqn.errors import BadInputError
from koopdqn.evaluation.results import QUANTITIES, find_sweep, variants
from koopdqn.files import write_json

if TYPE_CHECKING:
    from parts import Parts


@pytest.fixture
def sweep(tmp_path: Path, parts: "Parts") -> Path:
    """Two variants of the shelf with two seeds each, one run of which is unfinished and one failed."""
    for job, (seed, intent) in enumerate([(0, "pose"), (1, "pose"), (0, "paper"), (1, "paper")]):
        write_swept(tmp_path / str(job), parts, seed, f"intent={intent}", finished=job < 2)
    checkpoint = tmp_path / "2" / "checkpoints" / "latest.safetensors"
    checkpoint.parent.mkdir()
    checkpoint.touch()
    (tmp_path / "multirun.yaml").touch()
    write_evaluation(tmp_path / "1" / "eval", parts, str(tmp_path / "1"))
    return tmp_path


def test_every_run_is_gathered_with_what_became_of_it(sweep: Path) -> None:
    runs = find_sweep(sweep)
    assert [Path(run.folder).name for run in runs] == ["0", "1", "2", "3"]
    assert [run.state for run in runs] == ["finished", "finished", "unfinished", "failed"]
    assert [run.seed for run in runs] == [0, 1, 0, 1]
    assert [run.learned for run in runs] == [True, False, None, None]
    assert [run.success_rate for run in runs] == [None, 0.9, None, None]
    assert runs[1].deviation_mm == 5.0
    assert all(getattr(run, key) is None for run in runs[2:] for key in QUANTITIES)
    assert f"koopdqn train run={sweep / '2'}" in runs[2].reason


def test_only_overrides_that_differ_are_told(sweep: Path) -> None:
    # All were given task=shelf, and each another out.
    assert [run.overrides for run in find_sweep(sweep)] == [{"intent": "pose"}] * 2 + [{"intent": "paper"}] * 2


def test_a_variant_has_mean_and_spread_of_its_known_values(sweep: Path) -> None:
    [(pose, own), (paper, others)] = variants(find_sweep(sweep))
    assert (len(own), len(others)) == (2, 2)
    assert (pose.runs, pose.finished, pose.learned, pose.seeds) == (2, 2, 1, [0, 1])
    seconds = [10.0, 11.0]
    assert pose.seconds
    assert (pose.seconds.runs, pose.seconds.min, pose.seconds.max) == (2, 10.0, 11.0)
    assert pose.seconds.mean == pytest.approx(statistics.fmean(seconds))
    assert pose.seconds.std == pytest.approx(statistics.stdev(seconds))
    # One run alone was evaluated, and a single value has no spread.
    assert pose.success_rate
    assert (pose.success_rate.runs, pose.success_rate.std) == (1, None)
    assert (paper.runs, paper.finished, paper.learned) == (2, 0, 0)
    assert all(getattr(paper, key) is None for key in QUANTITIES)


def test_a_run_that_was_never_checked_has_no_best_check(tmp_path: Path, parts: "Parts") -> None:
    for seed in range(2):
        write_swept(tmp_path / str(seed), parts, seed)
    unchecked = {**train_report(parts, 0), "checks": [], "best_success_rate": 0.0, "best_update": 0}
    write_json(tmp_path / "0" / "train.json", unchecked)
    runs = find_sweep(tmp_path)
    assert [run.check_success_rate for run in runs] == [None, 1.0]
    [(variant, _)] = variants(runs)
    assert variant.check_success_rate
    assert (variant.check_success_rate.runs, variant.check_success_rate.mean) == (1, 1.0)


def test_jobs_are_in_the_order_of_their_numbers(tmp_path: Path, parts: "Parts") -> None:
    for job in (10, 2, 1):
        write_swept(tmp_path / str(job), parts, job)
    assert [Path(run.folder).name for run in find_sweep(tmp_path)] == ["1", "2", "10"]


def test_a_folder_of_runs_without_their_overrides_is_a_sweep_as_well(tmp_path: Path, parts: "Parts") -> None:
    for seed in range(2):
        write_json(tmp_path / f"run{seed}" / "train.json", train_report(parts, seed))
    [(variant, runs)] = variants(find_sweep(tmp_path))
    assert variant.overrides == {}
    assert [run.seed for run in runs] == [0, 1]


def test_a_damaged_training_report_is_a_failed_run(tmp_path: Path, parts: "Parts") -> None:
    write_swept(tmp_path / "0", parts, 0)
    (tmp_path / "0" / "train.json").write_text("{}")
    (tmp_path / "0" / ".hydra" / "overrides.yaml").write_text("[")
    [run] = find_sweep(tmp_path)
    assert (run.state, run.learned) == ("failed", None)
    assert "train.json" in run.reason


def test_other_commands_are_no_runs_of_a_sweep(tmp_path: Path, parts: "Parts") -> None:
    write_swept(tmp_path / "0", parts, 0)
    (tmp_path / "demo" / ".hydra").mkdir(parents=True)
    (tmp_path / "demo" / ".hydra" / "overrides.yaml").write_text("- task=shelf\n- command=demo\n")
    assert [Path(run.folder).name for run in find_sweep(tmp_path)] == ["0"]


def test_a_run_that_paused_before_its_first_check_is_unfinished(tmp_path: Path, parts: "Parts") -> None:
    place = tmp_path / "a run"
    write_swept(place, parts, 0, finished=False)
    (place / "begun.json").write_text("{}")
    [run] = find_sweep(tmp_path)
    assert run.state == "unfinished"
    assert f"koopdqn train 'run={place}'" in run.reason


def test_a_refused_command_is_no_run_of_a_folder(tmp_path: Path, parts: "Parts") -> None:
    write_swept(tmp_path / "0", parts, 0)
    write_swept(tmp_path / "1", parts, 1, finished=False)
    assert [Path(run.folder).name for run in find_sweep(tmp_path)] == ["0"]
    (tmp_path / "multirun.yaml").touch()
    assert [run.state for run in find_sweep(tmp_path)] == ["finished", "failed"]


def test_a_corrected_run_is_none_of_a_sweep(tmp_path: Path, parts: "Parts") -> None:
    write_swept(tmp_path / "0", parts, 0)
    write_swept(tmp_path / "1", parts, 0)
    record = tmp_path / "1" / ".hydra" / "overrides.yaml"
    record.write_text("- task=shelf\n- command=train\n- command=correct\n")
    assert [Path(run.folder).name for run in find_sweep(tmp_path)] == ["0"]


def test_a_folder_without_runs_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"report\.sweep: must hold runs of koopdqn train .*found none in"):
        find_sweep(tmp_path)
    with pytest.raises(BadInputError, match=r"report\.sweep: must name a folder that exists, found '.*nowhere'"):
        find_sweep(tmp_path / "nowhere")
