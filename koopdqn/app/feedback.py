"""``koopdqn feedback``: look at journals of answers, and repair them."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from koopdqn import console
from koopdqn.app.exit_status import guard
from koopdqn.errors import BadInputError
from koopdqn.run_folder import INTENT, JOURNAL, check_plain, locked

if TYPE_CHECKING:
    from rich.table import Table

    from koopdqn.oracles.journal import Record, Records
    from koopdqn.oracles.repair import FeedbackSummary

# What loads NumPy or torch is imported where it is used: the command line's help must not wait for it.
feedback_app = typer.Typer(
    help="Look at journals of answers, and repair them.", rich_markup_mode="rich", no_args_is_help=True
)
AsJson = Annotated[bool, typer.Option("--json", help="Print the figures as JSON to standard output and nothing else.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
_NARROW = 80
"""Columns below which a table leaves out what tells where in the training an answer was given."""
_A_JOURNAL = "A journal (feedback.jsonl), or a run folder that holds one."
Journals = Annotated[list[Path], typer.Argument(metavar="JOURNAL...", help=_A_JOURNAL, show_default=False)]


@feedback_app.command("show")
def _show(journals: Journals, as_json: AsJson = False, debug: Debug = False) -> int:
    """Show every answer, who gave it, and how far teachers agree."""
    return guard(lambda: show(journals, as_json=as_json), debug=debug)


@feedback_app.command("edit")
def _edit(
    journal: Annotated[Path, typer.Argument(metavar="JOURNAL", help=_A_JOURNAL, show_default=False)],
    number: Annotated[int, typer.Argument(help="Number of the answer, as show prints it.", show_default=False)],
    answer: Annotated[
        str,
        typer.Argument(
            help="right, wrong, skip, or the better action: 0 to 9, with continuous actions m: the model's suggestion.",
            show_default=False,
        ),
    ],
    teacher: Annotated[
        str | None, typer.Option("--teacher", metavar="NAME", help="Who changes it; editor if nobody is named.")
    ] = None,
    drop_later: Annotated[bool, typer.Option("--drop-later", help="Later answers no longer count.")] = False,
    debug: Debug = False,
) -> int:
    """Change an answer; the journal keeps the old one and gets a new line."""
    return guard(lambda: edit(journal, number, answer, teacher, drop_later=drop_later), debug=debug)


@feedback_app.command("merge")
def _merge(
    journals: Journals,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The new journal.", show_default=False)],
    debug: Debug = False,
) -> int:
    """Write the first journal anew with what others answer to the same questions; the majority's answer stands."""
    return guard(lambda: merge(journals, out), debug=debug)


def journal_path(given: Path) -> Path:
    """Return the journal that a file or a run folder names.

    Raises:
        BadInputError: there is none, or it is reached by a link within the folder.
    """
    # Other commands are given runs so.
    given = Path(str(given).removeprefix("run="))
    if given.is_dir():
        check_plain(given)
    path = given / JOURNAL if given.is_dir() else given
    if path.is_symlink():
        raise BadInputError(f"journal: must be a file, found a link: {path}")
    if not path.is_file():
        raise BadInputError(f"journal: must name a journal or a run folder that holds {JOURNAL}, found {str(given)!r}")
    return path


def show(journals: Sequence[Path], *, as_json: bool) -> int:
    """Print every answer of some journals and their figures, or the figures alone as JSON; return 0."""
    from koopdqn.oracles.journal import read_records
    from koopdqn.oracles.repair import summarise

    paths = [journal_path(given) for given in journals]
    read = [read_records(path) for path in paths]
    summary = summarise(read)
    if as_json:
        typer.echo(json.dumps(summary.model_dump(mode="json"), indent=2, sort_keys=True))
        return 0
    for path, records in zip(paths, read, strict=True):
        console.say(_answers(console.shown_path(path), records))
    for table in _tables(summary):
        console.say(table)
    console.say(f"{summary.answers} answers, {summary.withdrawn} withdrawn, {summary.edited} edited")
    return 0


