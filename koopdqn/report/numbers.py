"""How the report writes numbers, and its tables of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import Baselines
from koopdqn.files import read_json
from koopdqn.report.blocks import Cell, Missing, Table
from koopdqn.report.groups import Groups
from koopdqn.report.intents import INTENTS, IntentStudy
from koopdqn.report.runs import Run

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


Studies = Mapping[str, Mapping[str, tuple[IntentStudy, Path]]]
"""Fitted intents with the files that hold them, by task and name of the intent."""

_BASELINES = tuple(Baselines.model_fields)
_INTENT_NAMES = {
    "paper": "paper: second-order lift, K = A G†",
    "pose": "pose: the default",
    "line": "line: least-squares line",
    "joint": "joint: one K for the whole pose",
}


def runs_table(groups: Groups) -> Table:
    """Return the runs that the report shows, a row a run."""
    rows = []
    for group in groups.values():
        for run in group.runs:
            learned = f"yes, after {run.train['learned_at_env_steps']:,} actions" if run.train["learned"] else "no"
            evaluated = Cell("no")
            if run.evaluation_file is not None and run.evaluation is not None:
                evaluated = Cell(f"{run.evaluation['episodes']} starts", (run.evaluation_file,))
            source = (run.train_file,)
            rows.append(
                (
                    Cell(str(run.folder), source),
                    Cell(group.task),
                    Cell(group.preset),
                    Cell(str(run.seed), source),
                    Cell(learned, source),
                    evaluated,
                )
            )
    return Table(
        "Runs that this page shows",
        "One run a task, preset and seed; runs that did not learn are shown like any other.",
        ("folder", "task", "preset", "seed", "learned", "evaluated on"),
        tuple(rows),
    )


def evaluation_table(groups: Groups) -> Table | Missing:
    """Return what the policies do from held-out starts, and what comes without learning."""
    rows = []
    for group in groups.values():
        runs = group.measured
        if not runs:
            continue
        rows.append((Cell(f"{group.task}, {group.preset} preset: learned policy"), *_method(runs, ())))
        for name in _BASELINES:
            if all((run.evaluation or {})["baselines"] is not None for run in runs):
                title = f"{group.task}: {name.replace('_', ' ')}, no learning"
                rows.append((Cell(title), *_method(runs, ("baselines", name))))
    if not rows:
        return Missing(
            "The table of evaluations", "It needs evaluations, and none was found.", "koopdqn report report.make=true"
        )
    return Table(
        "From held-out starts",
        "Mean over seeds, least and largest seed in parentheses. Deviation: from the demonstrator's own path from the"
        " same start, points matched by arc length; sideways: from that path's nearest point.",
        ("method", "success [%]", "deviation, mean [mm]", "its 95th percentile of maxima [mm]", "sideways, mean [mm]"),
        tuple(rows),
    )


def _method(runs: Sequence[Any], place: tuple[str, ...]) -> tuple[Cell, ...]:
    return (
        measured(runs, ".0f", *place, "success_rate", scale=100.0),
        measured(runs, ".1f", *place, "path_deviation_mm", "mean"),
        measured(runs, ".0f", *place, "path_deviation_mm", "p95_of_max"),
        measured(runs, ".1f", *place, "lateral_deviation_mm", "mean"),
    )


def training_table(groups: Groups) -> Table:
    """Return what training took, a row a task and preset."""
    rows = []
    for group in groups.values():
        runs = group.runs
        sources = tuple(run.train_file for run in runs)
        rows.append(
            (
                Cell(f"{group.task}, {group.preset} preset"),
                Cell(f"{sum(run.train['learned'] for run in runs)} of {len(runs)}", sources),
                trained(runs, ",.0f", "episodes"),
                trained(runs, ",.0f", "env_steps"),
                trained(runs, ",.0f", "updates"),
                trained(runs, ",.0f", "oracle_queries"),
                trained(runs, ".1f", "reward_agreement", "trusted", scale=100.0),
                trained(runs, ".0f", "seconds"),
            )
        )
    return Table(
        "What training took",
        "Mean over seeds, least and largest seed in parentheses. Agreement: share of the trusted model's rewards that"
        " the demonstrator agrees with.",
        ("task", "learned", "episodes", "actions tried", "updates", "questions", "agreement [%]", "time [s]"),
        tuple(rows),
    )


def intents_table(studies: Studies) -> Table:
    """Return how well each intent predicts the demonstrations, a row a task and intent."""
    rows = []
    for task, by_name in studies.items():
        for name in (name for name in INTENTS if name in by_name):
            found, file = by_name[name]
            sixty, rolled = found.report["sixty_samples"], found.report["roll_out_error_m"]
            one = found.report["one_step_error_m"]
            turned = sixty["rms_over_persistence_rotation"]
            texts = (
                f"{one['rms'] * 1e3:.2f} / {one['max'] * 1e3:.2f}",
                f"{sixty['rms_m'] * 1e3:.2f} / {sixty['max_m'] * 1e3:.2f}",
                f"{sixty['rms_over_persistence']:.3f}",
                "held" if turned is None else f"{turned:.3f}",
                f"{rolled['reached_goal']} of {found.report['demonstrations']}",
                f"{rolled['median_hausdorff'] * 1e3:.0f}" if rolled["median_hausdorff"] < 1.0 else "over 1000",
            )
            cells = (Cell(text, (file,)) for text in texts)
            rows.append((Cell(f"{task}, {_INTENT_NAMES[name]}"), *cells))
    return Table(
        "Intents compared",
        "Every demonstration predicted by a model fitted to the others. Persistence: predicting no motion. Rolled out:"
        " followed from a demonstration's start; the goal counts as reached within 5 mm.",
        (
            "intent",
            "one step of the agent: RMS / largest [mm]",
            "at 60 samples: RMS / largest [mm]",
            "over persistence, position",
            "over persistence, rotation",
            "rolled out: goal reached",
            "median Hausdorff distance [mm]",
        ),
        tuple(rows),
    )


def ablations_table(file: Path) -> Table | Missing:
    """Return the table of ``ablations.json``, a row a case and variant, or what makes it."""
    if not file.is_file():
        return Missing("The table of ablations", f"It needs {file}, which does not exist.", "make ablations")
    found = read_json(file, "the ablations")
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    try:
        for row in found:
            groups.setdefault((row["case"], row["variant"]), []).append(row)
        rows = tuple(_ablation(place, own, file) for place, own in groups.items())
    except (KeyError, TypeError) as error:
        raise BadInputError(
            f"{file} must hold one row a run as `make ablations` writes them, found: {error!r}"
        ) from error
    return Table(
        "Ablations",
        "One deviation from the paper undone; mean over seeds, least and largest seed in parentheses. Deviation is the"
        " mean one from the demonstrator's path, of people's motions the Hausdorff distance from the one held out.",
        ("case, variant", "changed", "seeds learned", "episodes", "questions", "success [%]", "deviation [mm]"),
        rows,
    )


def _ablation(place: tuple[str, str], rows: Sequence[Mapping[str, Any]], file: Path) -> tuple[Cell, ...]:
    changed = rows[0]["overrides"]
    texts = (
        f"{sum(bool(row['learned']) for row in rows)} of {len(rows)}",
        spread([row["episodes"] for row in rows], ",.0f"),
        spread([row["oracle_queries"] for row in rows], ",.0f"),
        spread([row["success_rate"] for row in rows], ".0f", 100.0),
        spread([row["deviation_mm"] for row in rows], ".1f"),
    )
    shown = Cell(" ".join(f"`{item}`" for item in changed)) if changed else Cell("nothing")
    return Cell(", ".join(place)), shown, *(Cell(text, (file,)) for text in texts)
