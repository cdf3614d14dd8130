"""The files of a small real run hold what their schemas and docs/files.md say, and nothing else."""

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from pydantic import BaseModel, ValidationError
from safetensors import safe_open

from koopdqn.app import cli
from koopdqn.app.recording import session as recording_schema
from koopdqn.demonstrations import schema as inspection_schema
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.intent import schema as intent_schema
from koopdqn.intent.schema import FitReport
from koopdqn.oracles import journal as feedback_schema
from koopdqn.oracles.journal import AnswerLine
from koopdqn.rl import schema as training_schema
from koopdqn.rl.schema import TrainReport
from koopdqn.settings import ReportModel
from koopdqn.tasks.unfolding import Unfolding
from koopdqn.view import schema as view_schema

FILES = Path(__file__).resolve().parents[1] / "docs" / "files.md"
# The knife turns, so that nothing about orientation is null. Steps four times as long make whole episodes short, and a
# narrow tube makes questions.
SMALL = (
    "task=knife",
    "task.step_m=0.0084",
    "task.position_tolerance_m=0.008",
    "task.rotation_tolerance_rad=0.04",
    "demo.count=3",
    "intent.count=40",
    "intent.copies=2",
    "trust=box",
    "trust.sigmas=2.0",
    "agent.warm_up=500",
    "agent.replay=2000",
    "agent.batch=64",
    "agent.updates_per_round=4",
    "agent.episodes_at_once=4",
    "agent.exploring_starts=0.5",
    "agent.exploring_steps=10",
    "train.check_every=60",
    "train.max_steps=2500",
    "eval.episodes=3",
    "eval.dynamics_episodes=1",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of `koopdqn train` that is far too short to learn, with `koopdqn eval`'s below it."""
    folder = tmp_path_factory.mktemp("small") / "run"
    assert cli.main(["train", f"out={folder}", *SMALL]) == 1
    assert cli.main(["eval", f"run={folder}", f"out={folder / 'eval'}"]) == 0
    return folder


def content(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return found


REPORTS = [("fit.json", FitReport), ("train.json", TrainReport), ("eval/eval.json", EvaluationFile)]


@pytest.mark.parametrize(("name", "model"), REPORTS)
def test_a_report_fits_its_schema_and_comes_back_unchanged(run: Path, name: str, model: type[ReportModel]) -> None:
    found = content(run / name)
    assert model.model_validate(found).model_dump(mode="json") == found


@pytest.mark.parametrize(("name", "model"), REPORTS)
def test_a_schema_refuses_an_unknown_key_a_missing_key_and_nan(run: Path, name: str, model: type[ReportModel]) -> None:
    found = content(run / name)
    number = next(key for key, value in found.items() if isinstance(value, float))
    missing = {key: value for key, value in found.items() if key != number}
    for wrong in ({**found, "extra": 1}, missing, {**found, number: float("nan")}, {**found, number: "1.0"}):
        with pytest.raises(ValidationError):
            model.model_validate(wrong)


def test_every_answer_fits_its_schema(run: Path) -> None:
    lines = [json.loads(line) for line in (run / "feedback.jsonl").read_text(encoding="utf-8").splitlines()]
    assert lines
    for number, line in enumerate(lines):
        assert AnswerLine.model_validate(line).model_dump(mode="json") == line
        assert line["number"] == number
    assert len(lines) == content(run / "train.json")["oracle_queries"]


def test_the_lists_are_as_long_as_their_documented_shapes_say(run: Path) -> None:
    train, fit = content(run / "train.json"), content(run / "fit.json")
    for key in ("reward_per_episode", "steps_per_episode", "exploring_episode"):
        assert len(train[key]) == train["episodes"] > 0
    count, longest = fit["demonstrations"], max(fit["samples"])
    for values in (
        fit["samples"],
        fit["roll_out_error_m"]["final"],
        fit["roll_out_error_m"]["hausdorff"],
        fit["trust"]["per_demonstration"],
    ):
        assert len(values) == count == 3
    for key in ("one_step_error_per_step_m", "one_step_error_per_step_rad"):
        assert len(fit[key]["mean"]) == len(fit[key]["max"]) == longest - 1


def test_the_reports_of_a_run_agree_with_each_other(run: Path) -> None:
    train, evaluation = content(run / "train.json"), content(run / "eval" / "eval.json")
    assert evaluation["run"] == str(run)
    assert evaluation["step_limit"] == train["step_limit"]
    given, agreement = train["rewards_given"], train["reward_agreement"]
    assert given["asked"] == train["oracle_queries"] > 0
    assert train["trusted_fraction"] == pytest.approx((given["trusted"] + given["certified"]) / sum(given.values()))
    assert agreement["asked"] == 1.0  # the demonstrator itself answers
    assert train["checks"][-1]["env_steps"] <= train["env_steps"]
    assert max(check["success_rate"] for check in train["checks"]) == train["best_success_rate"]


def models() -> list[type[BaseModel]]:
    found: set[type[BaseModel]] = {EvaluationFile}
    for module in (intent_schema, training_schema, feedback_schema, recording_schema, inspection_schema, view_schema):
        kinds = [value for value in vars(module).values() if isinstance(value, type)]
        found |= {kind for kind in kinds if issubclass(kind, BaseModel) and kind.__module__ == module.__name__}
    return sorted(found, key=lambda model: model.__name__)


@pytest.mark.parametrize("model", models())
def test_every_key_of_a_schema_is_described(model: type[BaseModel]) -> None:
    for name, field in model.model_fields.items():
        assert field.description, f"{model.__name__}.{name}"


def documented(heading: str) -> dict[str, tuple[str, str]]:
    """Return type and shape by name from the first table of arrays below a heading of docs/files.md."""
    _, _, below = FILES.read_text(encoding="utf-8").partition(f"\n{heading}\n")
    table = re.search(r"\| name \| type \| shape \|.*?\n\n", below, re.DOTALL)
    assert table
    rows = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table[0].strip().splitlines()[2:]]
    return {row[0].strip("` "): (row[1], row[2]) for row in rows}


def check_arrays(heading: str, arrays: dict[str, np.ndarray], absent: tuple[str, ...] = ()) -> None:
    """Check that arrays are those that docs/files.md lists, of the types and shapes it gives."""
    rows = documented(heading)
    sizes: dict[str, int] = {}
    seen = set()
    for name, values in arrays.items():
        row = name if name in rows else next((key for key in rows if key[-1] == "*" and name.startswith(key[:-1])), "")
        assert row, f"{heading}: {name} is not documented"
        seen.add(row)
        kind, shape = rows[row]
        assert kind == ("text" if values.dtype.kind == "U" else str(values.dtype)) or row[-1] == "*", name
        if shape != "–":
            expected = [part.strip() for part in shape.strip("()").split(",") if part.strip()]
            assert len(expected) == values.ndim, name
            for part, size in zip(expected, values.shape, strict=True):
                symbols = [symbol for symbol in part.split(" + ") if not symbol.isdigit() and symbol not in sizes]
                if len(symbols) == 1 and symbols[0] == part:
                    sizes[part] = size
                total = sum(int(symbol) if symbol.isdigit() else sizes[symbol] for symbol in part.split(" + "))
                assert total == size, f"{name}: {shape} with {sizes}, found {values.shape}"
    assert set(rows) - seen == set(absent)


def tensors(path: Path) -> dict[str, np.ndarray]:
    with safe_open(path, framework="numpy") as file:
        assert set(file.metadata()) == {"koopdqn"}
        found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    # Buffers first: they give the sizes that weights are written with.
    return dict(sorted(found.items(), key=lambda item: (item[1].ndim, item[0])))


def test_the_intents_arrays_are_those_documented(run: Path) -> None:
    tube = ("trust_middle", "trust_radius", "trust_spread")
    apart = ("center", "scale", "rotation_matrix", "rotation_frame")
    following = ("frame_path", "frame_shifts", "frame_centre", "frame_reach")
    unfolded = (f"frame_unfolding_{each.name}" for each in fields(Unfolding))
    absent = (*tube, *apart, *following, *unfolded, "in_full")
    with np.load(run / "intent.npz", allow_pickle=False) as file:
        check_arrays("### intent.npz", {name: file[name] for name in file.files}, absent=absent)


def test_the_policys_arrays_are_those_documented(run: Path) -> None:
    check_arrays("### policy.safetensors", tensors(run / "policy.safetensors"))


def test_the_checkpoints_arrays_are_those_documented(run: Path) -> None:
    check_arrays("### checkpoints/latest.safetensors", tensors(run / "checkpoints" / "latest.safetensors"))


def test_the_demonstrations_are_those_documented(run: Path) -> None:
    with h5py.File(run / "demos.hdf5") as file:
        arrays: dict[str, np.ndarray] = {}

        def keep(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and name.startswith("data/demo_0/"):
                arrays[name] = item[()]

        file.visititems(keep)
        attributes = {*file["data"].attrs, *file["data/demo_0"].attrs}
    check_arrays("## demos.hdf5", arrays)
    _, _, below = FILES.read_text(encoding="utf-8").partition("\n## demos.hdf5\n")
    table = below.partition("| attribute |")[2].partition("\n\n")[0]
    # A set that was moved holds by how much.
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == attributes | {"placement"}


def test_every_file_of_a_run_folder_is_documented(run: Path) -> None:
    _, _, below = FILES.read_text(encoding="utf-8").partition("\n## A run folder\n")
    names = set(re.findall(r"^\| `([^`]+)` \|", below.partition("\n## ")[0], re.MULTILINE))
    found = {"checkpoints/latest.safetensors" if path.name == "checkpoints" else path.name for path in run.iterdir()}
    found |= {path.name for path in (run / "eval").iterdir()}
    found = {f"{name}/" if name in ("events", ".hydra") else name for name in found - {"eval"}}
    # Those of `koopdqn demo` and `inspect`, of a person at the terminal, of films, and of what only looks.
    others = {"demos.png", "inspect.json", "inspect.png", "keys.jsonl", "questions/", "eval.mp4", "view.html"}
    others |= {"explain.json", "explain.png", "compare.json", "compare.html", "stream.json", "correct.json"}
    others |= {"waypoints.csv", ".lock"}
    assert names - found == others
    assert found - names == set()


def test_the_tags_of_the_events_are_those_documented(run: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(run / "events"))
    events.Reload()
    _, _, below = FILES.read_text(encoding="utf-8").partition("\n## events/\n")
    documented = set(re.findall(r"^\| `([^`]+)` \|", below, re.MULTILINE))
    written = set(events.Tags()["scalars"])
    # A short run may have no use for what it remembers.
    assert written | {"reward_agreement/remembered", "reward_agreement/certified"} == documented
