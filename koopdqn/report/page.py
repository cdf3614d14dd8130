"""The page: one HTML file that holds its style and its pictures, needs no script, and prints; building it."""

import base64
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final
from urllib.parse import quote

from koopdqn.errors import BadInputError
from koopdqn.files import write_json, write_text
from koopdqn.report import drawing
from koopdqn.report.blocks import Block, Cell, Figure, Missing, Panel, Section, Table
from koopdqn.report.groups import DEFAULT, PAPER, TASKS, Groups, Presets
from koopdqn.report.intents import INTENTS
from koopdqn.report.material import Intents, Material, gather
from koopdqn.report.numbers import Studies, ablations_table, evaluation_table, intents_table, runs_table, training_table
from koopdqn.report.paper import actions_table, comparison_table, hyperparameters_table
from koopdqn.report.runs import ReportFile, Skipped

_STYLE: Final = """
:root { --ink: #222; --soft: #5b616a; --line: #d9dde3; --tint: #f6f7f9; --link: #00548a; }
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; scroll-behavior: smooth; }
body { margin: 0 auto; padding: 1.5rem 1rem 4rem; max-width: 72rem; color: var(--ink); background: #fff;
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .4rem; }
h2 { font-size: 1.3rem; margin: 2.8rem 0 .6rem; padding-top: .5rem; border-top: 2px solid var(--line); }
h3 { font-size: 1.05rem; margin: 1.8rem 0 .5rem; }
p { margin: .6rem 0; max-width: 46rem; }
a { color: var(--link); overflow-wrap: anywhere; }
nav { background: var(--tint); border: 1px solid var(--line); border-radius: .5rem; padding: .7rem 1.1rem;
  margin: 1.2rem 0; }
nav ol { margin: .2rem 0; padding-left: 1.3rem; columns: 2 18rem; }
nav li { margin: .15rem 0; break-inside: avoid; }
figure { margin: 1.2rem 0 2.2rem; }
.panels, .pair { display: grid; gap: .8rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
img { display: block; width: 100%; height: auto; border: 1px solid var(--line); border-radius: .35rem; }
.wide { max-width: 56rem; }
.narrow { max-width: 38rem; }
figcaption, .note { color: var(--soft); font-size: .92rem; margin-top: .5rem; max-width: 56rem; }
figcaption b, .note b { color: var(--ink); }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: .92rem; width: 100%; }
th, td { padding: .38rem .6rem; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
thead th { background: var(--tint); border-bottom: 2px solid var(--line); }
tbody th { font-weight: 500; }
td { font-variant-numeric: tabular-nums; }
sup { white-space: nowrap; }
sup a { margin-left: .15rem; }
.missing { border-left: .3rem solid #d55e00; background: #fdf4ee; padding: .6rem .9rem; margin: 1rem 0;
  border-radius: .25rem; }
code { font: .9em ui-monospace, SFMono-Regular, Menlo, "DejaVu Sans Mono", monospace; background: var(--tint);
  padding: .05rem .3rem; border-radius: .25rem; overflow-wrap: anywhere; }
footer { margin-top: 3rem; color: var(--soft); font-size: .88rem; }
@media (max-width: 40rem) { th, td { padding: .3rem .4rem; } table { font-size: .85rem; } }
@media print { body { max-width: none; padding: 0; font-size: 10pt; } nav { break-after: page; }
  figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; } a { color: inherit; text-decoration: none; } }
"""


def page(title: str, introduction: Sequence[str], sections: Sequence[Section], folder: Path) -> str:
    """Return the page as HTML text.

    Args:
        title: of the page.
        introduction: plain paragraphs before the table of contents.
        sections: what follows it.
        folder: where the page will lie; links to files are relative to it.
    """
    contents = "".join(f'<li><a href="#{_anchor(s.heading)}">{escape(s.heading)}</a></li>' for s in sections)
    body = "\n".join(_section(section, folder) for section in sections)
    opening = "".join(f"<p>{_text(paragraph)}</p>" for paragraph in introduction)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f"<header><h1>{escape(title)}</h1>{opening}</header>\n"
        f'<nav aria-label="Contents"><b>Contents</b><ol>{contents}</ol></nav>\n<main>\n{body}\n</main>\n'
        "<footer>Made by <code>koopdqn report</code>. Links lead to the files that the numbers came from, as they lay"
        " when the page was made.</footer>\n</body>\n</html>\n"
    )


