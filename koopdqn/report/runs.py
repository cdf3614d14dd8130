"""Finding finished runs, each training with the newest evaluation of it, and what ``report.json`` says of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field, Strict, ValidationError

from koopdqn.artifact import read_artifact, reading
from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import EvaluationFile
from koopdqn.files import digest, read_json
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.rl.schema import TrainReport
from koopdqn.robot.arm import Arm
from koopdqn.run_folder import check_plain
from koopdqn.schema import ReportModel
from koopdqn.settings import TARGET, Name, NonNegativeInt, PathText, Settings, load_settings
from koopdqn.tasks.task import Task

TRAINING: Final = "train.json"
EVALUATION: Final = "eval.json"
POLICY: Final = "policy.safetensors"
DEMONSTRATIONS: Final = "demos.hdf5"
ABLATIONS: Final = "ablations"
"""Name of the folder below ``runs/`` whose runs are shown in a table of their own."""
STUDY: Final = "study"
"""Name of the folder below ``runs/`` whose runs docs/study.md shows."""

# What tells two runs of one configuration apart.
_OF_ONE_RUN: Final = ("seed", "made_from", "network")


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        folder: where it lies.
        train: the content of its ``train.json``.
        about: the metadata of its policy: the config that shaped it.
        task: the task it learned.
        arm: the arm it learned with.
        evaluation_file: the newest evaluation of it, or None.
        evaluation: the content of that file, or None.
    """

    folder: Path
    train: Mapping[str, Any]
    about: Mapping[str, Any]
    task: Task
    arm: Arm
    evaluation_file: Path | None = None
    evaluation: Mapping[str, Any] | None = None

    @property
    def seed(self) -> int:
        """The run's seed."""
        return int(self.train["seed"])

    @property
    def key(self) -> str:
        """What runs of one configuration share, whatever their seed."""
        return configuration_key(self.about)

    @property
    def train_file(self) -> Path:
        """Its ``train.json``."""
        return self.folder / TRAINING

    @property
    def demonstrations_file(self) -> Path:
        """Its demonstrations."""
        return self.folder / DEMONSTRATIONS

    @property
    def age(self) -> int:
        """When it was finished [ns]; larger is newer."""
        return self.train_file.stat().st_mtime_ns


@dataclass(frozen=True)
class Skipped:
    """A folder that looks like a run and is not used.

    Attributes:
        folder: where it lies.
        reason: why.
    """

    folder: Path
    reason: str


def configuration_key(about: Mapping[str, Any]) -> str:
    """Return the SHA-256 of what decides a training run's bytes, less its seed."""
    return digest({name: value for name, value in about.items() if name not in _OF_ONE_RUN})


def find_runs(folders: Sequence[Path], elsewhere: Sequence[Path] = ()) -> tuple[list[Run], list[Skipped]]:
    """Return the finished runs below folders, and what looks like one but cannot be used.

    Args:
        folders: searched for training runs and for evaluations; what lies below a folder named
            ``ablations`` is left out.
        elsewhere: searched for evaluations only.

    Raises:
        BadInputError: one of ``folders`` does not exist.
    """
    for folder in folders:
        if not folder.is_dir():
            raise BadInputError(f"report.runs: must name folders that exist, found {str(folder)!r}")
    evaluations, unreadable = _evaluations([*folders, *elsewhere])
    runs: dict[Path, Run] = {}
    skipped: dict[Path, Skipped] = {}
    for file in _below(folders, TRAINING):
        folder = file.parent
        if not (folder / POLICY).is_file():
            continue
        try:
            check_plain(folder)
            runs[folder.resolve()] = _with_evaluation(_read(folder), evaluations)
        except BadInputError as error:
            skipped[folder.resolve()] = Skipped(folder, str(error))
    return list(runs.values()), [*skipped.values(), *unreadable]


def _below(folders: Sequence[Path], name: str) -> list[Path]:
    found = []
    for folder in folders:
        files = sorted(folder.rglob(name)) if folder.is_dir() else []
        found += [file for file in files if not {ABLATIONS, STUDY} & set(file.relative_to(folder).parts)]
    return found


