"""The picture of ``koopdqn demo``: the demonstrated paths in the scene, and in figures."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.paths import arc_lengths
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.robot.render import Image
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 1560, 1080
_WITHOUT_VARIATION: Final[dict[str, Any]] = {"color": style.MEANT, "linestyle": ":", "linewidth": 1.4}
_SPEED_WINDOW_S = 0.1


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
        label = f"demonstration {index}" if len(set(colours)) > 1 else "demonstrations" if not index else None
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
    axes[3].set_xlabel("share of the path travelled [%]")
    axes[3].set_xlim(0, 100)
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