def _section(section: Section, folder: Path) -> str:
    paragraphs = "".join(f"<p>{_text(paragraph)}</p>" for paragraph in section.paragraphs)
    blocks = "\n".join(_row(row, folder) for row in _rows(section.blocks))
    return (
        f'<section id="{_anchor(section.heading)}"><h2>{escape(section.heading)}</h2>{paragraphs}\n{blocks}</section>'
    )


def _rows(blocks: Sequence[Block]) -> list[list[Block]]:
    """Return blocks in rows: figures that belong beside each other share one."""
    rows: list[list[Block]] = []
    for block in blocks:
        last = rows[-1] if rows else []
        if last and _beside(block) and _beside(block) == _beside(last[-1]):
            last.append(block)
        else:
            rows.append([block])
    return rows


def _beside(block: Block) -> str:
    return block.beside if isinstance(block, Figure) else ""


def _row(row: Sequence[Block], folder: Path) -> str:
    text = "".join(_block(block, folder) for block in row)
    return f'<div class="pair">{text}</div>' if len(row) > 1 else text


def _block(block: Block, folder: Path) -> str:
    if isinstance(block, Figure):
        return _figure(block, folder)
    return _table(block, folder) if isinstance(block, Table) else _missing(block)


def _figure(figure: Figure, folder: Path) -> str:
    kind = "panels" if len(figure.panels) > 1 or figure.beside else f"panels {'wide' if figure.wide else 'narrow'}"
    panels = "".join(_panel(panel) for panel in figure.panels)
    data = f" Data: {_links(figure.sources, folder)}." if figure.sources else ""
    name = f"Figure {figure.number}"
    return (
        f'<figure id="{_anchor(name)}"><div class="{kind}">{panels}</div>'
        f"<figcaption><b>{escape(name)}. {escape(figure.title)}.</b> {_text(figure.caption)}{data}</figcaption>"
        "</figure>"
    )


def _panel(panel: Panel) -> str:
    data = base64.b64encode(panel.file.read_bytes()).decode("ascii")
    return f'<img src="data:image/png;base64,{data}" alt="{escape(panel.alt)}">'


def _table(table: Table, folder: Path) -> str:
    header = "".join(f'<th scope="col">{escape(name)}</th>' for name in table.header)
    rows = "".join(
        f'<tr><th scope="row">{_cell(row[0], folder)}</th>'
        + "".join(f"<td>{_cell(cell, folder)}</td>" for cell in row[1:])
        + "</tr>"
        for row in table.rows
    )
    return (
        f"<h3>{escape(table.title)}</h3>"
        f'<div class="scroll"><table><thead><tr>{header}</tr></thead><tbody>{rows}</tbody></table></div>'
        f'<p class="note">{_text(table.caption)}</p>'
    )


def _missing(missing: Missing) -> str:
    command = f" <code>{escape(missing.command)}</code> makes it." if missing.command else ""
    return f'<div class="missing"><b>{escape(missing.what)} is missing.</b> {_text(missing.reason)}{command}</div>'


def _cell(cell: Cell, folder: Path) -> str:
    if not cell.sources:
        return _text(cell.text)
    if len(cell.sources) == 1:
        return f'<a href="{_reference(cell.sources[0], folder)}">{escape(cell.text)}</a>'
    marks = "".join(
        f'<a href="{_reference(source, folder)}" title="{escape(str(source))}">{index}</a>'
        for index, source in enumerate(cell.sources, 1)
    )
    return f"{escape(cell.text)}<sup>{marks}</sup>"


def _links(sources: Iterable[Path], folder: Path) -> str:
    return ", ".join(f'<a href="{_reference(path, folder)}">{escape(_short(path))}</a>' for path in sources)


def _short(path: Path) -> str:
    """Return a file's name with its folder's, by which people tell runs apart."""
    return "/".join(path.parts[-2:])


def _reference(path: Path, folder: Path) -> str:
    return quote(Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix())


def _text(text: str) -> str:
    """Return a plain text as HTML, what stands between backticks as code."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))


def _anchor(heading: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", heading.lower()).strip("-")


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
