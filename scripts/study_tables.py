"""The Markdown tables of an experiment's results."""

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from statistics import fmean, median
from typing import Final

from experiment import Column, Experiment, Kind, Table
from study_runs import Result

from docs import replaced, rows_table

_FORMATS: Final[dict[Kind, Callable[[float], str]]] = {
    "whole": lambda value: f"{value:,.0f}",
    "percent": lambda value: f"{100 * value:.1f}".removesuffix(".0"),
    "tenths": lambda value: f"{value:,.1f}",
    "millimetres": lambda value: f"{1e3 * value:.2f}",
}
_STATS: Final[dict[str, Callable[[Sequence[float]], float]]] = {
    "mean": fmean,
    "median": median,
    "least": min,
    "most": max,
    "true": sum,
    "all": len,
}
_UNKNOWN: Final = "–"
_ADDS, _COSTS = "in every seed it adds", "in every seed it costs"
_BETTER: Final = {"more": "+", "less": "−"}
_WORSE: Final = {"more": "−", "less": "+"}


def with_tables(page: str, experiment: Experiment, results: Sequence[Result]) -> str:
    """Return the page with the parts that hold tables replaced by those of the results; the rest stays.

    Raises:
        BadInputError: the page does not hold each part once.
    """
    cases = list(dict.fromkeys(result.case for result in results))
    for part, tables in experiment.tables.items():
        apart = any("{case}" in table.title for table in tables)
        texts = []
        for group in [[case] for case in cases] if apart else [cases] if cases else []:
            for table in tables:
                title = f"{table.title.format(case=group[0])}\n\n" if table.title else ""
                texts.append(title + table_text(table, experiment, results, group))
        page = replaced(page, part, "\n\n".join(texts) or "Nothing is measured yet of the default as it stands.")
    return page


def table_text(table: Table, experiment: Experiment, results: Sequence[Result], cases: Sequence[str]) -> str:
    """Return the Markdown table of the results in some cases; a row of which nothing is known is left out.

    Of two lines that are compared, the first is said to add what is better in every seed, to the digit shown, and to
    cost what is worse in every seed.
    """
    rows: list[list[str]] = []
    before: list[str] = []
    for labels, own, beside in _rows(table, experiment, results, cases):
        cells = [cell(column, own, beside) for column in table.columns.values()]
        if set(cells) == {_UNKNOWN}:
            continue
        if table.comparisons and beside is not None:
            cells += [_verdict(table, own, beside, signs) for signs in (_BETTER, _WORSE)]
        # A label is not said again below itself.
        said = next((place for place, pair in enumerate(zip(labels, before, strict=False)) if pair[0] != pair[1]), 0)
        rows.append([*[""] * said, *labels[said:], *cells])
        before = labels
    return rows_table([*table.labels, *table.columns, *((_ADDS, _COSTS) if table.comparisons else ())], rows)


def _rows(
    table: Table, experiment: Experiment, results: Sequence[Result], cases: Sequence[str]
) -> Iterator[tuple[list[str], list[Result], list[Result] | None]]:
    """Yield the labels of every row, its results, and those with the same seeds that they are shown less, if any."""
    found: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        found.setdefault((result.case, result.line), []).append(result)
    if table.comparisons:
        rows = [(case, *pair, about) for case in cases for about, pair in table.comparisons.items()]
    elif table.beside:
        lines = {line: "" if line == table.beside else table.beside for line in experiment.lines}
        rows = [(case, line, other, experiment.lines[line]) for line, other in lines.items() for case in cases]
    else:
        rows = [(case, line, "", about) for case in cases for line, about in experiment.lines.items()]
    for case, line, other, about in rows:
        own, beside = found.get((case, line), []), found.get((case, other), []) if other else None
        if beside is not None:
            common = {result.seed for result in own} & {result.seed for result in beside}
            own, beside = ([result for result in side if result.seed in common] for side in (own, beside))
        name, below, _ = line.partition("/")
        variant = experiment.variants[name]
        labels = {
            "case": case,
            "about": about,
            "config": experiment.config(*(() if below else variant.train), *variant.measure),
            "undoes": ", ".join(f"D{number}" for number in variant.undoes) or _UNKNOWN,
            "seeds": _seeds(own),
        }
        yield [labels[label] for label in table.labels.values()], own, beside


def _seeds(results: Sequence[Result]) -> str:
    """Return the seeds of results; neighbours are written as a range."""
    parts: list[list[int]] = []
    for seed in sorted(result.seed for result in results if result.seed is not None):
        if parts and seed == parts[-1][-1] + 1:
            parts[-1].append(seed)
        else:
            parts.append([seed])
    return ", ".join(str(part[0]) if len(part) == 1 else f"{part[0]}–{part[-1]}" for part in parts) or _UNKNOWN


def cell(column: Column, own: Sequence[Result], beside: Sequence[Result] | None = None) -> str:
    """Return the values of some seeds put together; less the values of others with the same seeds, unless counted."""
    if beside is not None and column.show != "true of all":
        return stated(_differences(column, own, beside), "mean (least to most)", partial(signed, kind=column.kind))
    known = [value for result in own if (value := result.values[column.value]) is not None]
    return stated(known, column.show, _FORMATS["whole" if column.show == "true of all" else column.kind])


def stated(values: Sequence[float], show: str, text: Callable[[float], str]) -> str:
    """Return what ``show`` says of values; what it has in brackets is left out where all its numbers look the same."""
    if not values:
        return _UNKNOWN
    found = re.sub("|".join(_STATS), lambda match: text(_STATS[match[0]](values)), show)
    first, _, rest = found.rstrip(")").partition(" (")
    return first if rest and set(rest.split(" to ")) == {first} else found


def signed(value: float, kind: Kind) -> str:
    """Return a difference with its sign, none where it shows as zero."""
    text = _FORMATS[kind](abs(value))
    return text if not text.strip("0.") else ("+" if value > 0 else "−") + text


def _differences(column: Column, own: Sequence[Result], beside: Sequence[Result]) -> list[float]:
    others = {result.seed: result.values[column.value] for result in beside}
    pairs = [(result.values[column.value], others[result.seed]) for result in own]
    return [one - other for one, other in pairs if one is not None and other is not None]


def _verdict(table: Table, own: Sequence[Result], beside: Sequence[Result], signs: dict[str, str]) -> str:
    """Return the headings of the columns whose differences all have the sign that is given for what is better there."""
    found = []
    for heading, column in table.columns.items():
        texts = [signed(value, column.kind) for value in _differences(column, own, beside)]
        if texts and column.better and all(text.startswith(signs[column.better]) for text in texts):
            found.append(heading.partition(" [")[0])
    return ", ".join(found) or "nothing"
