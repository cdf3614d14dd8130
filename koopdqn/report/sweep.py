"""The page of a sweep: its runs and variants in one table and one plot, with the spread over seeds."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from koopdqn.console import counted
from koopdqn.evaluation.results import QUANTITIES, SweptRun, Variant, known, variants
from koopdqn.files import write_json, write_text
from koopdqn.plots.train import plot_sweep
from koopdqn.report.figures import Figure
from koopdqn.report.page import PAGE, Block, Section, render
from koopdqn.report.schema import LeftOut, SweepFile
from koopdqn.report.tables import Cell, Quantity, Table, left_out
from koopdqn.run_folder import TRAINING

_MEASURED: Final = (
    Quantity("success [%]", "success_rate", ".3g", 100.0),
    Quantity("deviation [mm]", "deviation_mm", ".1f"),
)
_TRAINED: Final = (
    Quantity("best check [%]", "check_success_rate", ".3g", 100.0),
    Quantity("questions", "oracle_queries", ",.0f"),
    Quantity("time [s]", "seconds", ",.1f"),
)
Found = Sequence[tuple[Variant, Sequence[SweptRun]]]


def build(sweep: Path, runs: Sequence[SweptRun], folder: Path) -> dict[str, Any]:
    """Write what the runs of a sweep's folder come to into another folder, and return the content of the JSON.

    The files are ``report.html``, ``sweep.json``, ``sweep.csv`` and ``sweep.png``.

    Raises:
        BadInputError: a file cannot be written.
    """
    found = variants(runs)
    varied = sorted({key for run in runs for key in run.overrides})
    title = f"Sweep: {counted(len(runs), 'run')} of {counted(len(found), 'variant')}"
    drawn = [
        (_label(variant), {q.name: [q.scale * value for value in known(own, q.keys)] for q in (*_MEASURED, *_TRAINED)})
        for variant, own in found
    ]
    plot_sweep(folder / "sweep.png", title, drawn)
    caption = "A dot a run; of each variant the mean, and one standard deviation over its runs to each side."
    figure = Figure("1", "Spread over seeds", caption, ["sweep.png"], layout="full")
    blocks: list[Block] = [figure, _table(found, varied)]
    lacking = [LeftOut(folder=run.folder, reason=run.reason) for run in runs if run.reason]
    if lacking:
        blocks.append(left_out("Runs that did not finish", lacking))
    write_text(folder / PAGE, render(title, [Section("Runs and variants", blocks)], folder, sweep=sweep))
    write_text(folder / "sweep.csv", _csv(found, varied))
    each = [variant for variant, _ in found]
    file = SweepFile(page=str(folder / PAGE), sweep=str(sweep), runs=list(runs), variants=each)
    content = file.model_dump(mode="json")
    write_json(folder / "sweep.json", content)
    return content


_LONGEST: Final = 40
"""Letters of a line of a variant's label in the plot."""


def _label(variant: Variant) -> str:
    given = [f"{key}={value}" for key, value in variant.overrides.items()] or ["as given"]
    lines = [each if len(each) <= _LONGEST else f"{each[: _LONGEST - 1]}…" for each in given]
    if variant.finished < variant.runs:
        lines.append(f"({variant.finished} of {variant.runs} finished)")
    return "\n".join(lines)


def _table(found: Found, varied: Sequence[str]) -> Table:
    rows, summaries = [], []
    for variant, own in found:
        given = [Cell(variant.overrides.get(key, "–")) for key in varied]
        for run in own:
            outcome = run.state if run.learned is None else "yes" if run.learned else "no"
            seed = "–" if run.seed is None else str(run.seed)
            rows.append((Cell(run.folder), *given, Cell(seed), Cell(outcome), *_quantities([run])))
        summaries.append(len(rows))
        seeds, learned = Cell(counted(len(variant.seeds), "seed")), Cell(f"{variant.learned} of {variant.runs}")
        rows.append((Cell("mean (least–largest)"), *given, seeds, learned, *_quantities(own)))
    names = (quantity.name for quantity in (*_MEASURED, *_TRAINED))
    return Table("Every run, and each variant", ("run", *varied, "seed", "learned", *names), rows, summaries)


def _quantities(runs: Sequence[SweptRun]) -> list[Cell]:
    measured = [(Path(run.evaluation), run.model_dump()) for run in runs if run.evaluation is not None]
    trained = [(Path(run.folder) / TRAINING, run.model_dump()) for run in runs if run.state == "finished"]
    return [*(each.over(measured) for each in _MEASURED), *(each.over(trained) for each in _TRAINED)]


def _csv(found: Found, varied: Sequence[str]) -> str:
    """Return a row a run, and after those of a variant one with its means and standard deviations (``…_std``)."""
    text, stds = io.StringIO(), [f"{key}_std" for key in QUANTITIES]
    header = ("row", "folder", *varied, "seed", "state", "runs", "learned", *QUANTITIES, *stds)
    table = csv.DictWriter(text, header, lineterminator="\n")
    table.writeheader()
    for variant, own in found:
        for run in own:
            row = {key: getattr(run, key) for key in ("folder", "seed", "state", *QUANTITIES)}
            learned = None if run.learned is None else int(run.learned)
            table.writerow({"row": "run", "runs": 1, "learned": learned, **run.overrides, **row})
        row = {"row": "variant", "runs": variant.runs, "learned": variant.learned, **variant.overrides}
        for key in QUANTITIES:
            spread = getattr(variant, key)
            row |= {key: spread and spread.mean, f"{key}_std": spread and spread.std}
        table.writerow(row)
    return text.getvalue()
