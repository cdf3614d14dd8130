"""Results of runs below a folder: training reports, the newest evaluation of each, and what a sweep comes to."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Final, Literal, TypeVar

from pydantic import Field, ValidationError

from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.files import read_json, sha256_of
from koopdqn.rl.schema import TrainReport
from koopdqn.run_folder import BEGUN, CHECKPOINT, EVALUATION, POLICY, RECORD, TRAINING, check_plain
from koopdqn.settings import Count, Fraction, Name, NonNegative, NonNegativeInt, ReportModel, flaw

# What does not tell one variant from another.
_OF_ONE_RUN: Final = ("command", "out", "run", "seed")
QUANTITIES: Final = ("success_rate", "deviation_mm", "check_success_rate", "oracle_queries", "seconds")
"""What is compared over the runs of a sweep: keys of :class:`SweptRun` and of :class:`Variant`."""

_MULTIRUN: Final = "multirun.yaml"

Model = TypeVar("Model", bound=ReportModel)
Evaluations = Sequence[tuple[Path, dict[str, Any]]]
"""Evaluation files with their contents, the newest first."""


def read_report(file: Path, what: str, model: type[Model]) -> dict[str, Any]:
    """Return the content of a JSON file, checked against its schema.

    Raises:
        BadInputError: it cannot be read, or breaks the schema; ``what`` names it for the user.
    """
    try:
        return model.model_validate(read_json(file, f"the {what}")).model_dump(mode="json")
    except ValidationError as error:
        raise BadInputError(f"{file} must hold the keys of this release's {what}: {flaw(error)}") from error


def read_training(folder: Path) -> dict[str, Any]:
    """Return the content of a run's ``train.json``, as :func:`read_report` does."""
    return read_report(folder / TRAINING, "training report", TrainReport)


def find_evaluations(files: Sequence[Path]) -> tuple[Evaluations, dict[Path, str]]:
    """Return evaluation files with their contents, the newest first, and of others why they cannot be used."""
    found, unusable = [], {}
    for file in files:
        try:
            check_plain(file.parent)
            found.append((file, read_report(file, "evaluation", EvaluationFile)))
        except BadInputError as error:
            unusable[file] = str(error)
    return sorted(found, key=lambda item: item[0].stat().st_mtime_ns, reverse=True), unusable


def newest_evaluation(
    folder: Path, task: str, evaluations: Evaluations
) -> tuple[Path, dict[str, Any]] | tuple[None, None]:
    """Return the newest evaluation of the run in a folder, wherever it was named from, with its file; or nothing.

    One that was not as trained, or of another policy than the folder holds now, says nothing of how it learned.
    """
    wanted = folder.resolve()
    policy = sha256_of(folder / POLICY) if (folder / POLICY).is_file() else None
    for file, content in evaluations:
        if not content["as_trained"] or content["policy"] not in (policy, None) or "\0" in content["run"]:
            continue
        bases = [Path.cwd(), *file.resolve().parents]
        if content["task"] == task and any((base / content["run"]).resolve() == wanted for base in bases):
            return file, content
    return None, None


class SweptRun(ReportModel):
    """A run of a sweep."""

    folder: Name = Field(description="its folder, as it was given or found")
    overrides: dict[str, str] = Field(
        description="the overrides that differ between runs, by key, but for the seed; one that was not given is absent"
    )
    seed: NonNegativeInt | None = Field(description="of the run; null if it is not known")
    state: Literal["finished", "unfinished", "failed"] = Field(
        description="finished: with a train.json; unfinished: begun, to go on with; failed: neither"
    )
    reason: str = Field(description="why it is not finished; empty if it is")
    evaluation: Name | None = Field(description="file of its newest evaluation; null if there is none")
    learned: bool | None = Field(description="whether it learned; null, as what follows, if it is not finished")
    success_rate: Fraction | None = Field(description="of the evaluation; null if there is none")
    deviation_mm: NonNegative | None = Field(description="mean path deviation of the evaluation; null if there is none")
    check_success_rate: Fraction | None = Field(description="of the best check in training; null without any")
    oracle_queries: NonNegativeInt | None = Field(description="questions that reached the oracle")
    seconds: NonNegative | None = Field(description="time the training took [s]")


class Spread(ReportModel):
    """A quantity over the runs of a variant that have it."""

    runs: Count = Field(description="how many those are")
    mean: NonNegative = Field(description="their mean")
    std: NonNegative | None = Field(description="their sample standard deviation; null for a single run")
    min: NonNegative = Field(description="the least")
    max: NonNegative = Field(description="the largest")


class Variant(ReportModel):
    """The runs of a sweep that differ in their seed only."""

    overrides: dict[str, str] = Field(description="theirs, of those that differ between runs")
    seeds: list[NonNegativeInt] = Field(description="the known ones")
    runs: Count = Field(description="all of them")
    finished: NonNegativeInt = Field(description="those with a train.json")
    learned: NonNegativeInt = Field(description="those that learned")
    success_rate: Spread | None = Field(description="over the evaluated runs; null, as below, if there are none")
    deviation_mm: Spread | None = Field(description="over the evaluated runs")
    check_success_rate: Spread | None = Field(description="over the finished runs that were checked")
    oracle_queries: Spread | None = Field(description="over the finished runs")
    seconds: Spread | None = Field(description="over the finished runs [s]")


_LONGEST_RECORD: Final = 65_536
"""Characters of a run's record that are read."""
_LONGEST_SEED: Final = 20


