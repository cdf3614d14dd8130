"""The pictures of one-step errors of intents on a demonstration that they have not seen, and of a line through it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from koopdqn.intent.separate import line_through
from koopdqn.plots.fit import shade
from koopdqn.plots.style import BLUE, DEMONSTRATED, GREY, INK, ORANGE, PINK, picture
from koopdqn.pose import Array

WIDTH: Final = 840
COLOURS: Final = {"paper": ORANGE, "pose": BLUE}
NAMES: Final = {"paper": "the paper's lift", "pose": "default lift"}
"""What the drawn intents are called."""
_PAPER_BOUNDS_MM: Final = {"most steps": 1.5, "its steps 48 to 52": 2.3}
"""§5.1: what position errors on the shelf are under."""


class Errors(NamedTuple):
    """One-step errors of an intent: raw (N,), rescaled to the step (N,) or None, asked (N,), at 60 samples (59,)."""

    raw: Array
    rescaled: Array | None
    asked: np.ndarray
    sixty: Array


def plot_errors(
    path: Path, title: str, errors: Mapping[str, Errors], unit: Literal["mm", "°"], tolerance: float, *, bounds: bool
) -> None:
    """Draw the errors of the paper's lift and of the default, a panel each, and both at the paper's sampling.

    Args:
        path: the PNG.
        title: above everything.
        errors: by intent, in the unit.
        unit: of errors and tolerance.
        tolerance: within which a prediction is right.
        bounds: whether to draw the bounds that the paper states for the shelf.

    Raises:
        BadInputError: the file cannot be written.
    """
    lines = _PAPER_BOUNDS_MM if bounds else {}
    with picture(path, title, WIDTH, 1050) as figure:
        *panels, sixty = figure.subplots(3, 1)
        for axes, name in zip(panels, NAMES, strict=True):
            _at_agents_step(axes, errors[name], COLOURS[name], f"tolerance {tolerance:.3g}", tolerance, unit)
            what = f"{NAMES[name][0].upper()}{NAMES[name][1:]} (intent={name})"
            axes.set_title(f"{what}: the expert is asked at {errors[name].asked.mean():.0%} of steps")
            sixty.plot(errors[name].sixty, color=COLOURS[name], marker=".", markersize=4, label=NAMES[name])
        for meaning, bound in lines.items():
            label = f"the paper's bound, {meaning}: {bound:g} mm"
            sixty.axhline(bound, color=GREY, linestyle=":", linewidth=1.4, label=label)
        highest = max(*lines.values(), *(each.sixty.max() for each in errors.values()))
        sixty.set(xlim=(0, len(errors["pose"].sixty) - 1), ylim=(0, 1.5 * highest))
        sixty.set_xlabel(f"step of the demonstration resampled to {len(errors['pose'].sixty) + 1} poses")
        sixty.set_title("Raw prediction at about the paper's sampling")
        for axes in (*panels, sixty):
            axes.set_ylabel(f"one-step error [{unit}]")
            axes.legend(loc="upper center", ncols=2)


def _at_agents_step(axes: Axes, errors: Errors, colour: str, label: str, tolerance: float, unit: str) -> None:
    shade(axes, errors.asked, len(errors.asked))
    axes.plot(errors.raw, color=colour, label="raw prediction")
    axes.axhline(
        tolerance, color=INK, linestyle="--", linewidth=1.2, label=label + (unit if unit == "°" else f" {unit}")
    )
    highest = max(errors.raw.max(), tolerance)
    if errors.rescaled is not None:
        axes.plot(errors.rescaled, color=GREY, linewidth=1.1, label="rescaled to the step, as compared")
        highest = max(highest, errors.rescaled.max())
    # A few steps far over the tolerance are cut off rather than flattening the rest.
    axes.set(xlim=(0, len(errors.raw) - 1), ylim=(0, 1.55 * min(highest, 6 * tolerance)), xlabel="agent's step")


def line_distance(positions: Array) -> Array:
    """Return the distance (N,) [m] of each position (N, 3) from the least-squares line at the same step (Fig. 5)."""
    return np.asarray(np.linalg.norm(positions - _line(positions), axis=1))


def _line(positions: Array) -> Array:
    offset, step = line_through(positions)
    return offset + np.arange(len(positions))[:, None] * step


def plot_line_fit(path: Path, positions: Array) -> None:
    """Draw demonstrated positions (N, 3) [m] and the least-squares line through them, one component a panel.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "Line fit against the trajectory", WIDTH, 900) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for i, axes in enumerate(stack):
            axes.plot(positions[:, i], color=DEMONSTRATED, linewidth=2, label="demonstrated")
            axes.plot(_line(positions)[:, i], color=PINK, linestyle="--", label="least-squares line")
            axes.set(xlim=(0, len(positions) - 1), ylabel=f"{'xyz'[i]} [m]")
        stack[0].legend(loc="best", ncols=2)
        stack[-1].set_xlabel("agent's step")
        figure.align_ylabels(stack)


def plot_line_error(path: Path, positions: Array, errors: Mapping[str, Array]) -> None:
    """Draw the distance of positions (N, 3) [m] from their line beside one-step errors (N − 1,) [mm] by intent.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "Error of the line fit", WIDTH, 900) as figure:
        axes = figure.subplots()
        axes.plot(1e3 * line_distance(positions), color=PINK, label="trajectory from its fitted line")
        for name in NAMES:
            axes.plot(errors[name], color=COLOURS[name], label=f"one-step error, {NAMES[name]}")
        axes.set(yscale="log", xlim=(0, len(positions) - 1), xlabel="agent's step", ylabel="error [mm]")
        axes.grid(True, which="minor", axis="y", linewidth=0.4)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.2)
        axes.legend(loc="upper center")
