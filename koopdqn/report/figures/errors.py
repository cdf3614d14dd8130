"""Figures 4, 5 and 9, left: one-step errors of the intents on a held-out demonstration, and the fitted line."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes

from koopdqn import pose
from koopdqn.intent.separate import line_through
from koopdqn.plots.style import ASK, BLUE, DEMONSTRATED, GREY, INK, ORANGE, PINK, SKY, picture
from koopdqn.pose import Array
from koopdqn.report.intents import SAMPLES, IntentStudy
from koopdqn.tasks.task import Task

WIDTH: Final = 840
_MM: Final = 1e3
_PAPER_BOUNDS_MM: Final = (1.5, 2.3)
"""§5.1: errors under the first at most steps, under the second at steps 48 to 52."""
NAMES: Final = {"paper": "the paper's lift", "pose": "default lift", "line": "line", "joint": "one K for the pose"}
_COLOURS: Final = {"paper": ORANGE, "pose": BLUE, "line": PINK, "joint": SKY}

Quantity = Literal["position", "rotation"]


def plot_errors(
    path: Path, studies: Mapping[str, IntentStudy], task: Task, quantity: Quantity, title: str, bounds: bool
) -> None:
    """Draw the errors of the paper's lift and of the default, a panel each, and both at the paper's sampling.

    Args:
        path: the PNG.
        studies: by intent; those of ``paper`` and ``fourier`` are drawn.
        task: gives the tolerances.
        quantity: which error.
        title: above everything.
        bounds: whether to draw the bounds that the paper states for the shelf.

    Raises:
        BadInputError: the file cannot be written.
    """
    column, unit, scale = (0, "mm", _MM) if quantity == "position" else (1, "°", float(np.degrees(1)))
    tolerance = (task.position_tolerance_m if quantity == "position" else task.rotation_tolerance_rad) * scale
    with picture(path, title, WIDTH, 1050) as figure:
        upper, lower, sixty = figure.subplots(3, 1)
        for axes, name in ((upper, "paper"), (lower, "pose")):
            _at_agents_step(axes, studies[name], column, scale, tolerance, unit)
        _at_paper_sampling(sixty, studies, column, scale, unit, _PAPER_BOUNDS_MM if bounds else ())


def _at_agents_step(axes: Axes, study: IntentStudy, column: int, scale: float, tolerance: float, unit: str) -> None:
    held_out = study.held_out
    raw, rescaled = held_out.error[:, column] * scale, held_out.rescaled[:, column] * scale
    _shade(axes, held_out.asked)
    axes.plot(raw, color=_COLOURS[study.name], label="raw prediction")
    lines = [(tolerance, INK, "--", "tolerance")]
    if study.reward.prediction == "rescaled" and column == 0:
        axes.plot(rescaled, color=GREY, linewidth=1.1, label="rescaled to the step, as compared")
    for value, colour, style, meaning in lines:
        axes.axhline(
            value,
            color=colour,
            linestyle=style,
            linewidth=1.2,
            label=f"{meaning} {value:.3g}{unit if unit == '°' else f' {unit}'}",
        )
    highest = max(float(raw.max()), float(rescaled.max()) if column == 0 else 0.0, tolerance)
    # A few steps far over the tolerance are cut off rather than flattening the rest.
    axes.set_ylim(0, 1.55 * min(highest, 6 * tolerance))
    axes.set_xlim(0, len(raw) - 1)
    axes.set_xlabel("agent's step")
    axes.set_ylabel(f"one-step error [{unit}]")
    shown = NAMES[study.name]
    share = held_out.asked.mean()
    axes.set_title(f"{shown[0].upper()}{shown[1:]} (intent={study.name}): the expert is asked at {share:.0%} of steps")
    axes.legend(loc="upper center", ncols=2)


def _at_paper_sampling(
    axes: Axes, studies: Mapping[str, IntentStudy], column: int, scale: float, unit: str, bounds: Sequence[float]
) -> None:
    highest = max(bounds, default=0.0)
    for name in ("paper", "pose"):
        error = studies[name].held_out.sixty[:, column] * scale
        axes.plot(error, color=_COLOURS[name], marker=".", markersize=4, label=NAMES[name])
        highest = max(highest, float(error.max()))
    for bound, meaning in zip(bounds, ("most steps", "its steps 48 to 52"), strict=False):
        axes.axhline(
            bound, color=GREY, linestyle=":", linewidth=1.4, label=f"the paper's bound, {meaning}: {bound:g} mm"
        )
    axes.set_ylim(0, 1.5 * highest)
    axes.set_xlim(0, SAMPLES - 2)
    axes.set_xlabel(f"step of the demonstration resampled to {SAMPLES} poses")
    axes.set_ylabel(f"one-step error [{unit}]")
    axes.set_title("Raw prediction at about the paper's sampling")
    axes.legend(loc="upper center", ncols=2)


def _shade(axes: Axes, asked: np.ndarray) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], asked, [False]]).astype(int)))
    for index, (start, end) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        label = None if index else "the expert is asked"
        axes.axvspan(start - 0.5, end - 0.5, color=ASK, lw=0, label=label, zorder=0)


def plot_line_fit(path: Path, trajectory: Array) -> None:
    """Draw a demonstrated trajectory (N, 7) and the least-squares line through it, one component a panel.

    Raises:
        BadInputError: the file cannot be written.
    """
    positions = trajectory[:, pose.POSITION]
    line = _line(positions)
    with picture(path, "Line fit against the trajectory", WIDTH, 900) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for i, axes in enumerate(stack):
            axes.plot(positions[:, i], color=DEMONSTRATED, linewidth=2, label="demonstrated")
            axes.plot(line[:, i], color=_COLOURS["line"], linestyle="--", label="least-squares line")
            axes.set_ylabel(f"{'xyz'[i]} [m]")
            axes.set_xlim(0, len(positions) - 1)
        stack[0].legend(loc="best", ncols=2)
        stack[-1].set_xlabel("agent's step")
        figure.align_ylabels(stack)


def plot_line_error(path: Path, trajectory: Array, studies: Mapping[str, IntentStudy]) -> None:
    """Draw the distance of a trajectory (N, 7) from its line fit beside the one-step errors of both lifts.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "Error of the line fit", WIDTH, 900) as figure:
        axes = figure.subplots()
        distance = line_distance(trajectory) * _MM
        axes.plot(distance, color=_COLOURS["line"], label="trajectory from its fitted line")
        for name in ("paper", "pose"):
            error = studies[name].held_out.error[:, 0] * _MM
            axes.plot(error, color=_COLOURS[name], label=f"one-step error, {NAMES[name]}")
        axes.set_yscale("log")
        axes.grid(True, which="minor", axis="y", linewidth=0.4)
        axes.set_xlim(0, len(trajectory) - 1)
        axes.set_xlabel("agent's step")
        axes.set_ylabel("error [mm]")
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.2)
        axes.legend(loc="upper center")


def line_distance(trajectory: Array) -> Array:
    """Return the distance (N,) [m] of each pose (N, 7) from the least-squares line at the same step (Fig. 5)."""
    positions = trajectory[:, pose.POSITION]
    return np.asarray(np.linalg.norm(positions - _line(positions), axis=1))


def _line(positions: Array) -> Array:
    offset, step = line_through(positions)
    return offset + np.arange(len(positions))[:, None] * step
