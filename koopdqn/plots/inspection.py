"""The picture of ``koopdqn inspect``: paths as recorded and cleaned, speed, spread, and what each one more tells."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.demonstrations.schema import InspectedDemonstration
from koopdqn.paths import arc_lengths
from koopdqn.plots import style

WIDTH, HEIGHT = 1560, 960
_PLACES: Final = (0, 25, 50, 75, 100)


def plot_inspection(
    path: Path,
    raw: Sequence[Demonstration],
    cleaned: Sequence[Demonstration],
    each: Sequence[InspectedDemonstration],
    spread_mm: Sequence[float],
    left_out_mm: Sequence[float],
    arm: str,
) -> None:
    """Draw what an inspection found of each demonstration into a PNG: as recorded, pale, and after the steps.

    ``spread_mm`` (5,) is the spread along the path, ``left_out_mm`` the distance of one left out from the mean of
    1, 2, … others; both are empty for a single demonstration.

    Raises:
        BadInputError: the file cannot be written.
    """
    colours = style.series_colours(len(cleaned))
    count = f"{len(cleaned)} demonstration{'s' if len(cleaned) != 1 else ''}"
    with style.picture(path, f"{count}, inspected for {arm} (o: start; pale: as recorded)", WIDTH, HEIGHT) as figure:
        grid = figure.add_gridspec(2, 3)
        planes = style.two_planes([item.poses[:, pose.POSITION] for item in cleaned])
        for row, plane in enumerate(planes):
            axes = figure.add_subplot(grid[row, 0])
            _paths(axes, plane, raw, cleaned, colours)
        turns, speeds = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
        for item, colour in zip(cleaned, colours, strict=True):
            time = item.times - item.times[0]
            turns.plot(time, np.degrees(pose.rotation_distance(item.poses, item.poses[-1])), color=colour)
            way = arc_lengths(item.poses[:, pose.POSITION])
            speeds.plot(time[1:], np.diff(way) / np.diff(time), color=colour)
        turns.set(title="Turn left to its end", ylabel="[°]", xlabel="time [s]")
        speeds.set(title="Speed of the flange", ylabel="[m/s]", xlabel="time [s]")
        _shares(figure.add_subplot(grid[0, 2]), each, colours)
        _learning(figure.add_subplot(grid[1, 2]), spread_mm, left_out_mm)


def _paths(
    axes: Axes, plane: str, raw: Sequence[Demonstration], cleaned: Sequence[Demonstration], colours: Sequence[str]
) -> None:
    for before, after, colour in zip(raw, cleaned, colours, strict=True):
        axes.plot(*style.project(before.poses[:, pose.POSITION], plane), ".", color=style.PALE, markersize=4)
        x, y = style.project(after.poses[:, pose.POSITION], plane)
        axes.plot(x, y, color=colour)
        axes.plot(x[:1], y[:1], "o", color=colour)
    axes.set(title=f"From {style.VIEWS[plane]}", xlabel="[m]", ylabel="[m]")
    axes.set_aspect("equal", adjustable="datalim")


def _shares(axes: Axes, each: Sequence[InspectedDemonstration], colours: Sequence[str]) -> None:
    places = np.arange(len(each))
    axes.bar(places - 0.2, [100.0 * one.reached for one in each], 0.4, color=style.GREEN, label="way followed")
    speeds = [100.0 * (one.joint_speed or 0.0) for one in each]
    axes.bar(places + 0.2, speeds, 0.4, color=style.ORANGE, label="joint speed, of its limit")
    axes.axhline(100.0, color=style.INK, linestyle=":")
    axes.set(title="On the arm", ylabel="[%]", xlabel="demonstration")
    axes.set_xticks(places)
    for tick, colour in zip(axes.get_xticklabels(), colours, strict=True):
        tick.set_color(colour)
    axes.set_ylim(0.0, 1.35 * max(100.0, *speeds))
    axes.legend(loc="upper left", ncols=2)


def _learning(axes: Axes, spread_mm: Sequence[float], left_out_mm: Sequence[float]) -> None:
    axes.set_title("Beside one another")
    if not left_out_mm:
        style.note(axes, "one alone", style.GREY)
        axes.set_axis_off()
        return
    axes.plot(np.arange(1, len(left_out_mm) + 1), left_out_mm, "o-", color=style.BLUE, label="one left out of n + 1")
    axes.set(xlabel="n", ylabel="[mm]")
    axes.set_ylim(0.0, 1.1 * max(*left_out_mm, *spread_mm))
    second = axes.twiny()
    second.plot(_PLACES, spread_mm, "s--", color=style.PINK, label="spread along the path")
    second.set_xlabel("share of the path [%]")
    second.grid(visible=False)
    lines = [*axes.get_lines(), *second.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], loc="best")
