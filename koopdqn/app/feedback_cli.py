"""``koopdqn feedback``: its commands for the command line."""

import json
from pathlib import Path
from typing import Annotated

import typer

from koopdqn.app.exit_status import guard

feedback_app = typer.Typer(
    help="Look at journals of answers, and repair them.", rich_markup_mode="rich", no_args_is_help=True
)
AsJson = Annotated[bool, typer.Option("--json", help="Print the figures as JSON to standard output and nothing else.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")]
_A_JOURNAL = "A journal (feedback.jsonl), or a run folder that holds one."
Journals = Annotated[list[Path], typer.Argument(metavar="JOURNAL...", help=_A_JOURNAL, show_default=False)]


@feedback_app.command("show")
def _show(journals: Journals, as_json: AsJson = False, debug: Debug = False) -> int:
    """Show every answer, who gave it, and how far teachers agree."""

    def work() -> int:
        from koopdqn.app.commands import feedback

        if as_json:
            typer.echo(json.dumps(feedback.figures(journals), indent=2, sort_keys=True))
        else:
            feedback.show(journals)
        return 0

    return guard(work, debug=debug)


@feedback_app.command("edit")
def _edit(
    journal: Annotated[Path, typer.Argument(metavar="JOURNAL", help=_A_JOURNAL, show_default=False)],
    number: Annotated[int, typer.Argument(help="Number of the answer, as show prints it.", show_default=False)],
    answer: Annotated[
        str,
        typer.Argument(help="right, wrong, skip, or 0 to 9: the better action.", show_default=False),
    ],
    teacher: Annotated[str | None, typer.Option("--teacher", metavar="NAME", help="Who changes it.")] = None,
    drop_later: Annotated[bool, typer.Option("--drop-later", help="Later answers no longer count.")] = False,
    debug: Debug = False,
) -> int:
    """Change an answer; the journal keeps the old one and gets a new line."""

    def work() -> int:
        from koopdqn.app.commands import feedback

        feedback.edit(journal, number, answer, teacher, drop_later=drop_later)
        return 0

    return guard(work, debug=debug)


@feedback_app.command("merge")
def _merge(
    journals: Journals,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="The new journal.", show_default=False)],
    debug: Debug = False,
) -> int:
    """Write the first journal anew with what others answer to the same questions; the majority's answer stands."""

    def work() -> int:
        from koopdqn.app.commands import feedback

        feedback.merge(journals, out)
        return 0

    return guard(work, debug=debug)
