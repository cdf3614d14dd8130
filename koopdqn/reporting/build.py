"""Building the report: material, figures and tables become sections, and these a page."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from koopdqn.errors import BadInputError
from koopdqn.files import write_json, write_text
from koopdqn.reporting import drawing
from koopdqn.reporting.content import Block, Cell, Figure, Missing, Section, Table
from koopdqn.reporting.groups import DEFAULT, PAPER, TASKS, Groups, Presets
from koopdqn.reporting.html import page
from koopdqn.reporting.intents import INTENTS
from koopdqn.reporting.material import Intents, Material, gather
from koopdqn.reporting.paper import actions_table, comparison_table, hyperparameters_table
from koopdqn.reporting.runs import Skipped
from koopdqn.reporting.schema import ReportFile
from koopdqn.reporting.tables import (
    Studies,
    ablations_table,
    evaluation_table,
    intents_table,
    runs_table,
    training_table,
)

PAGE: Final = "report.html"
CONTENT: Final = "report.json"
_TITLE: Final = "koopdqn: the paper's figures and tables beside ours"
_REWARDS: Final = {"shelf": "4, right", "knife": "9, right"}
_FIGURES: Final = {"shelf": drawing.SHELF, "knife": drawing.KNIFE}
_HEADINGS: Final = {"shelf": "Putting an object in a shelf", "knife": "Handing a knife to a person"}


def work_units(groups: Groups) -> int:
    """Return how many units of work :func:`build` tells ``advance`` of: fits and figures."""
    tasks = [task for task in TASKS if any(place[0] == task for place in groups)]
    return 1 + len(groups) + sum(len(INTENTS) + len(_FIGURES[task]) for task in tasks)


def build(
    groups: Groups,
    presets: Presets,
    intents: Mapping[str, Intents],
    left_out: Sequence[Skipped],
    ablations: Path,
    folder: Path,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Write ``report.html``, ``report.json``, the PNGs and the fits into a folder and return the content of the JSON.

    Args:
        groups: the runs to show.
        presets: both presets for both tasks.
        intents: what is fitted to the demonstrations, by task.
        left_out: runs that were found and are not shown.
        ablations: the file of ablations, which need not exist.
        folder: where everything goes.
        advance: called after every unit of work.

    Raises:
        BadInputError: a file cannot be written, or the ablations are damaged.
    """
    materials, problems = {}, {}
    for task in TASKS:
        own = {name: groups[place] for place in groups for name in [place[1]] if place[0] == task}
        own = {name: own[name] for name in (DEFAULT, PAPER) if name in own}
        try:
            if own:
                materials[task] = gather(own, intents[task], folder, advance)
        except BadInputError as error:
            problems[task] = str(error)
    opening = drawing.workflow(folder)
    advance()
    studies: Studies = {task: material.studies for task, material in materials.items()}
    sections = [
        Section("The paper's figures beside ours", blocks=(comparison_table(groups, studies),)),
        Section("The algorithm", blocks=(opening, actions_table(), hyperparameters_table(presets))),
        *(_task(task, materials.get(task), problems.get(task, ""), groups, folder, advance) for task in TASKS),
        Section("The human intent models", blocks=(_intents(studies),)),
        Section("Training and the learned policy", blocks=(training_table(groups), evaluation_table(groups))),
        Section("Ablations", blocks=(ablations_table(ablations),)),
        Section("The runs", _about_left_out(left_out), (runs_table(groups), *_left_out(left_out))),
    ]
    path = folder / PAGE
    missing = [block for section in sections for block in section.blocks if isinstance(block, Missing)]
    write_text(path, page(_TITLE, _introduction(groups, missing), sections, folder))
    content = _content(path, groups, left_out, sections)
    write_json(folder / CONTENT, content)
    return content


