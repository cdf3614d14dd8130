"""``koopdqn report``: the paper's figures and tables beside ours, from finished runs."""

import subprocess
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.application import CommandResult, given_now, own_options
from koopdqn.app.hydra.compose import composed
from koopdqn.artifact import described
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.evaluation.results import find_sweep
from koopdqn.intent.model import IntentSettings
from koopdqn.report import sweep
from koopdqn.report.data import INTENTS, Intents
from koopdqn.report.page import PAGE, build, work_units
from koopdqn.report.runs import (
    ABLATIONS,
    DEFAULT,
    PAPER,
    PRESETS,
    TASKS,
    Groups,
    Preset,
    Presets,
    configuration_key,
    find_runs,
    group_runs,
)
from koopdqn.report.schema import LeftOut, ReportSettings
from koopdqn.run_folder import DEMONSTRATIONS, EVALUATION, POLICY, RUNS, TRAINING
from koopdqn.settings import load_settings
from koopdqn.tasks.task import Task


def run(config: Configuration, folder: Path) -> CommandResult:
    """Write ``report/`` with ``report.html`` and its pictures; with ``report.make`` make what is missing first.

    Raises:
        BadInputError: no run was found, or a folder of ``report.runs`` or ``report.sweep`` does not exist.
        WorkFailedError: a command that makes a missing run failed.
    """
    settings = config.report
    trusted = [f"trust_modules=[{','.join(config.inputs.trust_modules)}]"] if config.inputs.trust_modules else []
    own = [*own_options(), *trusted]
    if settings.sweep is not None:
        own += [*given_now("robot"), *given_now("robot.path")]
        return _of_sweep(settings, settings.sweep, folder / "report", own)
    presets = all_presets()
    made: list[Path] = []
    if settings.make:
        made = _make_missing(_jobs(settings, _found(settings, presets, made)[0], presets), own)
    groups, left_out = _found(settings, presets, made)
    if not groups:
        where = ", ".join(f"{path}/" for path in settings.runs) or f"{RUNS}/"
        raise BadInputError(
            f"report.runs: must hold finished training runs ({TRAINING}, {POLICY}, {DEMONSTRATIONS}) of task shelf"
            f" or knife, found none in {where}{_reasons(left_out)}; `koopdqn report --make` trains them, and"
            f" `koopdqn train task=shelf` one"
        )
    intents = {task: _intents(task, presets, _task_of(task, groups, presets)) for task in TASKS}
    target = folder / "report"
    with console.stage("Drawing the report", work_units(groups)) as stage:
        content = build(groups, presets, intents, left_out, _ablations(settings), target, stage.advance)
    figures, tables, runs = (
        console.counted(len(content[each]), each.removesuffix("s")) for each in ("figures", "tables", "runs")
    )
    lines = [
        f"{figures} and {tables} from {runs}",
        f"page  {console.shown_path(target / PAGE)}",
    ]
    lines += [f"missing: {part['what']}: {part['reason']} {part['command']}".rstrip() for part in content["missing"]]
    return CommandResult(content, lines)


def _of_sweep(settings: ReportSettings, found: Path, target: Path, own: Sequence[str]) -> CommandResult:
    """Write the page of a sweep; with ``report.make`` evaluate first what is finished and was not evaluated.

    The evaluations are given the words ``own``. Where one fails, the others are made, and the exit status is 1.
    """
    if settings.runs:
        shown = ", ".join(map(str, settings.runs))
        raise BadInputError(f"report.runs: must be empty where sweep= names the folder to show, found {shown}")
    elsewhere = [RUNS] if RUNS.is_dir() else []
    runs = find_sweep(found, elsewhere)
    failed = 0
    missing = [run for run in runs if run.state == "finished" and run.evaluation is None] if settings.make else []
    if missing:
        with console.stage("Evaluating the sweep", len(missing)) as stage:
            for run in missing:
                measured = _new_folder("sweep", "eval")
                try:
                    _koopdqn("eval", [*own, f"run={run.folder}", f"out={measured}"], measured / EVALUATION)
                except WorkFailedError as error:
                    # The others can still be evaluated.
                    console.warn(str(error))
                    failed = 1
                stage.advance()
        runs = find_sweep(found, [RUNS])
    content = sweep.build(found, runs, target)
    lines = [
        f"{console.counted(len(runs), 'run')} of {console.counted(len(content['variants']), 'variant')}",
        f"page   {console.shown_path(target / PAGE)}",
        f"table  {console.shown_path(target / 'sweep.csv')}",
        f"plot   {console.shown_path(target / 'sweep.png')}",
    ]
    lines += [f"{run.state}: {run.folder}: {run.reason}" for run in runs if run.reason]
    return CommandResult(content, lines, exit_status=failed)


