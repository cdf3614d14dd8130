"""The page: the report's sections, rendered from its one template, and ``report.json``."""

import base64
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from koopdqn.errors import BadInputError, KoopdqnError
from koopdqn.files import write_json, write_text
from koopdqn.report import figures, tables
from koopdqn.report.data import INTENTS, Intents, Material, gather
from koopdqn.report.figures import FIGURES, REWARDS, Figure
from koopdqn.report.runs import PRESETS, TASKS, Groups, Presets
from koopdqn.report.schema import DrawnFigure, LeftOut, MissingPart, ReportFile, ShownRun
from koopdqn.report.tables import Table

PAGE: Final = "report.html"
CONTENT: Final = "report.json"
_TITLE: Final = "koopdqn: the paper's figures and tables beside ours"
_HEADINGS: Final = {"shelf": "Putting an object in a shelf", "knife": "Handing a knife to a person"}

Block = Figure | Table | MissingPart


class Section(NamedTuple):
    """A part of the page: its heading, plain texts, and what follows them."""

    heading: str
    blocks: Sequence[Block]
    paragraphs: Sequence[str] = ()


def render(title: str, sections: Sequence[Section], folder: Path, **opening: Any) -> str:
    """Return the page as HTML text; what stands between backticks in a text is shown as code.

    It will lie in the folder, beside the PNGs, and links to files are relative to that. Its opening tells of a
    ``sweep``, or of ``groups`` and what is ``missing``.
    """

    def code(text: str) -> Markup:
        return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))

    def embedded(name: str) -> str:
        return "data:image/png;base64," + base64.b64encode((folder / name).read_bytes()).decode("ascii")

    def reference(path: Path) -> str:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()

    loader = PackageLoader("koopdqn", "report")
    environment = Environment(autoescape=True, loader=loader, undefined=StrictUndefined, trim_blocks=True)
    quoted = environment.filters["urlencode"]
    environment.filters |= {"code": code, "embedded": embedded, "reference": lambda path: quoted(reference(path))}
    template = environment.get_template("page.html.j2")
    return template.render(title=title, sections=sections, **opening)


def work_units(groups: Groups) -> int:
    """Return how many units of work :func:`build` tells ``advance`` of: fits and figures."""
    return 1 + len(groups) + sum(len(INTENTS) + len(FIGURES[task]) for task in {task for task, _ in groups})


def build(
    groups: Groups,
    presets: Presets,
    intents: Mapping[str, Intents],
    left_out: Sequence[LeftOut],
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
        ablations: their file, which need not exist.
        folder: where everything goes.
        advance: called after every unit of work.

    Raises:
        BadInputError: a file cannot be written, or the ablations are damaged.
    """
    materials: dict[str, Material | str] = {}
    for task in TASKS:
        runs = next((groups[task, name] for name in PRESETS if (task, name) in groups), ())
        try:
            if runs:
                materials[task] = gather(runs[0], intents[task], folder, advance)
        except BadInputError as error:
            materials[task] = str(error)
    studies = {task: found.intents for task, found in materials.items() if isinstance(found, Material)}
    opening = figures.workflow(folder)
    advance()
    shown: list[Block] = [tables.shown_runs(groups)]
    about = []
    if left_out:
        about = [f"Finished runs or evaluations that were left out: {len(left_out)}; the second table says why."]
        shown.append(tables.left_out("Runs left out", left_out))
    sections = [
        Section("The paper's figures beside ours", [tables.comparison(groups, studies)]),
        Section("The algorithm", [opening, tables.actions(), tables.hyperparameters(presets)]),
        *(_task(task, materials.get(task), groups, folder, advance) for task in TASKS),
        Section("The human intent models", [tables.intents(studies)]),
        Section("Training and the learned policy", [tables.training(groups), tables.evaluation(groups)]),
        Section("Ablations", [tables.ablations(ablations)]),
        Section("The runs", shown, about),
    ]
    blocks = [block for section in sections for block in section.blocks]
    missing = [block for block in blocks if isinstance(block, MissingPart)]
    write_text(folder / PAGE, render(_TITLE, sections, folder, groups=groups, missing=missing))
    content = ReportFile(
        page=str(folder / PAGE),
        runs=[
            ShownRun(
                folder=str(run.folder),
                task=task,
                preset=preset,
                seed=run.seed,
                evaluation=None if run.evaluation_file is None else str(run.evaluation_file),
            )
            for (task, preset), runs in groups.items()
            for run in runs
        ],
        left_out=list(left_out),
        figures=[DrawnFigure(number=b.number, title=b.title, files=list(b.files)) for b in blocks if type(b) is Figure],
        tables=[block.title for block in blocks if isinstance(block, Table)],
        missing=missing,
    ).model_dump(mode="json")
    write_json(folder / CONTENT, content)
    return content


def _task(
    task: str, material: Material | str | None, groups: Groups, folder: Path, advance: Callable[[], None]
) -> Section:
    """Return a task's section; in place of what its figures are drawn from may stand why there is nothing."""
    curves: list[Block] = []
    for preset in PRESETS:
        if (task, preset) in groups:
            curves.append(figures.rewards(REWARDS[task], task, preset, groups[task, preset], folder))
            advance()
    if not curves:
        reason = f"It needs finished training runs of task {task}, and none was found."
        command = f"koopdqn train -m task={task} seed=0,1,2"
        curves.append(MissingPart(what=f"Figure {REWARDS[task]}", reason=reason, command=command))
    blocks: list[Block] = []
    for number, drawing in FIGURES[task].items():
        if isinstance(material, Material):
            try:
                blocks.append(drawing(material, folder))
            except KoopdqnError as error:
                blocks.append(MissingPart(what=f"Figure {number}", reason=f"{str(error)[:1].upper()}{str(error)[1:]}."))
            advance()
        else:
            command = "" if material else f"koopdqn train task={task} seed=0"
            reason = material or f"It needs a finished training run of task {task}, and none was found."
            blocks.append(MissingPart(what=f"Figure {number}", reason=reason, command=command))
        if number == REWARDS[task].replace("right", "left"):
            blocks += curves
    if not isinstance(material, Material):
        return Section(_HEADINGS[task], blocks)
    run = f"the run of seed {material.run.seed} in `{material.run.folder}`"
    return Section(_HEADINGS[task], blocks, [f"Demonstrations are those of {run}; rewards are of every seed."])
