"""``koopdqn fit``: fit the human intent model and its trust domain."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import RenderableType

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.application import CommandResult
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.evaluation.metrics import hausdorff_mm
from koopdqn.intent.fit import Fitted
from koopdqn.run_folder import FIT, FIT_PICTURE, INTENT
from koopdqn.tasks.workcell import Workcell


def run(config: Configuration, folder: Path) -> CommandResult:
    """Fit to given or new demonstrations; write ``intent.npz``, ``fit.json`` and ``fit.png``."""
    workcell = pipeline.open_scene(config)
    demonstrations = pipeline.demonstrations_for(config, workcell, folder)
    _, fitted = pipeline.fitted_intent(config, demonstrations, folder, _fresh(config, workcell, demonstrations))
    report = fitted.report
    title = f"Intent {config.intent.name} on task {config.task.name}"
    title += ", one demonstration left out at a time" if report["demonstrations"] > 1 else ""
    rows = [*_rows(report), *_held_out_rows(config, fitted)]
    lines: list[RenderableType] = [console.table(("measure", "value"), rows, ("measure",), title=title)]
    if report["demonstrations"] == 1:
        lines.append(
            "one demonstration: none can be left out, so no error is measured and the tube has a fixed radius without"
            " calibrated coverage"
        )
    lines += [
        f"intent   {console.shown_path(folder / INTENT)}",
        f"report   {console.shown_path(folder / FIT)}",
        f"picture  {console.shown_path(folder / FIT_PICTURE)}",
    ]
    roll_out = report["roll_out_error_m"]
    return CommandResult(report, lines, objective=None if roll_out is None else roll_out["median_hausdorff"])


def _fresh(config: Configuration, workcell: Workcell, fitted: Demonstrations) -> Demonstrations | None:
    """Return new demonstrations of the scripted demonstrator to measure coverage on, if any are asked for."""
    if not config.fit.fresh:
        return None
    if config.derived is not None:
        raise BadInputError(
            f"fit.fresh must be 0 for a task made from demonstrations, which nobody can make more of,"
            f" found {config.fit.fresh}"
        )
    settings = config.demo.model_copy(update={"count": config.fit.fresh})
    fresh = pipeline.generated("Demonstrating afresh", workcell, settings, config.fit.seed).demonstrations
    if any(np.array_equal(one.poses, other.poses) for one in fresh.items for other in fitted.items):
        raise BadInputError(
            f"fit.seed must not be the seed of the demonstrations that are fitted, found {config.fit.seed}, which makes"
            " the same ones"
        )
    return fresh


def _rows(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    trust = report["trust"]
    if report["demonstrations"] > 1:
        one_step, sixty, roll_out = report["one_step_error_m"], report["sixty_samples"], report["roll_out_error_m"]
        yield "one-step error, RMS", f"{one_step['rms'] * 1e3:.3f} mm"
        yield "one-step error, largest", f"{one_step['max'] * 1e3:.3f} mm"
        yield "at 60 samples: RMS over persistence (predicting no motion)", f"{sixty['rms_over_persistence']:.3f}"
        beside = "" if sixty["paper_max_m"] is None else f" (the paper: {sixty['paper_max_m'] * 1e3:.1f} mm)"
        yield f"at 60 samples: largest error{beside}", f"{sixty['max_m'] * 1e3:.2f} mm"
        yield "rolled out: goal reached", f"{roll_out['reached_goal']} of {report['demonstrations']}"
        yield "rolled out: median Hausdorff distance", f"{roll_out['median_hausdorff'] * 1e3:.1f} mm"
    if len(report["regularisation"]) > 1:
        yield f"ridge chosen among {len(report['regularisation'])}", f"{report['ridge']:.0e}"
    yield "comes to the goal from the demonstrated region", f"{report['converging_share']:.0%}"
    yield "comes to the goal from three times wider", f"{report['converging_share_wide']:.0%}"
    yield "spectral radius of K", f"{report['spectral_radius']:.5f}"
    if trust["radius_m"] is not None:
        yield "tube: median radius", f"{trust['radius_m'] * 1e3:.1f} mm"
    if trust["nominal_coverage"] is not None:
        yield "tube: nominal coverage of whole demonstrations", f"{trust['nominal_coverage']:.1%}"
    if trust["measured_coverage"] is not None:
        yield f"measured coverage of {trust['fresh']} fresh demonstrations", f"{trust['measured_coverage']:.1%}"
    if trust["held_out_state_coverage"] is not None:
        yield "held-out states in the trust domain", f"{trust['held_out_state_coverage']:.1%}"
        yield "held-out demonstrations in it from end to end", f"{trust['held_out_path_coverage']:.1%}"
    yield "demonstrated steps that no action matches", f"{report['unmatched_share']:.1%}"


def _held_out_rows(config: Configuration, fitted: Fitted) -> list[tuple[str, str]]:
    """Return how the intent, rolled out from the starts of demonstrations it has not seen, compares with them."""
    aside = pipeline.held_out_of(config)
    if not aside:
        return []
    ends, apart = [], []
    for path in aside:
        begun, frame = config.task.as_held(path[:1]), fitted.model.start_frame
        rolled = fitted.model.roll_out(frame.to_frame(begun, begun), 2 * len(path), config.task.step_m)[:, 0]
        rolled = frame.laid(rolled, begun[0])
        ends.append(bool(config.task.reached(rolled[-1:])[0]))
        apart.append(hausdorff_mm(rolled, path))
    return [
        ("kept for evaluation, rolled out: goal reached", f"{sum(ends)} of {len(ends)}"),
        ("kept for evaluation, rolled out: median Hausdorff distance", f"{np.median(apart):.1f} mm"),
    ]
