"""``koopdqn feedback``: look at journals of answers, and repair them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from koopdqn import console
from koopdqn.artifact import read_artifact
from koopdqn.errors import BadInputError
from koopdqn.oracles import repair
from koopdqn.oracles.journal import JOURNAL, FeedbackSummary, Record, Records, read_records
from koopdqn.oracles.repair import summarised
from koopdqn.oracles.wording import SHORT, verdict
from koopdqn.run_folder import check_plain, locked


def journal_path(given: Path) -> Path:
    """Return the journal that a file or a run folder names.

    Raises:
        BadInputError: there is none, or it is reached by a link within the folder.
    """
    if given.is_dir():
        check_plain(given)
    path = given / JOURNAL if given.is_dir() else given
    if path.is_symlink():
        raise BadInputError(f"journal: must be a file, found a link: {path}")
    if not path.is_file():
        raise BadInputError(f"journal: must name a journal or a run folder that holds {JOURNAL}, found {str(given)!r}")
    return path


def show(journals: Sequence[Path]) -> FeedbackSummary:
    """Print every answer of some journals, and return their figures."""
    paths = [journal_path(given) for given in journals]
    read = [read_records(path) for path in paths]
    for path, records in zip(paths, read, strict=True):
        console.say(_answers(console.shown_path(path), records))
    summary = summarised(read)
    console.say(_teachers(summary))
    if summary.agreement:
        console.say(_agreement(summary))
    console.say(f"{summary.answers} answers, {summary.withdrawn} withdrawn, {summary.edited} edited")
    return summary


def figures(journals: Sequence[Path]) -> dict[str, Any]:
    """Return the figures of some journals as JSON values."""
    return summarised([read_records(journal_path(given)) for given in journals]).model_dump(mode="json")


def edit(journal: Path, number: int, answer: str, teacher: str | None, *, drop_later: bool) -> None:
    """Change an answer and say what it is now, and what that means for the run."""
    path = journal_path(journal)
    with locked(path.parent):
        learned = _learned_answers(path.parent) if path.name == JOURNAL else 0
        item = repair.edit(path, number, answer, teacher, learned, drop_later=drop_later)
    dropped = "; later answers no longer count" if drop_later else ""
    console.say(f"answer {number} is now {_verdict(item)}, by {item.line.source}{dropped}")
    if number < learned:
        console.warn(
            f"the run in {console.shown_path(path.parent)} has learned from answer {number} already and cannot go on;"
            " train anew with oracle=replay and this journal, or with oracle=terminal and it to answer what is new"
        )
    elif not drop_later and number + 1 < len(read_records(path).items):
        console.note("later answers may be to other questions than the run now asks; --drop-later asks them anew")


def merge(journals: Sequence[Path], out: Path) -> None:
    """Merge journals into a new one and say what became of them."""
    merged = repair.merge([journal_path(given) for given in journals], out)
    console.say(
        f"{merged.answers} answers, {merged.opinions} opinions of others on them, {merged.changed} changed by the"
        f" majority; {merged.left_out} answers to other questions left out"
    )
    console.say(f"journal  {console.shown_path(out)}")


def _learned_answers(folder: Path) -> int:
    """Return how many answers the run in a folder has learned from; 0 if it holds none."""
    # It loads torch, which journals elsewhere need not wait for.
    from koopdqn.rl.checkpoint import KIND, checkpoint_path, questions_asked

    path = checkpoint_path(folder)
    if not path.exists():
        return 0
    return questions_asked(read_artifact(path, KIND))


def _answers(title: str, records: Records) -> Table:
    table = Table(title=title, title_justify="left")
    for head in ("number", "episode", "step", "action", "answer", "teacher", "seconds", ""):
        table.add_column(head, justify="right" if head in ("number", "episode", "step", "seconds") else "left")
    for item in records.items:
        line = item.line
        style = "dim" if item.withdrawn else None
        cells = (str(line.number), str(line.episode), str(line.step), SHORT[line.action], _verdict(item), line.source)
        table.add_row(*cells, f"{line.seconds:.1f}", _remarks(item), style=style)
    return table


def _verdict(item: Record) -> str:
    better = item.line.better
    return verdict(item.line.right) + (f" (better {SHORT[better]})" if better is not None else "")


def _remarks(item: Record) -> str:
    remarks = ["withdrawn"] * item.withdrawn + ["edited"] * item.edited
    remarks += [f"{opinion.source}: {verdict(opinion.right)}" for opinion in item.opinions]
    return ", ".join(remarks)


def _teachers(summary: FeedbackSummary) -> Table:
    table = Table(title="Teachers", title_justify="left")
    for head in ("teacher", "answers", "right", "wrong", "skipped", "better named", "median s"):
        table.add_column(head, justify="left" if head == "teacher" else "right")
    for item in summary.teachers:
        counts = (item.answers, item.right, item.wrong, item.skipped, item.better)
        table.add_row(item.name, *map(str, counts), f"{item.median_seconds:.1f}")
    return table


def _agreement(summary: FeedbackSummary) -> Table:
    table = Table(title="Agreement", title_justify="left")
    for head in ("teacher", "teacher", "same questions", "same answer", "share"):
        table.add_column(head, justify="left" if head == "teacher" else "right")
    for item in summary.agreement:
        table.add_row(item.one, item.other, str(item.questions), str(item.same), f"{item.share:.0%}")
    return table
