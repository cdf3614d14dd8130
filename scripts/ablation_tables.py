"""The results of ablations: a row a run, and the Markdown table of them in docs/algorithm.md."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean
from typing import Final, Literal

from ablation_variants import CASES, DEFAULT, VARIANTS, Variant

from docs import replaced, rows_table
from koopdqn.errors import BadInputError

PART: Final = "ablations"
"""Name of the page's generated part."""
HEADS: Final = ("success [%]", "questions", "deviation [mm]", "trusted right [%]", "training [s]")


@dataclass(frozen=True)
class Row:
    """The result of one run.

    Attributes:
        case: name of the case.
        variant: name of the variant.
        seed: of the training, and of the demonstrations of a task of the package.
        overrides: what the variant changes.
        learned: whether it learned within its limit.
        episodes: finished episodes.
        oracle_queries: questions that reached the oracle.
        seconds: time of the training [s].
        trusted_right: share of the trusted model's rewards that the demonstrator agrees with.
        success_rate: share of the held-out starts from which the policy succeeds.
        deviation_mm: mean distance from the demonstrator's path, points matched by arc length; of people's motions the
            Hausdorff distance from the one held out [mm].
    """

    case: str
    variant: str
    seed: int
    overrides: list[str]
    learned: bool
    episodes: int
    oracle_queries: int
    seconds: float
    trusted_right: float | None
    success_rate: float
    deviation_mm: float | None


Format = Literal["count", "share", "mm", "degrees", "seconds"]
_FORMATS: Final[dict[Format, Callable[[float], str]]] = {
    "count": lambda value: f"{value:,.0f}",
    "share": lambda value: f"{100 * value:.1f}".removesuffix(".0"),
    "mm": lambda value: f"{value:.1f}",
    "degrees": lambda value: f"{value:.1f}",
    "seconds": lambda value: f"{value:.0f}",
}
_FIGURES: Final[tuple[tuple[str, Format], ...]] = (
    ("success_rate", "share"),
    ("oracle_queries", "count"),
    ("deviation_mm", "mm"),
    ("trusted_right", "share"),
    ("seconds", "seconds"),
)


def shown(value: float | None, kind: Format) -> str:
    """Return a value as a cell, a dash where it is not known."""
    return "–" if value is None else _FORMATS[kind](value)


def signed(value: float, kind: Format) -> str:
    """Return a difference with its sign, none where it shows as zero."""
    text = shown(abs(value), kind)
    if not text.strip("0."):
        return text
    return ("+" if value > 0 else "−") + text


def spread(values: Sequence[float | None], text: Callable[[float], str]) -> str:
    """Return "mean (least to largest)" of the values that are known, the mean alone where they do not differ."""
    known = [value for value in values if value is not None]
    if not known:
        return "–"
    low, mean, high = text(min(known)), text(fmean(known)), text(max(known))
    return mean if low == high else f"{mean} ({low} to {high})"


def table(rows: Sequence[Row], variants: Sequence[Variant] = VARIANTS) -> str:
    """Return the Markdown table of all rows: a line a variant and case, what it differs from the default's there."""
    lines = []
    for variant in variants:
        config = " ".join(f"`{item}`" for item in variant.overrides)
        named = [_numbers(variant.undone), config or "the default"]
        for case in CASES:
            cells = _cells(rows, variant.name, case.name)
            if cells:
                lines.append([*named, *cells])
                named = ["", ""]
    return rows_table(("D", "override", "case", *HEADS), lines)


def _cells(rows: Sequence[Row], variant: str, case: str) -> list[str]:
    """Return a case's name and the figures of a variant there: the default's own, or all others' less those."""
    default = {row.seed: row for row in rows if (row.case, row.variant) == (case, DEFAULT.name)}
    own = [row for row in rows if (row.case, row.variant) == (case, variant) and row.seed in default]
    if not own:
        return []
    figures = []
    for name, kind in _FIGURES:
        values = [getattr(row, name) for row in own]
        if variant == DEFAULT.name:
            figures.append(spread(values, partial(shown, kind=kind)))
            continue
        others = [getattr(default[row.seed], name) for row in own]
        apart = [None if None in pair else pair[0] - pair[1] for pair in zip(values, others, strict=True)]
        figures.append(spread(apart, partial(signed, kind=kind)))
    if not all(row.learned for row in own):
        figures[0] += f"; learned {sum(row.learned for row in own)} of {len(own)}"
    if len(own) < len(default):
        case += f", seed {', '.join(str(row.seed) for row in own)} alone"
    return [case, *figures]


def _numbers(undone: Sequence[int]) -> str:
    return ", ".join(f"D{number}" for number in undone) or "–"


def with_table(page: str, rows: Sequence[Row]) -> str:
    """Return the page with its generated part replaced by the table of the rows; the rest stays.

    Raises:
        BadInputError: the page does not hold that part once.
    """
    seeds = sorted({row.seed for row in rows})
    said = f"{'Seed' if len(seeds) == 1 else 'Seeds'} {', '.join(str(seed) for seed in seeds)}."
    content = f"{said}\n\n{table(rows)}" if rows else "Nothing is measured yet of the default as it stands."
    try:
        return replaced(page, PART, content)
    except ValueError as error:
        raise BadInputError(f"the page: {error}") from error
