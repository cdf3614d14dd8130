"""``koopdqn compare``: trained runs of a task side by side, in one table and on one page."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from koopdqn import console
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.demonstrated import with_task
from koopdqn.app.commands.trained import TrainedRun, as_recorded, as_trained, read_trained
from koopdqn.app.hydra.application import CommandResult, given_now, own_options, program
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.record import GROUPS, read_record
from koopdqn.artifact import described
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.evaluation.metrics import reference_paths
from koopdqn.evaluation.results import find_evaluations, newest_evaluation, read_training
from koopdqn.files import write_json
from koopdqn.plots import style
from koopdqn.pose import POSITION, Array
from koopdqn.report.runs import SCRIPTED
from koopdqn.rl.policy import PolicyAround
from koopdqn.run_folder import EVALUATION, RUNS
from koopdqn.settings import plain
from koopdqn.tasks.rollout import roll_out
from koopdqn.untrusted import modules_named, trusting
from koopdqn.view.motions import Motion, demonstrated_motions, learned_motion, shown_starts
from koopdqn.view.page import Listing, Shown, write_page
from koopdqn.view.schema import ComparedRun, CompareFile, Difference

if TYPE_CHECKING:
    from rich.table import Table

PAGE: Final = "compare.html"
_COLOURS: Final = (style.BLUE, style.GREEN, style.RED, style.PINK, style.SKY, style.INK)
_SHAPING: Final = (
    *(group for group in GROUPS if group not in ("preset", "oracle")),
    "seed",
    "demo",
    "reward",
    "feedback",
    "train",
)
"""Keys of the config that may change what is learned."""
_LONGEST: Final = 60


@dataclass(frozen=True)
class _Run:
    label: str
    folder: Path
    config: Configuration
    trained: TrainedRun
    train: dict[str, Any]
    keys: dict[str, str]


def run(config: Configuration, folder: Path) -> CommandResult:
    """Write ``compare.html`` and ``compare.json`` of the runs of ``run=``."""
    runs = [_read(place, chr(ord("A") + n), config) for n, place in enumerate(config.compare.runs)]
    names = list(dict.fromkeys(each.config.task.name for each in runs))
    if len(names) > 1:
        raise BadInputError(f"run: the runs that are compared must be of one task, found {', '.join(names)}")
    with console.stage("Moving the arm", len(runs)) as stage:
        numbers, starts = _starts(runs, config)
        motions: list[Motion] = []
        for each, colour in zip(runs, _COLOURS, strict=False):
            motions += _motions(each, colour, numbers, starts, runs[0])
            stage.advance()
        cell, items = runs[0].trained.workcell, runs[0].trained.demonstrations.items
        shown = demonstrated_motions(items, cell.without_obstacles().reachability, cell.task, len(items))
    differences = _differences(runs)
    found = [_told(each, motions) for each in runs]
    listings = [_config_listing(differences, runs), _result_listing(found, len(numbers))]
    tracks = {each.trained.demonstrations.digest(): each.trained.demonstrations.items for each in runs}
    content = Shown(
        f"koopdqn: {len(runs)} runs of task {names[0]}",
        (f"held-out starts of seed {config.eval.seed}", f"rule: {cell.task.rule}"),
        cell.scene,
        [*sorted(motions, key=lambda motion: motion.start or 0), *shown],
        [item.poses[:, POSITION] for each in tracks.values() for item in each],
        None,
        cell.task.goal,
        listings,
    ).content()
    page = write_page(folder, content, PAGE)
    result = CompareFile(page=str(page), task=names[0], starts=numbers, runs=found, differences=differences).model_dump(
        mode="json"
    )
    write_json(folder / "compare.json", result)
    own = [*own_options(), *given_now("robot.path")]
    missing = [
        f"not evaluated: {each.label}: {shlex.join([*program(), 'eval', *own, f'run={each.folder}'])}"
        for each in found
        if not each.evaluation
    ]
    # Folders are long: in the terminal they stand above the tables, whose headings would be cut.
    named = [f"run {each.label}  {console.shown_path(Path(each.folder))}" for each in found]
    tables = [_table(listings[0]), _table(listings[1], without="folder")]
    return CommandResult(result, [*named, *tables, *missing, f"page  {console.shown_path(page)}"])


def _read(place: Path, label: str, config: Configuration) -> _Run:
    """Return the run in a folder, with its config as it was trained."""
    trusted = f"trust_modules=[{','.join(config.inputs.trust_modules)}]"
    tree = composed(as_recorded(place, config, trusted))
    # As for the first of the runs: what its config names was named by the user.
    with trusting(modules_named(plain(tree))):
        own = as_trained(with_task(Configuration.load(tree), place, keep=False), place)
        trained = read_trained(own, place)
    # As it was trained, where today's defaults or intent=FILE differ.
    known = {**plain(tree), **{name: described(getattr(own, name)) for name in ("task", "robot", "reward")}}
    known |= {"intent": described(trained.intent.settings), "trust": described(trained.intent.trust.settings)}
    # When a run stops is no part of what its policy tells.
    held = {name: trained.about[name] for name in ("agent", "feedback", "train") if name in trained.about}
    known |= {name: {**known.get(name, {}), **node} for name, node in held.items()}
    keys = _flat({key: known[key] for key in _SHAPING if key in known})
    # Who answered is no part of the config that a trained run is read with.
    asked = {item.key: str(item.value) for item in read_record(place, "a training run") if item.root == "oracle"}
    train = read_training(place)
    keys |= {**asked, "oracle": train["oracle"] or asked.get("oracle", SCRIPTED)}
    keys["corrected"] = "yes" if isinstance(trained.policy, PolicyAround) else "no"
    keys["demonstrations (SHA-256)"] = trained.demonstrations.digest()[:12]
    return _Run(label, place, own, trained, train, keys)


def _flat(node: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    found: dict[str, str] = {}
    for key, value in node.items():
        if isinstance(value, Mapping):
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = json.dumps(value, ensure_ascii=False, default=str)
    return found


def _differences(runs: Sequence[_Run]) -> list[Difference]:
    keys = dict.fromkeys(key for each in runs for key in each.keys)
    rows = {key: [each.keys.get(key, "") for each in runs] for key in keys}
    return [Difference(key=key, values=values) for key, values in rows.items() if len(set(values)) > 1]


def _starts(runs: Sequence[_Run], config: Configuration) -> tuple[list[int], Array]:
    """Return the first held-out starts (N, 7) that the arms of all runs can take, and their numbers."""
    starts = shown_starts(runs[0].trained.workcell, config.eval).starts[: config.view.starts]
    takes = [[each.trained.workcell.reachability.enter(start).joints is not None for start in starts] for each in runs]
    numbers = np.flatnonzero(np.all(takes, axis=0))
    if not len(numbers):
        raise WorkFailedError(
            f"none of the {len(starts)} starts can be taken by the arms of all runs; see view.starts="
        )
    return numbers.tolist(), starts[numbers]


def _motions(each: _Run, colour: str, numbers: Sequence[int], starts: Array, first: _Run) -> list[Motion]:
    """Return a run's paths from the starts; the arm is left out where it is another than the page's."""
    cell, limit = each.trained.workcell, each.trained.step_limit
    joints = np.array([cell.reachability.enter(start).joints for start in starts])
    references = reference_paths(cell.task, starts, limit) if each.trained.referred else [None] * len(starts)
    arms: list[Any] = [each.config.robot, first.config.robot]
    same = described(arms[0]) == described(arms[1])
    made = []
    episodes = roll_out(each.trained.policy, cell.task, cell.reachability, starts, joints, limit)
    for number, episode, reference in zip(numbers, episodes, references, strict=True):
        motion = learned_motion(f"start {number}, run {each.label}", episode, cell.task, reference)
        own = motion.joints if same else motion.joints[:0]
        name = f"{each.label}: {console.shown_path(each.folder)}"
        made.append(replace(motion, joints=own, start=number, run=name, colour=colour))
    return made


def _told(each: _Run, motions: Sequence[Motion]) -> ComparedRun:
    beside = [each.folder.parent.glob(f"*/{EVALUATION}"), each.folder.rglob(EVALUATION)]
    files = dict.fromkeys(file for part in (*beside, RUNS.rglob(EVALUATION)) for file in part)
    file, evaluation = newest_evaluation(each.folder, each.train["task"], find_evaluations(list(files))[0])
    own = [motion for motion in motions if motion.run is not None and motion.run.startswith(f"{each.label}: ")]
    return ComparedRun(
        label=each.label,
        folder=str(each.folder),
        **{key: each.train[key] for key in ("seed", "learned", "seconds", "env_steps", "oracle_queries")},
        evaluation=None if file is None else str(file),
        episodes=None if evaluation is None else evaluation["episodes"],
        success_rate=None if evaluation is None else evaluation["success_rate"],
        deviation_mm=None if evaluation is None else evaluation["path_deviation_mm"]["mean"],
        reached=sum(not motion.fails for motion in own),
    )


def _config_listing(differences: Sequence[Difference], runs: Sequence[_Run]) -> Listing:
    rows = [(each.key, *(_shortened(value or "–") for value in each.values)) for each in differences]
    count = console.counted(len(rows), "difference") if rows else "no difference"
    return Listing(f"Config: {count}", ("key", *(each.label for each in runs)), rows)


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…"


def _result_listing(found: Sequence[ComparedRun], starts: int) -> Listing:
    header = ("run", "folder", "learned", "time [s]", "actions", "questions", "success", "deviation", "reached")
    rows = []
    for each in found:
        success = "–" if each.success_rate is None else f"{console.percent(each.success_rate)} of {each.episodes}"
        deviation = "–" if each.deviation_mm is None else f"{each.deviation_mm:.1f} mm"
        rows.append(
            (
                each.label,
                console.shown_path(Path(each.folder)),
                "yes" if each.learned else "no",
                f"{each.seconds:.1f}",
                f"{each.env_steps:,}",
                f"{each.oracle_queries:,}",
                success,
                deviation,
                f"{each.reached} of {starts}",
            )
        )
    return Listing("Results", header, rows)


def _table(listing: Listing, without: str = "") -> "Table | str":
    from rich import box

    if not listing.rows:
        return listing.title
    kept = [place for place, heading in enumerate(listing.header) if heading != without]
    header, *rows = ([row[place] for place in kept] for row in (listing.header, *listing.rows))
    look: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title": listing.title}
    # What a config holds may be long, and is folded.
    made = console.table(header, rows, header, whole="words" if without else "", **look)
    for column in made.columns:
        column.overflow = "fold"
    return made
