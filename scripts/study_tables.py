"""The results of the study: one for each run and baseline, and their Markdown tables in docs/study.md."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any, Final

from ablation_tables import Format, shown
from pydantic import Field
from study_lines import COMPARISONS, LINES, PAPER, Comparison, Line

from docs import replaced, rows_table
from koopdqn.errors import BadInputError
from koopdqn.settings import Fraction, NonNegative, NonNegativeInt, Settings

PART: Final = "study"
"""Name of the page's generated part."""
HEADS: Final = (
    "method",
    "config",
    "seeds",
    "learned",
    "success [%]",
    "deviation [mm]",
    "p95 of largest [mm]",
    "turn [°]",
    "questions",
    "trusted right [%]",
    "remembered right [%]",
    "least check after [%]",
    "training [s]",
)


@dataclass(frozen=True)
class Result:
    """What one line's run, or one baseline, came to with one seed; None where a quantity is not known or not defined.

    Attributes:
        task: name of the task.
        line: name of the line or of the baseline.
        seed: of demonstrations and training.
        learned: whether it learned within its limits; None of what knows no such thing.
        success_rate: share of the held-out starts from which it succeeds.
        path_deviation_mm: mean distance from the demonstrator's path [mm].
        p95_of_max_mm: 95th percentile over episodes of the largest such distance [mm].
        rotation_deviation_deg: mean angle to the demonstrator's orientation [deg].
        questions: questions that reached the oracle.
        trusted: share of the trusted model's rewards that the demonstrator agrees with.
        remembered: the same of remembered answers.
        least_check: least success rate of the checks after it had learned.
        seconds: time of the training [s].
        failures: failed episodes by cause, those that occurred.
        demonstrations: SHA-256 of what it learned from.
    """

    task: str
    line: str
    seed: int
    learned: bool | None
    success_rate: float
    path_deviation_mm: float | None
    p95_of_max_mm: float | None
    rotation_deviation_deg: float | None
    questions: int
    trusted: float | None
    remembered: float | None
    least_check: float | None
    seconds: float | None
    failures: dict[str, int]
    demonstrations: str


class PaperRun(Settings):
    """A kept result of a training with ``preset=paper``, which takes too long to be repeated."""

    learned: bool
    episodes: NonNegativeInt
    seconds: NonNegative
    questions: NonNegativeInt
    success_rate: Fraction
    path_deviation_mm: NonNegative | None = Field(description="mean [mm]")


def least_check(report: Mapping[str, Any]) -> float | None:
    """Return the least success rate of the checks after the one by which ``train.json`` calls it learned."""
    since = report["learned_at_env_steps"]
    after = [check["success_rate"] for check in report["checks"] if since is not None and check["env_steps"] > since]
    return min(after, default=None)


def table(results: Sequence[Result], paper: PaperRun | None, lines: Sequence[Line] = LINES) -> str:
    """Return the Markdown table of one task's results, in the order of the lines, each with its baselines below."""
    rows = []
    for line in lines:
        rows += _row(line.about, _config(line), [result for result in results if result.line == line.name])
        for name, about in line.baselines.items():
            evaluation = " ".join(f"`{item}`" for item in line.evaluation)
            rows += _row(about, evaluation, [result for result in results if result.line == line.named(name)])
    rows.append(_paper_row(paper))
    return rows_table(HEADS, rows)


def _config(line: Line) -> str:
    return " ".join(f"`{item}`" for item in (*line.overrides, *line.evaluation))


def _row(about: str, config: str, results: Sequence[Result]) -> list[list[str]]:
    if not results:
        return []
    learned = [result.learned for result in results if result.learned is not None]
    success = [result.success_rate for result in results]
    questions = [result.questions for result in results]
    return [
        [
            about,
            config,
            _seeds([result.seed for result in results]),
            f"{sum(learned)} of {len(learned)}" if learned else "–",
            _with(shown(fmean(success), "share"), shown(min(success), "share")),
            _mean([result.path_deviation_mm for result in results], "mm"),
            _mean([result.p95_of_max_mm for result in results], "mm"),
            _mean([result.rotation_deviation_deg for result in results], "degrees"),
            _with(shown(median(questions), "count"), shown(max(questions), "count")),
            _mean([result.trusted for result in results], "share"),
            _mean([result.remembered for result in results], "share"),
            shown(min((r.least_check for r in results if r.least_check is not None), default=None), "share"),
            _mean([result.seconds for result in results], "seconds"),
        ]
    ]


