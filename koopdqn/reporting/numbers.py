"""How the report writes numbers: a value, or the mean of several with their range."""

from collections.abc import Sequence
from statistics import fmean
from typing import Any

from koopdqn.reporting.content import Cell
from koopdqn.reporting.runs import Run

NOT_GIVEN = Cell("not given")
"""The paper says nothing about it."""
NONE = Cell("–")
"""Nothing was measured."""


def spread(values: Sequence[float | None], form: str, scale: float = 1.0, unit: str = "") -> str:
    """Return "mean (least–largest) unit" of the known values, the mean alone where they do not differ.

    Args:
        values: None where nothing was measured.
        form: a format specification.
        scale: multiplies the values.
        unit: written after them.
    """
    known = [scale * value for value in values if value is not None]
    if not known:
        return "–"
    low, mean, high = (format(value, form) for value in (min(known), fmean(known), max(known)))
    text = mean if low == high else f"{mean} ({low}–{high})"
    return f"{text} {unit}".rstrip()


def trained(runs: Sequence[Run], form: str, *keys: str, scale: float = 1.0, unit: str = "") -> Cell:
    """Return a quantity of the runs' ``train.json`` as a cell, reached by keys."""
    if not runs:
        return NONE
    values = [_reached(run.train, keys) for run in runs]
    return Cell(spread(values, form, scale, unit), tuple(run.train_file for run in runs))


def measured(runs: Sequence[Run], form: str, *keys: str, scale: float = 1.0, unit: str = "") -> Cell:
    """Return a quantity of the runs' ``eval.json`` as a cell, reached by keys; runs without one are left out."""
    pairs = [(run.evaluation_file, run.evaluation) for run in runs]
    known = [(file, content) for file, content in pairs if file is not None and content is not None]
    if not known:
        return NONE
    values = [_reached(content, keys) for _, content in known]
    return Cell(spread(values, form, scale, unit), tuple(file for file, _ in known))


def _reached(content: Any, keys: Sequence[str]) -> float | None:
    """Return the number that keys lead to, or None where one of them leads nowhere."""
    for key in keys:
        content = None if content is None else content.get(key)
    return None if content is None else float(content)