def _task(
    task: str, material: Material | None, problem: str, groups: Groups, folder: Path, advance: Callable[[], None]
) -> Section:
    blocks: list[Block] = []
    drawn: dict[str, Block] = {}
    for what, function in _FIGURES[task]:
        if material is None:
            command = "" if problem else f"koopdqn train task={task} seed=0"
            reason = problem or f"It needs a finished training run of task {task}, and none was found."
            drawn[what] = Missing(what, reason, command)
        else:
            drawn[what] = drawing.draw(what, function, material, folder)
            advance()
    shown = [groups[task, name] for name in (DEFAULT, PAPER) if (task, name) in groups]
    curves: list[Block] = []
    for group in shown:
        curves.append(drawing.rewards(_REWARDS[task], group, folder))
        advance()
    if not shown:
        needs = f"It needs finished training runs of task {task}, and none was found."
        curves.append(Missing(f"Figure {_REWARDS[task]}", needs, f"koopdqn train -m task={task} seed=0,1,2"))
    for what, block in drawn.items():
        blocks.append(block)
        if what == f"Figure {_REWARDS[task].replace('right', 'left')}":
            blocks += curves
    paragraphs = []
    if material is not None:
        folder_of = material.run.folder
        paragraphs.append(
            f"Demonstrations are those of the run of seed {material.run.seed} in `{folder_of}`; rewards are of every"
            " seed."
        )
    return Section(_HEADINGS[task], tuple(paragraphs), tuple(blocks))


def _intents(studies: Studies) -> Block:
    if studies:
        return intents_table(studies)
    return Missing("The table of intents", "It needs demonstrations that allow a fit, and none were found.")


def _introduction(groups: Groups, missing: Sequence[Missing]) -> list[str]:
    counted = ", ".join(
        f"{len(group.runs)} {'run' if len(group.runs) == 1 else 'runs'} of {group.task} ({group.preset} preset)"
        for group in groups.values()
    )
    texts = [
        "Sinha & Wang (2022), “Koopman Operator–Based Knowledge-Guided Reinforcement Learning for Safe Human–Robot"
        " Interaction”, Front. Robot. AI 9:779194, teach a robot arm a path from demonstrations: a Koopman model of the"
        " person's intent gives the reward of a deep Q-network where it can be trusted; elsewhere a person is asked."
        " This page redraws the paper's figures and tables from runs of koopdqn. No curve of the paper's is copied:"
        " what stands beside ours are the numbers of its text.",
        f"Shown: {counted}. The person in these runs is a scripted demonstrator and the arm a simulated UR5. Every"
        " number links to the file it came from; small raised marks lead to one file a seed.",
    ]
    if missing:
        texts.append(
            f"Missing here: {'; '.join(block.what for block in missing)}. Each says in its place what makes it."
        )
    return texts


def _about_left_out(left_out: Sequence[Skipped]) -> tuple[str, ...]:
    if not left_out:
        return ()
    return (f"{len(left_out)} finished runs or evaluations were found and left out; the second table says why.",)


def _left_out(left_out: Sequence[Skipped]) -> tuple[Table, ...]:
    if not left_out:
        return ()
    rows = tuple((Cell(str(item.folder)), Cell(item.reason)) for item in left_out)
    return (Table("Runs left out", "Found, and not shown.", ("folder", "reason"), rows),)


def _content(path: Path, groups: Groups, left_out: Sequence[Skipped], sections: Sequence[Section]) -> dict[str, Any]:
    blocks = [block for section in sections for block in section.blocks]
    content = {
        "page": str(path),
        "runs": [
            {
                "folder": str(run.folder),
                "task": group.task,
                "preset": group.preset,
                "seed": run.seed,
                "evaluation": None if run.evaluation_file is None else str(run.evaluation_file),
            }
            for group in groups.values()
            for run in group.runs
        ],
        "left_out": [{"folder": str(item.folder), "reason": item.reason} for item in left_out],
        "figures": [
            {"number": b.number, "title": b.title, "files": [panel.file.name for panel in b.panels]}
            for b in blocks
            if isinstance(b, Figure)
        ],
        "tables": [block.title for block in blocks if isinstance(block, Table)],
        "missing": [
            {"what": b.what, "reason": b.reason, "command": b.command} for b in blocks if isinstance(b, Missing)
        ],
    }
    return ReportFile.model_validate(content).model_dump(mode="json")
