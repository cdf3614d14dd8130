"""The picture of one explained state: where it lies on its path, where the ten actions lead, and their values."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.legend_handler import HandlerTuple
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
        handles: list[Any] = list(entries.values())
        look: dict[str, Any] = {"loc": "outside lower center", "ncols": 4, "handlelength": 3.2}
        # What has a look in the views and one in the bars has both beside each other.
        look["handler_map"] = {tuple: HandlerTuple(ndivide=None, pad=0.6)}
        figure.legend(handles, list(entries), **look)
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
        axes.plot([x, to_x], [y, to_y], linestyle=":" if action["source"] == "asked" else "-", zorder=5, **look)
        axes.plot(to_x, to_y, "o", color=colour, markersize=7 if action["chosen"] else 4, zorder=6)
    wished = np.array(content["predicted"])[None, POSITION]
    axes.plot(*style.project(wished, plane), **_PREDICTED)
    axes.plot(x, y, **_STATE)
    axes.set(xlim=(x - around, x + around), ylim=(y - around, y + around))
    axes.set_aspect("equal")
    axes.locator_params(nbins=5)
    axes.set_title(f"From {style.VIEWS[plane]}, near the state")
    i, j = style.PLANES[plane]
    axes.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")


def _entries(*, on_path: bool) -> dict[str, tuple[Line2D | Patch, ...]]:
    """Return what stands for each name of the legend: its look in the views, and in the bars where it has one."""
    entries: dict[str, tuple[Line2D | Patch, ...]] = {"demonstrated": (Line2D([], [], color=style.DEMONSTRATED),)}
    if on_path:
        entries["learned"] = (Line2D([], [], color=style.LEARNED, linewidth=2),)
        entries["compared with"] = (Line2D([], [], color=style.MEANT, linestyle="--"),)
    bar: dict[str, Any] = {"facecolor": style.GREY, "linewidth": 1.6}
    return entries | {
        "start region": (Patch(fill=False, edgecolor=style.GREY, linestyle="--", linewidth=1.2),),
        "goal": (Line2D([], [], color=style.INK, marker="*", markersize=12, linestyle=""),),
        "the state": (Line2D([], [], **_STATE),),
        "predicted": (Line2D([], [], **_PREDICTED),),
        "action, reward: right": (_action(_RIGHT), Patch(facecolor=_RIGHT)),
        "action, reward: wrong": (_action(_WRONG), Patch(facecolor=_WRONG)),
        "would be asked": (
            Line2D([], [], color=style.GREY, linestyle=":"),
            Patch(edgecolor="white", hatch="///", **bar),
        ),
        "the policy's choice": (Line2D([], [], color=style.GREY, linewidth=4), Patch(edgecolor=style.INK, **bar)),
    }


def _action(colour: str) -> Line2D:
    return Line2D([], [], color=colour, linewidth=1.8, marker="o", markersize=4)


def _values(axes: Axes, actions: Sequence[dict[str, Any]]) -> None:
    places = np.arange(len(actions))
    values = np.array([action["q"] for action in actions])
    colours = [_RIGHT if action["reward"] >= 0 else _WRONG for action in actions]
    hatches = ["///" if action["source"] == "asked" else "" for action in actions]
    edges = [style.INK if action["chosen"] else "white" for action in actions]
    # From the least value, so that what tells them apart is seen.
    low, high = float(values.min()), float(values.max())
    base = low - 0.3 * max(high - low, 1e-6)
    axes.barh(places, values - base, left=base, color=colours, hatch=hatches, edgecolor=edges, linewidth=1.6)
    for place, action in zip(places.tolist(), actions, strict=True):
        text = f"{action['reward']:+.2f} {action['source']}"
        room = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
        axes.text(base + 0.03 * (high - base), place, text, va="center", color=style.INK, fontsize=8, bbox=room)
    axes.set_yticks(places, [f"{action['number']} {action['name']}" for action in actions])
    axes.invert_yaxis()
    axes.set(xlim=(base, high + 0.05 * max(high - low, 1e-6)), xlabel="Q")
    axes.set_title("Value Q; reward and where it comes from")
    axes.grid(axis="y", visible=False)
