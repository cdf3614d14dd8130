"""``koopdqn demo``, ``import`` and ``export``: demonstrations made, read from recordings, and written as CSV."""

import re
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import RenderableType

from koopdqn import console, pose
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.application import CommandResult, how_to_go_on
from koopdqn.demonstrations.csv import write_csv
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import write_hdf5
from koopdqn.demonstrations.preprocess import trim_idle_each
from koopdqn.demonstrations.reading import read_demonstrations, read_files, together
from koopdqn.demonstrations.recordings.load import MEASURED, Loaded
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.oracles.terminal.device import check_graphics, require_terminal
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.run_folder import DEMONSTRATIONS
from koopdqn.tasks.workcell import Workcell

_TRIED: Final = 1000
"""Of so many poses of a demonstration it is tried whether the arm reaches them; of fewer if that were many in all."""
_TRIED_IN_ALL: Final = 50_000
_MOST_SHOWN: Final = 100
"""Demonstrations in the table."""


def demo(config: Configuration, folder: Path) -> CommandResult:
    """Generate or record demonstrations into ``demos.hdf5`` and draw them in ``demos.png``."""
    if config.demo.source == "keyboard":
        return _recorded(config, folder)
    if config.inputs.run is not None:
        raise BadInputError(
            f"run: must name a folder of demonstrations recorded with source=keyboard, which can go on,"
            f" found source={config.demo.source} in {str(config.inputs.run)!r}"
        )
    workcell = pipeline.open_scene(config)
    made = pipeline.new_demonstrations(config, workcell)
    write_hdf5(folder / DEMONSTRATIONS, made.demonstrations)
    return _drawn(config, folder, workcell, made.demonstrations, {"redrawn": made.redrawn})


def _recorded(config: Configuration, folder: Path) -> CommandResult:
    from koopdqn.app.recording.screen import record
    from koopdqn.app.recording.session import Recording

    graphics = config.demo.keyboard.graphics
    require_terminal("source=keyboard", "use source=scripted, or koopdqn import demos=FILE for demonstrations of yours")
    check_graphics(graphics, "demo.keyboard.graphics")
    workcell = pipeline.open_scene(config)
    path, goes_on = folder / DEMONSTRATIONS, how_to_go_on("demo", folder)
    with closing(Recording(workcell, config.demo, config.inputs.seed, folder, DEMONSTRATIONS)) as recording:
        try:
            record(recording, workcell, graphics, console.shown_path(path))
        except BaseException as error:
            error.add_note(goes_on)
            raise
    moves, demonstrations = recording.recorder.state.moves, recording.demonstrations()
    if demonstrations is None:
        raise WorkFailedError(f"no demonstration was kept: e marks the end of one; {goes_on} ({moves} moves under way)")
    remarks = [f"{moves} moves are under way; {goes_on}"] if moves else []
    reached = config.task.reached(np.array([item.poses[-1] for item in demonstrations.items]))
    away = np.flatnonzero(~reached).tolist()
    if away:
        remarks.append(
            f"fit and train of task {config.task.name} refuse this file: demonstration{'s' if len(away) > 1 else ''}"
            f" {', '.join(map(str, away))} ended off the goal; task=demonstrated takes other goals"
        )
    return _drawn(config, folder, workcell, demonstrations, {"moves_under_way": moves}, remarks)


