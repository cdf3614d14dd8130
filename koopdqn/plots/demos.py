"""The pictures of ``koopdqn demo`` and ``koopdqn inspect``: demonstrations in the scene, in figures, as recorded."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.demonstrations.schema import InspectedDemonstration
from koopdqn.paths import arc_lengths
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.robot.render import Image
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 1560, 1080
INSPECTED_SIZE = 1560, 960
"""Width and height of the picture of an inspection [pixels]."""
_WITHOUT_VARIATION: Final[dict[str, Any]] = {"color": style.MEANT, "linestyle": ":", "linewidth": 1.4}
_SPEED_WINDOW_S = 0.1
_LEAST_TURN_DEG = 4.0
"""The axis of turns goes as far at least."""


def plot_demonstrations(path: Path, demonstrations: Demonstrations, task: Task, image: Image | None) -> None:
    """Draw demonstrations of a task into a PNG.

    ``image`` shows them in the scene, in the colours of :func:`koopdqn.plots.style.series_colours`; None leaves its
    panel out.

    Raises:
        BadInputError: the file cannot be written.
    """
    count = len(demonstrations)
    title = f"{count} demonstration{'s' if count != 1 else ''} of task {task.name} with {demonstrations.arm}"
    with style.picture(path, title, WIDTH, HEIGHT) as figure:
        grid = figure.add_gridspec(1, 2, width_ratios=(1.45, 1))
        if image is None:
            places = grid[0].subgridspec(2, 1)
        else:
            halves = grid[0].subgridspec(2, 1, height_ratios=(1.55, 1))
            places = halves[1].subgridspec(1, 2)
            caption = "Arm at the goal, at the start as a ghost; demonstrated paths"
            style.show_image(figure.add_subplot(halves[0]), image, caption)
        axes = [figure.add_subplot(cell) for cell in (places[0], places[1])]
        planes = style.two_planes([item.poses[:, pose.POSITION] for item in demonstrations.items])
        for plane, each in zip(planes, axes, strict=True):
            _projection(each, plane, demonstrations, task)
            each.set_title(f"From {style.VIEWS[plane]}")
        rows = list(grid[1].subgridspec(4, 1).subplots(sharex=True, squeeze=False)[:, 0])
        _components(rows, demonstrations, task)
        figure.align_ylabels(rows)


def _projection(axes: Axes, plane: str, demonstrations: Demonstrations, task: Task) -> None:
    paths = [item.poses[:, pose.POSITION] for item in demonstrations.items]
    for path, colour in zip(paths, style.series_colours(len(paths)), strict=True):
        axes.plot(*style.project(path, plane), color=colour)
    axes.plot(*style.project(task.nominal_path.points, plane), **_WITHOUT_VARIATION)
    style.frame_projection(axes, plane, task, [*paths, task.nominal_path.points])
    axes.legend(loc="best")


def _components(axes: Sequence[Axes], demonstrations: Demonstrations, task: Task) -> None:
    """Draw x, y, z and speed, or the turn left to the goal where orientation is learned, over the path's share."""
    colours = style.series_colours(len(demonstrations))
    learned = task.orientation == "learned"
    for index, (item, colour) in enumerate(zip(demonstrations.items, colours, strict=True)):
        share = _share(item.poses[:, pose.POSITION])
        # Of many the first and the last say which way the colours run.
        named = len(colours) <= len(style.SERIES) or index in (0, len(colours) - 1)
        label = f"demonstration {index}" if named else None
        for i in range(3):
            axes[i].plot(share, item.poses[:, i], color=colour, label=label)
        left = np.degrees(pose.rotation_distance(item.poses, task.goal))
        axes[3].plot(share, left if learned else _speed(item), color=colour)
    meant = task.nominal_path.points
    for i in range(3):
        axes[i].plot(_share(meant), meant[:, i], label="without variation", **_WITHOUT_VARIATION)
        axes[i].set_ylabel(f"{'xyz'[i]} [m]")
    axes[0].set_title("Flange along the path")
    axes[3].set_ylabel("turn left to goal [°]" if learned else "speed [m/s]")
    axes[3].set_ylim(bottom=0.0)
    axes[3].set(xlabel="share of the path travelled [%]", xlim=(0, 100))
    # Within a panel it would lie on the paths, which fill it.
    axes[3].legend(*axes[0].get_legend_handles_labels(), loc="upper center", bbox_to_anchor=(0.5, -0.35), ncols=3)