def find_sweep(folder: Path, elsewhere: Sequence[Path] = ()) -> list[SweptRun]:
    """Return every training run below a folder with its newest evaluation, unfinished and failed ones included.

    It is the folder of a Hydra multirun or any other; evaluations may lie ``elsewhere`` as well. A command that made
    nothing is a failed job of a multirun, and no run elsewhere.

    Raises:
        BadInputError: the folder does not exist, or holds no training run.
    """
    if not folder.is_dir():
        raise BadInputError(f"report.sweep: must name a folder that exists, found {str(folder)!r}")
    given = {file.parents[1]: _given(file) for file in folder.rglob(str(RECORD))}
    begun = {
        place
        for place, overrides in given.items()
        if overrides.get("command", "train") == "train"
        and (any(file.name != RECORD.parent.name for file in place.iterdir()) or (place.parent / _MULTIRUN).is_file())
    }
    # A correction keeps the report of the training before it.
    corrected = {place for place, overrides in given.items() if overrides.get("command") == "correct"}
    # Jobs are numbered, and 2 comes before 10.
    places = sorted(
        begun | {file.parent for file in folder.rglob(TRAINING)} - corrected,
        key=lambda place: (place.parent, len(place.name), place.name),
    )
    if not places:
        rule = f"must hold runs of koopdqn train ({TRAINING} or {RECORD})"
        raise BadInputError(f"report.sweep: {rule}, found none in {folder}/; `koopdqn train -m seed=0,1,2` makes some")
    evaluations, _ = find_evaluations([file for each in (folder, *elsewhere) for file in each.rglob(EVALUATION)])
    overrides = [given.get(place, {}) for place in places]
    varied = {key for each in overrides for key in each if len({other.get(key) for other in overrides}) > 1}
    shown = sorted(key for key in varied if key not in _OF_ONE_RUN and not key.startswith("hydra"))
    return [
        _swept(place, own, {key: own[key] for key in shown if key in own}, evaluations)
        for place, own in zip(places, overrides, strict=True)
    ]


def _given(file: Path) -> dict[str, str]:
    """Return the overrides that a run was given by key; none where they cannot be read."""
    import yaml

    try:
        check_plain(file.parents[1])
        with file.open(encoding="utf-8") as opened:
            # This loader knows no tags and makes texts, lists and mappings alone.
            items = yaml.load(opened.read(_LONGEST_RECORD), Loader=yaml.BaseLoader)
    # The file may hold anything, and the YAML parser has errors of its own.
    except Exception:
        return {}
    parts = [item.partition("=") for item in items if isinstance(item, str)] if isinstance(items, list) else []
    return {key.lstrip("+~"): value for key, _, value in parts}


def _swept(place: Path, given: Mapping[str, str], overrides: dict[str, str], evaluations: Evaluations) -> SweptRun:
    seed = given.get("seed", "")
    content: dict[str, Any] = dict.fromkeys(("evaluation", "learned", *QUANTITIES))
    content |= {
        "folder": str(place),
        "overrides": overrides,
        "seed": int(seed) if seed.isdecimal() and len(seed) < _LONGEST_SEED else None,
    }
    try:
        check_plain(place)
        train = read_training(place) if (place / TRAINING).is_file() else None
    except BadInputError as error:
        return SweptRun(state="failed", reason=str(error), **content)
    if train is not None:
        content |= {key: train[key] for key in ("seed", "learned", "oracle_queries", "seconds")}
        # The report has 0 there without a check.
        content["check_success_rate"] = train["best_success_rate"] if train["checks"] else None
        file, evaluation = newest_evaluation(place, train["task"], evaluations)
        if evaluation is not None:
            content |= {"evaluation": str(file), "success_rate": evaluation["success_rate"]}
            content["deviation_mm"] = evaluation["path_deviation_mm"]["mean"]
        return SweptRun(state="finished", reason="", **content)
    if (place / BEGUN).is_file() or (place / CHECKPOINT).is_file():
        again = shlex.join(["koopdqn", "train", f"run={place}"])
        reason = f"It runs, or was stopped: `{again}` goes on with it."
        return SweptRun(state="unfinished", reason=reason, **content)
    reason = f"It holds neither {TRAINING} nor {BEGUN}: it failed, or was stopped before it learned."
    return SweptRun(state="failed", reason=reason, **content)


def variants(runs: Sequence[SweptRun]) -> list[tuple[Variant, list[SweptRun]]]:
    """Return each variant of a sweep with its runs, in the order of the runs."""
    groups: dict[tuple[tuple[str, str], ...], list[SweptRun]] = {}
    for run in runs:
        groups.setdefault(tuple(run.overrides.items()), []).append(run)
    found = []
    for overrides, own in groups.items():
        spreads = {key: _spread(known(own, key)) for key in QUANTITIES}
        variant = Variant(
            overrides=dict(overrides),
            seeds=[run.seed for run in own if run.seed is not None],
            runs=len(own),
            finished=sum(run.state == "finished" for run in own),
            learned=sum(bool(run.learned) for run in own),
            **spreads,
        )
        found.append((variant, own))
    return found


def known(runs: Sequence[SweptRun], key: str) -> list[float]:
    """Return a quantity of those runs of a sweep that have it."""
    values = [getattr(run, key) for run in runs]
    return [float(value) for value in values if value is not None]


def _spread(values: Sequence[float]) -> Spread | None:
    if not values:
        return None
    std = stdev(values) if len(values) > 1 else None
    return Spread(runs=len(values), mean=fmean(values), std=std, min=min(values), max=max(values))