def _drawn(
    config: Configuration,
    folder: Path,
    workcell: Workcell,
    demonstrations: Demonstrations,
    more: dict[str, Any],
    remarks: Sequence[str] = (),
) -> CommandResult:
    """Draw the demonstrations and return what is told of them."""
    from koopdqn.plots.demos import plot_demonstrations

    path = folder / DEMONSTRATIONS
    paths = [item.poses[:, pose.POSITION] for item in demonstrations.items]
    image = pipeline.picture(workcell.scene, demonstrations.items[0].joints, paths)
    plot_demonstrations(folder / "demos.png", demonstrations, config.task, image)
    samples = [len(item) for item in demonstrations.items]
    result = {
        "task": config.task.name,
        "seed": config.inputs.seed,
        "source": config.demo.source,
        "demonstrations": len(demonstrations),
        "samples": samples,
        "seconds": [float(item.times[-1]) for item in demonstrations.items],
        **more,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    count = console.counted(len(demonstrations), "demonstration")
    lines = [
        f"{count} of task {config.task.name}, {sum(samples)} samples",
        *remarks,
        f"demonstrations  {console.shown_path(path)}",
        f"picture         {console.shown_path(folder / 'demos.png')}",
    ]
    return CommandResult(result, lines)


def export(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.csv``, or the path that ``run=`` learned as a robot program."""
    if config.inputs.run is not None:
        from koopdqn.app.commands.program import export_program

        return export_program(config, config.inputs.run, folder)
    sources = sources_of(config, "export")
    demonstrations = read_demonstrations(
        sources, config.chosen.name, config.robot, any_task=True, declared=config.import_
    )
    if demonstrations.placement is not None:
        console.note(f"moved back to where they were recorded: they had been {demonstrations.placement}")
        demonstrations = demonstrations.placement.undone(demonstrations)
    path = folder / "demos.csv"
    write_csv(path, demonstrations.items, config.export.rotation)
    if any(item.joints is not None for item in demonstrations.items):
        console.note("joint angles are left out: the CSV columns have no place for them")
    samples = [len(item) for item in demonstrations.items]
    result = {
        "demonstrations": len(demonstrations),
        "samples": samples,
        "rotation": config.export.rotation,
        "file": str(path),
    }
    lines = [f"{len(demonstrations)} demonstrations, {sum(samples)} samples", f"CSV  {console.shown_path(path)}"]
    return CommandResult(result, lines)


def sources_of(config: Configuration, purpose: str) -> tuple[str, ...]:
    """Return what ``demos=`` names; BadInputError if it is not given."""
    if config.inputs.demos is None:
        instead = "; run=DIR exports a learned path" if purpose == "export" else ""
        raise BadInputError(
            f"demos: must name the files to {purpose} (one, several in brackets, or a glob), found none{instead}"
        )
    return config.inputs.demos


def read_and_cut(config: Configuration, purpose: str) -> tuple[list[Loaded], Demonstrations]:
    """Return what the files of ``demos=`` hold, and their demonstrations, cut if ``import.cut`` or the user says so."""
    read = read_files(sources_of(config, purpose), config.import_, config.robot)
    cut = _is_cut(config, read)
    return read, together(read, config.chosen.name, config.robot.name, any_task=True, cut=cut)


def recognised(read: Sequence[Loaded]) -> list[str]:
    """Return lines that say what each file was recognised as, and why."""
    alike: dict[str, list[Loaded]] = {}
    for each in read:
        # Files of one logger differ in numbers alone.
        said = MEASURED.sub("", "\n".join((each.kind, *each.reasons)))
        alike.setdefault(re.sub(r"\d+ rows", "", said), []).append(each)
    lines = []
    for first, *others in alike.values():
        more = f" and {len(others)} more" if others else ""
        lines.append(f"{console.shown_path(first.path)}{more}: {first.kind}")
        lines += [f"    {reason}" for reason in first.reasons]
    return lines


def _is_cut(config: Configuration, read: Sequence[Loaded]) -> bool:
    several = [each for each in read if len(each.motions) > 1]
    for each in several:
        console.err().print(_motions(each))
    if config.import_.cut is not None or not several:
        return bool(config.import_.cut)
    if sys.stdin.isatty() and console.err().is_terminal:
        from rich.prompt import Confirm

        return Confirm.ask("Cut into the motions marked as kept?", console=console.err(), default=True)
    console.warn("taken as one demonstration each; import.cut=true cuts into these motions, import.cut=false does not")
    return False


def _motions(each: Loaded) -> RenderableType:
    rows = [
        (
            str(index),
            f"{motion.begin}…{motion.end}",
            f"{motion.item.times[-1]:.2f} s",
            f"{1e3 * motion.way:.0f} mm",
            " ".join(f"{1e3 * value:.0f}" for value in motion.item.poses[0, :3]),
            " ".join(f"{1e3 * value:.0f}" for value in motion.item.poses[-1, :3]),
            "yes" if motion.kept else "no, it ends elsewhere",
        )
        for index, motion in enumerate(each.motions)
    ]
    title = f"{console.shown_path(each.path)}: {len(rows)} motions, cut at {each.motions[0].why}"
    return console.table(
        ("motion", "rows", "time", "path", "from [mm]", "to [mm]", "kept"), rows, ("kept",), title=title
    )


def _reachable(config: Configuration, paths: Sequence[Array]) -> list[bool]:
    """Return whether the arm reaches each of several paths (N, 7): some of its poses, evenly spread."""
    tried = min(_TRIED, max(2, _TRIED_IN_ALL // len(paths)))
    some = [path[np.unique(np.linspace(0, len(path) - 1, tried).astype(int))] for path in paths]
    # All at once: a call for each path would cost more than its poses.
    poses = np.concatenate(some)
    missed = np.isnan(config.robot.inverse_batch(poses, np.tile(config.robot.home, (len(poses), 1)))).any(axis=1)
    begins = np.cumsum([0, *(len(each) for each in some[:-1])])
    return [not part for part in np.logical_or.reduceat(missed, begins).tolist()]


def import_(config: Configuration, folder: Path) -> CommandResult:
    """Write what ``demos=`` names to ``demos.hdf5``, sample for sample, and say what is in it and how it was read."""
    read, demonstrations = read_and_cut(config, "import")
    name, path = config.chosen.name, folder / DEMONSTRATIONS
    cut = trim_idle_each(demonstrations.items)
    reachable = _reachable(config, [each.item.poses for each in cut])
    lengths = [float(arc_lengths(each.item.poses[:, pose.POSITION])[-1]) for each in cut]
    turns = [float(pose.rotation_distance(each.item.poses[0], each.item.poses[-1])) for each in cut]
    samples = [len(item) for item in demonstrations.items]
    seconds = [float(item.times[-1] - item.times[0]) for item in demonstrations.items]
    write_hdf5(path, demonstrations)
    result = {
        "task": name,
        "files": [str(each.path) for each in read],
        "recognised": [{"kind": each.kind, "reasons": list(each.reasons)} for each in read],
        "demonstrations": len(demonstrations),
        "samples": samples,
        "seconds": seconds,
        "idle_before_seconds": [each.before for each in cut],
        "idle_after_seconds": [each.after for each in cut],
        "length_m": lengths,
        "turn_rad": turns,
        "reachable": reachable,
        "sha256": demonstrations.digest(),
        "file": str(path),
    }
    rows = [
        (
            str(index),
            str(samples[index]),
            f"{seconds[index]:.2f} s",
            f"{each.before:.2f} s",
            f"{each.after:.2f} s",
            f"{1e3 * lengths[index]:.0f} mm",
            f"{np.degrees(turns[index]):.1f}°",
            "yes" if reachable[index] else "NO",
        )
        for index, each in enumerate(cut[:_MOST_SHOWN])
    ]
    headings = ("demo", "samples", "time", "idle before", "after", "path", "turn", "reached")
    count = console.counted(len(demonstrations), "demonstration")
    lines: list[RenderableType] = [
        *recognised(read),
        console.table(headings, rows, (), title=f"{count} for task {name}"),
        *([f"and {len(cut) - _MOST_SHOWN} more, which --json lists"] if len(cut) > _MOST_SHOWN else []),
        "idle ends are kept in the file; learning cuts them off",
        f"demonstrations  {console.shown_path(path)}",
    ]
    if not all(reachable):
        console.warn(f"{config.robot.name} cannot reach every pose of demonstration {reachable.index(False)}")
    return CommandResult(result, lines)