def edit(journal: Path, number: int, answer: str, teacher: str | None, *, drop_later: bool) -> int:
    """Change an answer, say what it is now and what that means for the run, and return 0."""
    from koopdqn.oracles import repair
    from koopdqn.oracles.journal import read_records

    path = journal_path(journal)
    with locked(path.parent):
        learned = _learned_answers(path.parent) if path.name == JOURNAL else 0
        _check_allowed(path.parent, answer)
        item = repair.edit(path, number, answer, teacher, learned, drop_later=drop_later)
    dropped = "; later answers no longer count (with oracle=file name new files)" if drop_later else ""
    console.say(f"answer {number} is now {_verdict(item)}, by {item.line.source}{dropped}")
    if number < learned:
        console.warn(
            f"the run in {console.shown_path(path.parent)} has learned from answer {number} already and cannot go on;"
            " train anew with oracle=replay and this journal, or with oracle=terminal and it to answer what is new;"
            " where later answers are to other questions than are then asked, --drop-later asks them anew"
        )
    elif not drop_later and number + 1 < len(read_records(path).items):
        console.note("later answers may be to other questions than the run now asks; --drop-later asks them anew")
    return 0


def merge(journals: Sequence[Path], out: Path) -> int:
    """Merge journals into a new one, say what became of them, and return 0."""
    from koopdqn.oracles import repair

    merged = repair.merge([journal_path(given) for given in journals], out)
    console.say(
        f"{merged.answers} answers, {merged.opinions} opinions of others on them, {merged.changed} changed by the"
        f" majority; {merged.left_out} answers to other questions left out"
    )
    console.say(f"journal  {console.shown_path(out)}")
    return 0


def _check_allowed(folder: Path, answer: str) -> None:
    """Raise BadInputError if an answer names an action of Table 1 that the task of a folder's run never allows."""
    import numpy as np

    from koopdqn.artifact import read_artifact, reading
    from koopdqn.settings import load_settings
    from koopdqn.tasks.actions import legal_actions
    from koopdqn.tasks.task import Task

    intent = folder / INTENT
    if not (len(answer) == 1 and answer.isdecimal() and intent.is_file()):
        return
    about = read_artifact(intent, "intent").about
    with reading(f"intent {intent}"):
        legal = legal_actions(load_settings(about["task"], Task, "task"))
    if not legal[int(answer)]:
        valid = ", ".join(map(str, np.flatnonzero(legal)))
        raise BadInputError(f"answer: must be an action that can be right in the run's task, {valid}, found {answer}")


def _learned_answers(folder: Path) -> int:
    """Return how many answers the run in a folder has learned from; 0 if it holds none."""
    from koopdqn.rl.checkpoint import latest_checkpoint, questions_asked

    return questions_asked(latest_checkpoint(folder))


def _answers(title: str, records: "Records") -> "Table":
    from koopdqn.oracles.terminal.screen import SHORT, verdict

    def remarks(item: "Record") -> str:
        opinions = (f"{opinion.source}: {verdict(opinion.right)}" for opinion in item.opinions)
        return ", ".join([*["withdrawn"] * item.withdrawn, *["edited"] * item.edited, *opinions])

    left = ("action", "answer", "teacher", "")
    columns: tuple[str, ...] = ("number", "episode", "step", "action", "answer", "teacher", "seconds", "")
    if console.out().width < _NARROW:
        columns = ("number", *left)
    table = console.table(columns, (), left, title=title, title_justify="left")
    for item in records.items:
        line = item.line
        cells = {
            "number": str(line.number),
            "episode": str(line.episode),
            "step": str(line.step),
            "action": SHORT[line.action],
            "answer": _verdict(item),
            "teacher": line.source,
            "seconds": f"{line.seconds:.1f}",
            "": remarks(item),
        }
        table.add_row(*(cells[column] for column in columns), style="dim" if item.withdrawn else None)
    return table


def _verdict(item: "Record") -> str:
    from koopdqn.oracles.terminal.screen import SHORT, verdict

    better = item.line.better
    return verdict(item.line.right) + (f" (better {SHORT[better]})" if better is not None else "")


def _tables(summary: "FeedbackSummary") -> "Iterable[Table]":
    """Yield the figures of teachers, and how far they agree where several answered the same questions."""
    headings: tuple[str, ...] = ("teacher", "answers", "right", "wrong", "skipped", "better named", "median s")
    rows: list[tuple[str, ...]] = []
    for each in summary.teachers:
        counts = (each.answers, each.right, each.wrong, each.skipped, each.better)
        rows.append((each.name, *map(str, counts), f"{each.median_seconds:.1f}"))
    yield console.table(headings, rows, ("teacher",), title="Teachers", title_justify="left")
    if summary.agreement:
        headings = ("teacher", "teacher", "same questions", "same answer", "share")
        rows = [(a.one, a.other, str(a.questions), str(a.same), f"{a.share:.0%}") for a in summary.agreement]
        yield console.table(headings, rows, ("teacher",), title="Agreement", title_justify="left")