def all_presets() -> Presets:
    """Return both presets of the config tree for both tasks."""
    found = {}
    for task in TASKS:
        for name in PRESETS:
            config = Configuration.load(composed([f"task={task}", f"preset={name}", "out=unused"]))
            found[task, name] = Preset(
                name,
                config.task,
                config.agent,
                config.intent,
                config.trust,
                config.reward,
                config.train,
                config.demo.count,
                configuration_key(config.shaped_by()),
            )
    return found


def _intents(name: str, presets: Presets, task: Task) -> Intents:
    """Return the compared intents as they are set for a task; the paper's with its preset's trust and reward."""
    found = {}
    for intent in INTENTS:
        # A run's own task may differ from the config tree's, and intents read from it.
        config = composed([f"task={name}", f"intent={intent}"], {"task": described(task)})
        settings = load_settings(config.intent, IntentSettings, "intent")
        preset = presets[name, PAPER if intent == PAPER else DEFAULT]
        found[intent] = (settings, preset.trust, preset.reward)
    return found


def _task_of(name: str, groups: Groups, presets: Presets) -> Task:
    """Return the task as its shown runs have it, or as the config tree does where there are none."""
    for preset in PRESETS:
        if (name, preset) in groups:
            return groups[name, preset][0].task
    return presets[name, DEFAULT].task


def _found(settings: ReportSettings, presets: Presets, made: Sequence[Path]) -> tuple[Groups, list[LeftOut]]:
    folders = [*(settings.runs or ([RUNS] if RUNS.is_dir() else [])), *made]
    runs, skipped = find_runs(folders, elsewhere=[RUNS])
    groups, left_out = group_runs(runs, presets)
    return groups, [*skipped, *left_out]


def _reasons(left_out: Sequence[LeftOut]) -> str:
    if not left_out:
        return ""
    return f" that can be shown ({left_out[0].folder}: {left_out[0].reason})"


def _ablations(settings: ReportSettings) -> Path:
    name = f"{ABLATIONS}.json"
    # In a checkout `make ablations` keeps its results with the documentation.
    files = [*(folder / ABLATIONS / name for folder in [*settings.runs, RUNS]), Path("docs") / name]
    return next((file for file in files if file.is_file()), files[-1])


def _make_missing(jobs: Sequence[tuple[str, int, Path | None]], own: Sequence[str]) -> list[Path]:
    """Train what is missing of the default preset and evaluate it; return the folders that were made.

    The commands are given the words ``own``.
    """
    folders = []
    with console.stage("Making missing runs", len(jobs)) as stage:
        for task, seed, trained in jobs:
            if trained is None:
                trained = _new_folder(task, "train")
                folders.append(trained)
                _koopdqn("train", [*own, f"task={task}", f"seed={seed}", f"out={trained}"], trained / TRAINING)
            measured = _new_folder(task, "eval")
            folders.append(measured)
            _koopdqn("eval", [*own, f"run={trained}", f"out={measured}"], measured / EVALUATION)
            stage.advance(1, f"{task} seed {seed}")
    return folders


def _jobs(settings: ReportSettings, groups: Groups, presets: Presets) -> list[tuple[str, int, Path | None]]:
    """Return task, seed and folder (None: to be trained) of every run that is missing or not evaluated."""
    jobs: list[tuple[str, int, Path | None]] = []
    for task in TASKS:
        # Runs of another configuration are shown only where none of the present one is there.
        present = presets[task, DEFAULT].key
        runs = [run for run in groups.get((task, DEFAULT), ()) if configuration_key(run.about) == present]
        jobs += [(task, run.seed, run.folder) for run in runs if run.evaluation is None]
        jobs += [(task, seed, None) for seed in dict.fromkeys(settings.seeds) if seed not in {run.seed for run in runs}]
    return jobs


def _new_folder(task: str, command: str) -> Path:
    """Return a run folder that does not exist, named as the command itself would."""
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{command}"
    candidates = (RUNS / task / (name if not count else f"{name}-{count}") for count in range(10_000))
    return next(folder for folder in candidates if not folder.exists())


def _koopdqn(command: str, overrides: Sequence[str], result: Path) -> None:
    """Carry out a koopdqn command in a process of its own; a training that did not learn is a result as well."""
    console.note(f"koopdqn {command} {' '.join(overrides)}")
    call = [sys.executable, "-m", "koopdqn", command, *overrides]
    status = subprocess.run(call, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=False).returncode
    if status and not (status == 1 and result.is_file()):
        raise WorkFailedError(f"koopdqn {command} {' '.join(overrides)} ended with exit status {status}")