def _read(folder: Path) -> Run:
    train = read_json(folder / TRAINING, "the training report")
    try:
        train = TrainReport.model_validate(train).model_dump(mode="json")
    except ValidationError as error:
        raise BadInputError(
            f"{folder / TRAINING} must be a training report of this release: {_first(error)}"
        ) from error
    if not (folder / DEMONSTRATIONS).is_file():
        raise BadInputError(f"run {folder} must hold {DEMONSTRATIONS}, found none")
    about = read_artifact(folder / POLICY, "policy").about
    try:
        nodes = {name: about[name] for name in ("task", "robot", "intent", "trust", "reward", "agent", "seed")}
    except KeyError as error:
        raise BadInputError(f"{folder / POLICY} must say what shaped it, found no {error}") from error
    with reading(f"policy {folder / POLICY}"):
        task = load_settings(_without_item_targets(nodes["task"]), Task, "task")
        arm = load_settings(_without_item_targets(nodes["robot"]), Arm, "robot")
        # The figures need them later.
        load_settings(nodes["intent"], IntentSettings, "intent")
        load_settings(nodes["trust"], TrustSettings, "trust")
        load_settings(nodes["reward"], RewardSettings, "reward")
        return Run(folder, train, about, task, arm)


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def _without_item_targets(node: Any) -> Any:
    """Return a node whose lists' items name no class, as a settings class takes them."""
    if isinstance(node, Mapping):
        return {key: _without_item_targets(value) for key, value in node.items()}
    if isinstance(node, list):
        plain = [{k: v for k, v in item.items() if k != TARGET} if isinstance(item, Mapping) else item for item in node]
        return [_without_item_targets(item) for item in plain]
    return node


def _evaluations(folders: Sequence[Path]) -> tuple[list[tuple[Path, Mapping[str, Any]]], list[Skipped]]:
    """Return evaluation files with their contents, the newest first, and what is no evaluation of this release."""
    found: dict[Path, tuple[Path, Mapping[str, Any]]] = {}
    skipped: dict[Path, Skipped] = {}
    for file in _below(folders, EVALUATION):
        try:
            check_plain(file.parent)
            content = EvaluationFile.model_validate(read_json(file, "the evaluation")).model_dump(mode="json")
        except BadInputError as error:
            skipped[file.resolve()] = Skipped(file.parent, str(error))
        except ValidationError as error:
            reason = f"{file} must be an evaluation of this release: {_first(error)}"
            skipped[file.resolve()] = Skipped(file.parent, reason)
        else:
            found[file.resolve()] = (file, content)
    newest_first = sorted(found.values(), key=lambda item: item[0].stat().st_mtime_ns, reverse=True)
    return newest_first, list(skipped.values())


def _with_evaluation(run: Run, evaluations: Sequence[tuple[Path, Mapping[str, Any]]]) -> Run:
    for file, content in evaluations:
        if content["task"] == run.task.name and _measures(file, str(content["run"]), run.folder):
            return Run(run.folder, run.train, run.about, run.task, run.arm, file, content)
    return run


def _measures(file: Path, named: str, folder: Path) -> bool:
    """Return whether an evaluation names a run's folder, as seen from any folder that it may have been made in."""
    wanted = folder.resolve()
    bases = [Path.cwd(), *file.resolve().parents]
    return any((base / named).resolve() == wanted for base in bases)


class ShownRun(ReportModel):
    """A run that the page shows."""

    folder: Name = Field(description="its folder, as it was given or found")
    task: Name = Field(description="name of the task")
    preset: Name = Field(description="name of the preset")
    seed: NonNegativeInt = Field(description="of the run")
    evaluation: str | None = Field(description="file of its evaluation; null if there is none")


class LeftOut(ReportModel):
    """A run that the page does not show."""

    folder: Name = Field(description="its folder")
    reason: Name = Field(description="why")


class DrawnFigure(ReportModel):
    """A figure of the page."""

    number: Name = Field(description="as the paper counts")
    title: Name = Field(description="in a few words")
    files: list[Name] = Field(description="its PNGs, relative to the page")


class MissingPart(ReportModel):
    """A figure or table that the page lacks."""

    what: Name = Field(description="its name")
    reason: Name = Field(description="what it needs")
    command: str = Field(description="what makes it; empty where no command would")


class ReportFile(ReportModel):
    """The content of ``report.json``."""

    page: Name = Field(description="the page")
    runs: list[ShownRun] = Field(description="runs that it shows")
    left_out: list[LeftOut] = Field(description="runs that were found and are not shown")
    figures: list[DrawnFigure] = Field(description="figures, in order")
    tables: list[Name] = Field(description="titles of its tables, in order")
    missing: list[MissingPart] = Field(description="what it lacks")


class ReportSettings(Settings):
    """Which runs the report shows, and whether missing ones are made."""

    make: bool = Field(description="train and evaluate what is missing first")
    runs: Annotated[tuple[PathText, ...], Strict(False)] = Field(
        description="folders to search for finished runs; empty: the folder runs/, less its ablations"
    )
    seeds: Annotated[tuple[NonNegativeInt, ...], Strict(False), Field(min_length=1)] = Field(
        description="the seeds that `make` trains each task with"
    )
