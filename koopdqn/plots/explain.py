"""The picture of one explained state: where it lies on its path, where the ten actions lead, and their values."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from koopdqn.plots import style
from koopdqn.pose import POSITION, Array
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 1560, 980
_AROUND_STEPS: Final = 4.5
"""How far around the state the actions are shown, in steps."""
_RIGHT, _WRONG = style.GREEN, style.RED
_STATE: Final[dict[str, Any]] = {
    "marker": "o",
    "markersize": 9,
    "fillstyle": "none",
    "color": style.INK,
    "linestyle": "",
    "zorder": 7,
}
# The star is the goal's.
_PREDICTED: Final[dict[str, Any]] = {
    "marker": "D",
    "markersize": 8,
    "color": style.INK,
    "markeredgecolor": "white",
    "linestyle": "",
    "zorder": 7,
}


def plot_explanation(
    path: Path,
    title: str,
    task: Task,
    content: dict[str, Any],
    learned: Array | None,
    reference: Array | None,
    demonstrated: Sequence[Array],
) -> None:
    """Draw a state that the content of an ``explain.json`` explains into a PNG.

    Beside it the policy's path (T, 3) [m], None where the state is on none, the reference (R, 3) [m] that this is
    compared with, if there is one, and demonstrated positions (N, 3) [m].

    Raises:
        BadInputError: the file cannot be written.
    """
    here = np.array(content["pose"])[POSITION]
    paths = [*demonstrated, *([] if learned is None else [learned])]
    # A name with dollar signs is no formula.
    with style.picture(path, title, WIDTH, HEIGHT) as figure:
        columns = figure.add_gridspec(1, 2, width_ratios=(2.1, 1))
        whole, near = columns[0].subgridspec(2, 2, height_ratios=(1, 1)).subplots(squeeze=False)
        for top, bottom, plane in zip(whole, near, style.two_planes(paths), strict=True):
            for axes in (top, bottom):
                _paths(axes, plane, learned, reference, demonstrated)
            style.frame_projection(top, plane, task, [*paths, here[None]])
            top.plot(*style.project(here[None], plane), **_STATE)
            top.set_title(f"From {style.VIEWS[plane]}")
            _actions(bottom, plane, content, _AROUND_STEPS * task.step_m)
        entries = _entries(on_path=learned is not None)
        figure.legend(list(entries.values()), list(entries), loc="outside lower center", ncols=4, handlelength=3.2)
        _values(figure.add_subplot(columns[1]), content["actions"])


def _paths(
    axes: Axes, plane: str, learned: Array | None, reference: Array | None, demonstrated: Sequence[Array]
) -> None:
    for track in demonstrated:
        axes.plot(*style.project(track, plane), color=style.DEMONSTRATED, linewidth=0.9)
    if reference is not None:
        axes.plot(*style.project(reference, plane), color=style.MEANT, linewidth=1.2, linestyle="--")
    if learned is not None:
        axes.plot(*style.project(learned, plane), color=style.LEARNED, linewidth=1.8)


def _actions(axes: Axes, plane: str, content: dict[str, Any], around: float) -> None:
    """Draw where the actions lead, near the state; of those that lead to one place in the view the right ones last."""
    here = np.array(content["pose"])[POSITION]
    x, y = (float(each[0]) for each in style.project(here[None], plane))
    for action in sorted(content["actions"], key=lambda each: (each["chosen"], each["reward"])):
        there = np.array(action["reached"])[None, POSITION]
        to_x, to_y = (float(each[0]) for each in style.project(there, plane))
        colour = _RIGHT if action["reward"] >= 0 else _WRONG
        look: dict[str, Any] = {
            "color": colour,
            "linewidth": 4.0 if action["chosen"] else 1.8,
            "solid_capstyle": "round",
        }
        asked = action["source"] == "asked"
        axes.plot([x, to_x], [y, to_y], linestyle=":" if asked else "-", zorder=5, **look)
        size, fill = 7 if action["chosen"] else 4, "white" if asked else colour
        axes.plot(to_x, to_y, "o", color=colour, markerfacecolor=fill, markersize=size, zorder=6)
    wished = np.array(content["predicted"])[None, POSITION]
    axes.plot(*style.project(wished, plane), **_PREDICTED)
    axes.plot(x, y, **_STATE)
    axes.set(xlim=(x - around, x + around), ylim=(y - around, y + around))
    axes.set_aspect("equal")
    axes.locator_params(nbins=5)
    axes.set_title(f"From {style.VIEWS[plane]}, near the state")
    i, j = style.PLANES[plane]
    axes.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")


def _entries(*, on_path: bool) -> dict[str, Line2D | Patch]:
    """Return what stands for each name of the legend."""
    entries: dict[str, Line2D | Patch] = {"demonstrated": Line2D([], [], color=style.DEMONSTRATED)}
    if on_path:
        entries["learned"] = Line2D([], [], color=style.LEARNED, linewidth=2)
        entries["compared with"] = Line2D([], [], color=style.MEANT, linestyle="--")
    return entries | {
        "start region": Patch(fill=False, edgecolor=style.GREY, linestyle="--", linewidth=1.2),
        "goal": Line2D([], [], color=style.INK, marker="*", markersize=12, linestyle=""),
        "the state": Line2D([], [], **_STATE),
        "predicted": Line2D([], [], **_PREDICTED),
        "action, reward: right": Line2D([], [], color=_RIGHT, linewidth=1.8, marker="o", markersize=5),
        "action, reward: wrong": Line2D([], [], color=_WRONG, linewidth=1.8, marker="o", markersize=5),
        "would be asked": Line2D([], [], color=style.GREY, linestyle=":", marker="o", markerfacecolor="white"),
        "the policy's choice": Line2D([], [], color=style.GREY, linewidth=4, marker="o", markersize=9),
    }


def _values(axes: Axes, actions: Sequence[dict[str, Any]]) -> None:
    values = np.array([action["q"] for action in actions])
    # Points, since the axis shows what tells them apart and need not hold 0.
    low, high = float(values.min()), float(values.max())
    room = max(high - low, 1e-6)
    for place, action in enumerate(actions):
        colour, chosen = _RIGHT if action["reward"] >= 0 else _WRONG, action["chosen"]
        asked = action["source"] == "asked"
        fill, dashes, width = "white" if asked else colour, ":" if asked else "-", 4.0 if chosen else 1.8
        axes.plot([low - 0.08 * room, action["q"]], [place, place], dashes, color=colour, linewidth=width)
        axes.plot(action["q"], place, "o", color=colour, markerfacecolor=fill, markersize=11 if chosen else 7)
        text = f"{action['reward']:+.2f} {action['source']}"
        axes.text(low, place - 0.18, text, va="bottom", color=style.INK, fontsize=8)
    axes.set_yticks(np.arange(len(actions)), [f"{action['number']} {action['name']}" for action in actions])
    axes.set(ylim=(len(actions) - 0.5, -0.8), xlim=(low - 0.08 * room, high + 0.08 * room), xlabel="Q")
    axes.set_title("Value Q; reward and its source")
    axes.grid(axis="y", visible=False)
