"""Rows of the table of speeds: ours beside a peer or a limit that was measured in the same run."""

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import Any, Literal

NOT_INSTALLED = "not installed"
NOT_MEASURED = "not measured"

# Work shorter than this [s] is repeated until it takes that long, as a clock's own time counts otherwise.
_LEAST_SECONDS = 0.02


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        what: what was measured.
        ours: our median, in ``unit``; None where this run left it out.
        unit: of both figures, less being better.
        peer: who or what the other figure is of.
        theirs: the other figure, or why there is none.
        bar: the most that ours may be, in ``unit``, or None.
        least_ratio: the least that the ratio may be, or None.
        note: what else a reader should know.
    """

    what: str
    ours: float | None
    unit: str
    peer: str
    theirs: float | str
    bar: float | None = None
    least_ratio: float | None = None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        """The other figure over ours: how many times faster we are; of a limit, which share of it is reached."""
        if self.ours is None or isinstance(self.theirs, str):
            return None
        return self.theirs / self.ours

    @property
    def met(self) -> bool | None:
        """Whether the bars are met; None where there is none, or nothing to compare with it."""
        held = []
        if self.bar is not None and self.ours is not None:
            held.append(self.ours <= self.bar)
        if self.least_ratio is not None and self.ratio is not None:
            held.append(self.ratio >= self.least_ratio)
        return all(held) if held else None

    def described(self) -> dict[str, Any]:
        """Return everything as JSON values."""
        return {**asdict(self), "ratio": self.ratio, "met": self.met}


def compared(
    ours: Callable[[], object], theirs: Callable[[], object] | None, repeats: int = 5
) -> tuple[float, float | None]:
    """Return the median times [s] of two pieces of work done in turn, so that a busy machine slows both alike."""
    works = [ours] if theirs is None else [ours, theirs]
    rounds = [_rounds(work) for work in works]
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, count, found in zip(works, rounds, times, strict=True):
            found.append(_seconds(work, count))
    medians = [statistics.median(found) for found in times]
    return medians[0], medians[1] if len(medians) == 2 else None


def installed(module: str) -> bool:
    """Return whether a peer's module can be imported."""
    return find_spec(module) is not None


def _rounds(work: Callable[[], object]) -> int:
    """Return how often to repeat a piece of work in one measurement, after a first time that warms up."""
    work()
    return max(1, round(_LEAST_SECONDS / max(_seconds(work, 1), 1e-9)))


def _seconds(work: Callable[[], object], rounds: int) -> float:
    began = time.perf_counter()
    for _ in range(rounds):
        work()
    return (time.perf_counter() - began) / rounds


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table."""
    heads = ["| what | ours | peer or limit | theirs | ratio | bar | note |", "|---|---|---|---|---|---|---|"]
    return "\n".join([*heads, *map(line, rows)])


def line(row: Row) -> str:
    """Return a row as a line of the table."""
    ours = NOT_MEASURED if row.ours is None else figure(row.ours, row.unit)
    theirs = row.theirs if isinstance(row.theirs, str) else figure(row.theirs, row.unit)
    ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
    return f"| {row.what} | {ours} | {row.peer} | {theirs} | {ratio} | {_bar(row)} | {row.note} |"


def figure(value: float, unit: str) -> str:
    """Return a figure with three digits and its unit."""
    return f"{float(f'{value:.3g}'):g} {unit}"


def _bar(row: Row) -> str:
    bars = [] if row.bar is None else [f"≤ {row.bar:g} {row.unit}"]
    bars += [] if row.least_ratio is None else [f"ratio ≥ {row.least_ratio:g}"]
    verdict: dict[bool | None, Literal["", ", met", ", missed"]] = {None: "", True: ", met", False: ", missed"}
    return " and ".join(bars) + verdict[row.met]