def _share(positions: Array) -> Array:
    """Return the share [%] of the path travelled at each position (N, 3)."""
    arc = arc_lengths(positions)
    return 100.0 * arc / max(float(arc[-1]), 1e-12)


def _speed(item: Demonstration) -> Array:
    """Return the flange's speed (N,) [m/s], each the mean over a moment that outlasts the noise of samples."""
    arc = arc_lengths(item.poses[:, pose.POSITION])
    before = np.clip(item.times - _SPEED_WINDOW_S / 2, item.times[0], item.times[-1])
    after = np.clip(item.times + _SPEED_WINDOW_S / 2, item.times[0], item.times[-1])
    moved = np.interp(after, item.times, arc) - np.interp(before, item.times, arc)
    return np.asarray(moved / (after - before))


_PLACES: Final = (0, 25, 50, 75, 100)
"""Shares of a path at which the spread is known [%]."""


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
    with style.picture(path, f"{count}, inspected for {arm} (o: start; pale: as recorded)", *INSPECTED_SIZE) as figure:
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
        # What is held turns by rounding alone.
        turns.set_ylim(0.0, max(turns.get_ylim()[1], _LEAST_TURN_DEG))
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
    i, j = style.PLANES[plane]
    axes.set(title=f"From {style.VIEWS[plane]}", xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")
    axes.set_aspect("equal", adjustable="datalim")
    # Ticks of two decimals: the layout is made before the aspect is known, and has no room for more.
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


def _shares(axes: Axes, each: Sequence[InspectedDemonstration], colours: Sequence[str]) -> None:
    places = np.arange(len(each))
    axes.bar(places - 0.2, [100.0 * one.reached for one in each], 0.4, color=style.GREEN, label="way followed")
    speeds = [np.nan if one.joint_speed is None else 100.0 * one.joint_speed for one in each]
    axes.bar(places + 0.2, speeds, 0.4, color=style.ORANGE, label="joint speed, of its limit")
    axes.axhline(100.0, color=style.INK, linestyle=":")
    axes.set(title="On the arm", ylabel="[%]", xlabel="demonstration")
    axes.set_xticks(places)
    for tick, colour in zip(axes.get_xticklabels(), colours, strict=True):
        tick.set_color(colour)
    axes.set_ylim(0.0, 1.35 * max(100.0, float(np.nanmax([0.0, *speeds]))))
    axes.legend(loc="upper left", ncols=2)


def _learning(axes: Axes, spread_mm: Sequence[float], left_out_mm: Sequence[float]) -> None:
    axes.set_title("Beside one another")
    if not left_out_mm:
        style.note(axes, "one alone", style.GREY)
        axes.set_axis_off()
        return
    axes.plot(np.arange(1, len(left_out_mm) + 1), left_out_mm, "o-", color=style.BLUE, label="one left out of n + 1")
    axes.set(xlabel="n", ylabel="[mm]")
    # With room for the legend above what is drawn.
    axes.set_ylim(0.0, 1.45 * max(*left_out_mm, *spread_mm))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    second = axes.twiny()
    second.plot(_PLACES, spread_mm, "s--", color=style.PINK, label="spread along the path")
    second.set_xlabel("share of the path [%]")
    second.grid(visible=False)
    lines = [*axes.get_lines(), *second.get_lines()]
    axes.legend(lines, [str(line.get_label()) for line in lines], loc="upper right")