def _paper_row(paper: PaperRun | None) -> list[str]:
    if paper is None:
        return [PAPER, "`preset=paper`", "–", "not measured", *["–"] * (len(HEADS) - 4)]
    return [
        PAPER,
        "`preset=paper`",
        "–",
        f"{int(paper.learned)} of 1 ({paper.episodes:,} episodes)",
        shown(paper.success_rate, "share"),
        shown(paper.path_deviation_mm, "mm"),
        "–",
        "–",
        shown(paper.questions, "count"),
        *["–"] * 3,
        shown(paper.seconds, "seconds"),
    ]


def _with(first: str, second: str) -> str:
    return first if first == second else f"{first} ({second})"


def _mean(values: Sequence[float | None], kind: Format) -> str:
    known = [value for value in values if value is not None]
    return shown(fmean(known) if known else None, kind)


def comparison_table(results: Sequence[Result], comparisons: Sequence[Comparison] = COMPARISONS) -> str:
    """Return the Markdown table of what one line of a task adds over another, seed by seed; no rows without both.

    A difference is the one's less the other's. Where in every seed it is better, to the digit shown, it is said to add
    something, where it is worse in every seed, to cost something; what differs in some seeds only is said of neither.
    """
    found = {(result.line, result.seed): result for result in results}
    rows = []
    for each in comparisons:
        seeds = [seed for line, seed in found if line == each.line and (each.beside, seed) in found]
        if not seeds:
            continue
        cells, adds, costs = [], [], []
        for quantity in _COMPARED:
            apart = [quantity.difference(found[each.line, seed], found[each.beside, seed]) for seed in seeds]
            known = [value for value in apart if value is not None]
            cells.append(_signed(known))
            if known and all(quantity.sign * value > 0 for value in known):
                adds.append(quantity.name)
            if known and all(quantity.sign * value < 0 for value in known):
                costs.append(quantity.name)
        rows.append([each.question, _seeds(seeds), *cells, ", ".join(adds) or "nothing", ", ".join(costs) or "nothing"])
    heads = [f"{quantity.name} [{quantity.unit}]" for quantity in _COMPARED]
    return rows_table(("question", "seeds", *heads, "in every seed it adds", "in every seed it costs"), rows)


@dataclass(frozen=True)
class _Quantity:
    """What is compared.

    Attributes:
        name: of the quantity.
        unit: of the difference.
        field: of :class:`Result`.
        scale: to the unit.
        sign: 1 if more is better, −1 if less is.
    """

    name: str
    unit: str
    field: str
    scale: float
    sign: int

    def difference(self, one: Result, other: Result) -> float | None:
        """Return the one's less the other's, to the digit shown; None where it is not known of both."""
        values = getattr(one, self.field), getattr(other, self.field)
        return None if None in values else round(self.scale * (values[0] - values[1]), 1)


_COMPARED: Final = (
    _Quantity("success", "points", "success_rate", 100.0, 1),
    _Quantity("deviation", "mm", "path_deviation_mm", 1.0, -1),
    _Quantity("p95 of largest", "mm", "p95_of_max_mm", 1.0, -1),
    _Quantity("turn", "°", "rotation_deviation_deg", 1.0, -1),
)


def _signed(values: Sequence[float]) -> str:
    if not values:
        return "–"
    low, mean, high = (_with_sign(value) for value in (min(values), fmean(values), max(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def _with_sign(value: float) -> str:
    text = f"{value:+.1f}".replace("-", "−")
    return "0.0" if text in ("+0.0", "−0.0") else text


def with_tables(page: str, results: Sequence[Result], paper: Mapping[str, PaperRun]) -> str:
    """Return the page with its generated part replaced by two tables for every task of the results; the rest stays.

    Raises:
        BadInputError: the page does not hold that part once.
    """
    parts = []
    for task in dict.fromkeys(result.task for result in results):
        own = [result for result in results if result.task == task]
        parts.append(f"### {task}\n\n{table(own, paper.get(task))}")
        parts.append(f"What one adds over the other on the {task}:\n\n{comparison_table(own)}")
    try:
        return replaced(page, PART, "\n\n".join(parts))
    except ValueError as error:
        raise BadInputError(f"the page: {error}") from error


def _seeds(seeds: Sequence[int]) -> str:
    """Return whole numbers, of which neighbours are written as a range."""
    parts: list[list[int]] = []
    for seed in sorted(seeds):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}–{part[-1]}" for part in parts)
