"""Figures 3, 7 and 8: each pose component of the demonstrations, its mean and the band of k standard deviations."""

from pathlib import Path
from typing import Final, Literal

import numpy as np
from matplotlib.axes import Axes

from koopdqn.intent.trust import COMPONENTS, components_of
from koopdqn.paths import to_count
from koopdqn.plots.style import BLUE, GREY, INK, TRUST, picture
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 840, 900
# A component that is held varies by rounding only; an axis that magnifies this would show noise.
_LEAST_SPAN: Final = {"position": 0.02, "orientation": 4.0}
_ROUNDING: Final = 1e-9


def plot_components(
    path: Path,
    trajectories: list[Array],
    task: Task,
    part: Literal["position", "orientation"],
    sigmas: float,
    title: str,
) -> None:
    """Draw x, y, z or roll, pitch, yaw of demonstrations over their steps.

    The demonstrations are aligned by the share of their path, as the default trust domain aligns them; the steps
    are those of the longest.

    Args:
        path: the PNG.
        trajectories: demonstrated poses (N, 7) at the agent's step.
        task: gives the frame of the angles.
        part: which components.
        sigmas: k, half the width of the band in standard deviations.
        title: above everything.

    Raises:
        BadInputError: the file cannot be written.
    """
    longest = max(len(trajectory) for trajectory in trajectories)
    rows = np.array([components_of(to_count(trajectory, longest), task.frame) for trajectory in trajectories])
    rows[..., 3:] = np.degrees(np.unwrap(rows[..., 3:], axis=1))
    first, unit = (0, "m") if part == "position" else (3, "°")
    with picture(path, title, WIDTH, HEIGHT) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for row, axes in enumerate(stack):
            _component(axes, rows[..., first + row], sigmas, _LEAST_SPAN[part], unit)
            axes.set_ylabel(f"{COMPONENTS[first + row]} [{unit}]")
        stack[-1].set_xlabel("step of the demonstration")
        stack[0].legend(loc="best", ncols=3)
        figure.align_ylabels(stack)


def _component(axes: Axes, samples: Array, sigmas: float, least_span: float, unit: str) -> None:
    """Draw one component (D, T) of all demonstrations."""
    mean, deviation = samples.mean(axis=0), samples.std(axis=0)
    step = np.arange(samples.shape[1])
    low, high = mean - sigmas * deviation, mean + sigmas * deviation
    axes.fill_between(step, low, high, color=TRUST, lw=0, label=f"mean ± {sigmas:g} σ")
    for index, sample in enumerate(samples):
        axes.plot(step, sample, color=GREY, linewidth=0.7, label=None if index else f"{len(samples)} demonstrations")
    axes.plot(step, mean, color=BLUE, linewidth=1.8, label="mean")
    axes.set_xlim(0, len(step) - 1)
    bottom, top = axes.get_ylim()
    if top - bottom < least_span:
        middle = (top + bottom) / 2
        axes.set_ylim(middle - least_span / 2, middle + least_span / 2)
    gap = "" if unit == "°" else " "
    largest, start = (value if value > _ROUNDING else 0.0 for value in (deviation.max(), np.ptp(samples[:, 0])))
    axes.set_title(
        f"largest σ {largest:.2g}{gap}{unit}, starts differ by up to {start:.2g}{gap}{unit}", fontsize=9, color=INK
    )


def spans(trajectories: list[Array], task: Task) -> dict[str, tuple[float, float]]:
    """Return the least and greatest value of every component over demonstrations (N, 7), in m and degrees."""
    rows = np.concatenate([components_of(trajectory, task.frame) for trajectory in trajectories])
    rows[:, 3:] = np.degrees(rows[:, 3:])
    # What is held varies by rounding; a minus before a zero would say nothing.
    low, high = (np.round(ends, 6) + 0.0 for ends in (rows.min(axis=0), rows.max(axis=0)))
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(COMPONENTS)}
