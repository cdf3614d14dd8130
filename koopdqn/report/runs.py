"""Finding finished runs with their newest evaluations, and grouping them by task and preset."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

from koopdqn.artifact import read_artifact, reading
from koopdqn.errors import BadInputError
from koopdqn.evaluation.results import find_evaluations, newest_evaluation, read_training
from koopdqn.files import digest
from koopdqn.intent.bend import CORRECTED
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.report.schema import LeftOut
from koopdqn.rl.settings import Agent, TrainSettings
from koopdqn.robot.arm import Arm
from koopdqn.run_folder import DEMONSTRATIONS, EVALUATION, POLICY, TRAINING, check_plain
from koopdqn.settings import load_settings
from koopdqn.tasks.task import Task

ABLATIONS: Final = "ablations"
"""Name of the folder below ``runs/`` whose runs are shown in a table of their own."""
STUDY: Final = "study"
"""Name of the folder below ``runs/`` whose runs docs/study.md shows."""
DEFAULT: Final = "default"
PAPER: Final = "paper"
PRESETS: Final = (DEFAULT, PAPER)
SCRIPTED: Final = "scripted"
"""Who answers in both."""
TASKS: Final = ("shelf", "knife")
"""The paper's two tasks, in its order."""

# What tells two runs of one configuration apart.
_OF_ONE_RUN: Final = ("seed", "made_from", "network", "frame")


@dataclass(frozen=True)
class Run:
    """A finished training run.

    Attributes:
        folder: where it lies.
        train: the content of its ``train.json``.
        about: the metadata of its policy: the config that shaped it.
        task: the task it learned.
        arm: the arm it learned with.
        intent: how its intent was fitted.
        trust: where that was trusted.
        reward: how rewards were made.
        evaluation_file: the newest evaluation of it, or None.
        evaluation: the content of that file, or None.
    """

    folder: Path
    train: Mapping[str, Any]
    about: Mapping[str, Any]
    task: Task
    arm: Arm
    intent: IntentSettings
    trust: TrustSettings
    reward: RewardSettings
    evaluation_file: Path | None = None
    evaluation: Mapping[str, Any] | None = None

    @property
    def seed(self) -> int:
        """The run's seed."""
        return int(self.train["seed"])

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


def configuration_key(about: Mapping[str, Any]) -> str:
    """Return the SHA-256 of what decides a training run's bytes, less its seed."""
    return digest({name: value for name, value in about.items() if name not in _OF_ONE_RUN})


def find_runs(folders: Sequence[Path], elsewhere: Sequence[Path] = ()) -> tuple[list[Run], list[LeftOut]]:
    """Return the finished runs below folders, and what looks like one but cannot be used.

    What lies below a folder named ``ablations`` or ``study`` is left out; evaluations may lie ``elsewhere`` as well.

    Raises:
        BadInputError: one of ``folders`` does not exist.
    """
    for folder in folders:
        if not folder.is_dir():
            raise BadInputError(f"report.runs: must name folders that exist, found {str(folder)!r}")
    evaluations, unusable = find_evaluations(_below([*folders, *elsewhere], EVALUATION))
    left_out = [LeftOut(folder=str(file.parent), reason=reason) for file, reason in unusable.items()]
    runs = []
    for file in _below(folders, TRAINING):
        if not (file.parent / POLICY).is_file():
            continue
        try:
            check_plain(file.parent)
            run = _read(file.parent)
        except BadInputError as error:
            left_out.append(LeftOut(folder=str(file.parent), reason=str(error)))
        else:
            measured, content = newest_evaluation(run.folder, run.task.name, evaluations)
            runs.append(replace(run, evaluation_file=measured, evaluation=content))
    return runs, left_out


def _below(folders: Sequence[Path], name: str) -> list[Path]:
    """Return the files of a name below folders, each once, less those below ablations and the study."""
    found: dict[Path, Path] = {}
    for folder in folders:
        for file in sorted(folder.rglob(name)) if folder.is_dir() else []:
            if not {ABLATIONS, STUDY} & set(file.relative_to(folder).parts):
                found[file.resolve()] = file
    return list(found.values())


def _read(folder: Path) -> Run:
    train = read_training(folder)
    if not (folder / DEMONSTRATIONS).is_file():
        raise BadInputError(f"run {folder} must hold {DEMONSTRATIONS}, found none")
    policy = read_artifact(folder / POLICY, "policy")
    about = policy.about
    if CORRECTED in policy.arrays:
        raise BadInputError(f"run {folder} must be as it was trained, found it corrected by hand")
    with reading(f"policy {folder / POLICY}"):
        return Run(
            folder,
            train,
            about,
            load_settings(about["task"], Task, "task"),
            load_settings(about["robot"], Arm, "robot"),
            load_settings(about["intent"], IntentSettings, "intent"),
            load_settings(about["trust"], TrustSettings, "trust"),
            load_settings(about["reward"], RewardSettings, "reward"),
        )


class Preset(NamedTuple):
    """What a preset sets for a task, and the :func:`configuration_key` of its runs."""

    name: str
    task: Task
    agent: Agent
    intent: IntentSettings
    trust: TrustSettings
    reward: RewardSettings
    train: TrainSettings
    demonstrations: int
    key: str


Presets = Mapping[tuple[str, str], Preset]
"""Presets by task and name."""
Groups = Mapping[tuple[str, str], Sequence[Run]]
"""Runs of one configuration, one a seed, by task and preset; what has no runs is absent."""


def group_runs(runs: Sequence[Run], presets: Presets) -> tuple[Groups, list[LeftOut]]:
    """Return the runs that the report shows, in the paper's order, and those that it leaves out with the reason.

    A run belongs to a preset if it has the preset's agent and intent and the scripted demonstrator answered. Of
    several configurations of one preset the one shown is that of the present config tree, if there is one, or else
    that with most seeds, or else the newest; of several runs of one seed an evaluated one, or else the newest.
    """
    by_preset: dict[tuple[str, str], dict[str, list[Run]]] = {place: {} for place in presets}
    left_out = []
    for run in runs:
        names = run.task.name, run.train["agent"], run.train["intent"], run.train["oracle"] or SCRIPTED
        for place, preset in presets.items():
            if names == (preset.task.name, preset.agent.name, preset.intent.name, SCRIPTED):
                by_preset[place].setdefault(configuration_key(run.about), []).append(run)
                break
        else:
            reason = "agent {1}, intent {2}, oracle {3}, task {0}: no preset has these".format(*names)
            left_out.append(LeftOut(folder=str(run.folder), reason=reason))
    groups = {}
    for place, configurations in by_preset.items():
        if not configurations:
            continue
        shown = max(configurations, key=lambda key: _rank(key, configurations[key], presets[place].key))
        for key, others in configurations.items():
            if key != shown:
                reason = f"another configuration of preset {place[1]}"
                left_out += [LeftOut(folder=str(run.folder), reason=reason) for run in others]
        kept: dict[int, Run] = {}
        for run in sorted(configurations[shown], key=lambda run: (run.evaluation is not None, run.age)):
            if run.seed in kept:
                reason = f"another run of seed {run.seed} is shown"
                left_out.append(LeftOut(folder=str(kept[run.seed].folder), reason=reason))
            kept[run.seed] = run
        groups[place] = [kept[seed] for seed in sorted(kept)]
    return groups, sorted(left_out, key=lambda item: item.folder)


def _rank(key: str, runs: Sequence[Run], present: str) -> tuple[bool, int, int]:
    return key == present, len({run.seed for run in runs}), max(run.age for run in runs)
