"""The two terminals: results on standard output, messages and progress on standard error."""

import time
import unicodedata
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.segment import Segment, Segments
from rich.text import Text

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table


# Control characters, those that turn the direction of a text or cannot be seen, and other ends of lines.
_UNSEEN: Final = ("Cc", "Cf", "Cs", "Zl", "Zp")
# Between letters of some scripts, and in emoji.
_JOINERS: Final = "\u200c\u200d"
# What stands for signs of tables where the output is not UTF-8.
_PLAIN: Final = str.maketrans({"–": "-", "−": "-", "…": "...", "°": "deg"})
# Wider than any table [columns].
_WIDEST: Final = 1000


def visible(text: str) -> str:
    """Return a text with every character written out that a terminal would obey rather than show, but for line ends."""
    if text.isprintable():
        return text
    return "".join(
        each
        if each in "\n\t" or each in _JOINERS or unicodedata.category(each) not in _UNSEEN
        else each.encode("unicode_escape").decode()
        for each in text
    )


class LiteralConsole(Console):
    """A console that shows names of users as they are: it knows no markup, and no control characters of a text."""

    def __init__(self, **options: Any) -> None:
        """Make one; ``options`` are Rich's."""
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """Return a text as Rich shows it; what the output cannot show is replaced before Rich measures it."""
        text = visible(text)
        if not self.encoding.startswith("utf"):
            text = text.translate(_PLAIN).encode(self.encoding, "backslashreplace").decode(self.encoding)
        return super().render_str(text, **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield what a renderable is made of; only Rich's own control sequences remain such."""
        # Rich's own sign of a cut cell; a line that is not laid out may hold it in a name.
        cut = not self.encoding.startswith("utf") and (options is None or options.overflow != "ignore")
        for segment in super().render(renderable, options):
            text = segment.text.replace("…", ".") if cut else segment.text
            if segment.control or (text == segment.text and text.isprintable()):
                yield segment
            else:
                yield Segment(visible(text), segment.style)


@cache
def out() -> Console:
    """Return the console of standard output: results for people."""
    return LiteralConsole()


@cache
def err() -> Console:
    """Return the console of standard error: messages, progress and questions."""
    return LiteralConsole(stderr=True)


def say(line: RenderableType) -> None:
    """Print one line of a result; a text is taken literally and never wrapped, and what is ``whole`` never cut."""
    console = out()
    if isinstance(line, str):
        console.print(_literal(line), soft_wrap=True)
        return
    least = Measurement.get(console, console.options.update(width=_WIDEST), line).minimum
    if least > console.width and all(column.min_width for column in getattr(line, "columns", [])):
        # Nothing in it may be cut, so that the terminal goes on in its next line.
        line = Segments(console.render(line, console.options.update(width=least)))
    console.print(line, crop=False)


def note(message: str) -> None:
    """Print a short message on standard error, literally and in one line."""
    err().print(_literal(_one_line(message)), soft_wrap=True)


def warn(message: str) -> None:
    """Print a warning on standard error in one line."""
    _tagged("warning", "bold yellow", message)


def fail(message: str) -> None:
    """Print an error on standard error in one line: ``koopdqn: error: …``."""
    _tagged("error", "bold red", message)


class Stage:
    """A stage of long work, shown as a bar on a terminal and as two short lines elsewhere.

    Attributes:
        note: what the last line of the stage adds (a figure, a reason); may be set while it runs.
    """

    def __init__(self, bar: "Progress | None" = None, task: "TaskID | None" = None) -> None:
        """Make a stage; use `stage` instead."""
        self.note = ""
        self._bar = bar
        self._task = task

    def advance(self, steps: float = 1.0, note: str | None = None) -> None:
        """Count ``steps`` more as done, and change the note shown beside the bar if one is given."""
        if note is not None:
            self.note = _one_line(note)
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, advance=steps, note=self.note)


@contextmanager
def stage(description: str, total: float | None = None, *, bar: bool = True) -> Iterator[Stage]:
    """Show a stage of long work on standard error while the block runs.

    On a terminal a bar with the time left, replaced by one line at the end; elsewhere one line at the
    start and one at the end, so that logs stay short. An error in the block leaves no "done" line.

    Args:
        description: what is being done, in a few words.
        total: the number of steps, or None when it is not known.
        bar: whether a terminal shows a bar; not where something else owns the terminal meanwhile.
    """
    console, started = err(), time.monotonic()
    if bar and console.is_terminal and not console.is_dumb_terminal:
        from rich.markup import escape
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (
            TextColumn(escape(description)),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", markup=False),
        )
        with Progress(*columns, console=console, transient=True, redirect_stdout=False, redirect_stderr=False) as shown:
            current = Stage(shown, shown.add_task(description, total=total, note=""))
            yield current
    else:
        note(f"{description} ...")
        current = Stage()
        yield current
    remark = f", {current.note}" if current.note else ""
    note(f"{description}: done in {time.monotonic() - started:.1f} s{remark}")


def table(
    headings: Sequence[str],
    rows: Iterable[Sequence[RenderableType]],
    left: Sequence[str],
    *,
    whole: Literal["", "words", "cells"] = "",
    **look: Any,
) -> "Table":
    """Return a table, columns aligned to the right but for those headed as in ``left``; ``look`` is Rich's own.

    What is ``whole`` is never cut or broken, words or, but in the last column, cells; both are texts then.
    """
    from rich.table import Table

    made, rows = Table(**look), list(rows)
    for index, heading in enumerate(headings):
        kept = whole == "cells" and index < len(headings) - 1
        cells = [str(row[index]) for row in (headings, *rows)] if whole else []
        least = max((cell_len(part) for cell in cells for part in ([cell] if kept else cell.split())), default=None)
        made.add_column(heading, justify="left" if heading in left else "right", no_wrap=kept, min_width=least)
    for row in rows:
        made.add_row(*row)
    return made


def _tagged(tag: str, style: str, message: str) -> None:
    err().print(Text.assemble("koopdqn: ", (f"{tag}:", style), f" {_one_line(message)}"), soft_wrap=True)


def _literal(line: str) -> Text:
    # No string: names in it keep their signs, which tables replace where the output is not UTF-8.
    return Text(visible(line))


def _one_line(message: str) -> str:
    return visible(" ".join(message.split()))


def shown_path(path: Path) -> str:
    """Return a path for people: relative to the working folder where it lies below it."""
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def percent(share: float) -> str:
    """Return a share in whole percent: "100%" only of all and "0%" only of none."""
    text = f"{share:.0%}"
    if (text == "100%" and share < 1) or (text == "0%" and share > 0):
        return f"{min(max(100 * share, 0.1), 99.9):.1f}%"
    return text


def counted(count: int, noun: str) -> str:
    """Return "1 run", "2 runs"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
