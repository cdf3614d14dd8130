"""The picture of ``koopdqn eval``: the learned paths beside the demonstrator's, and the policy beside the baselines."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from koopdqn import console, pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.evaluation.evaluate import Evaluation
from koopdqn.evaluation.metrics import SAMPLES, deviations
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.robot.render import Image
from koopdqn.tasks.rollout import SUCCESS
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 1560, 1180
_MM = 1e3
_SHOWN = 20
"""Paths drawn in a projection; more hide each other."""
_POLICY = "policy"


def plot_evaluation(
    path: Path, evaluation: Evaluation, demonstrations: Demonstrations, task: Task, image: Image | None
) -> None:
    """Draw an evaluation of a policy that was taught from demonstrations into a PNG.

    ``image`` shows learned paths in the scene; None leaves its panel out.

    Raises:
        BadInputError: the file cannot be written.
    """
    report = evaluation.report
    low, high = report["success_interval_95"]
    title = (
        f"Task {task.name}: {console.percent(report['success_rate'])} of {len(evaluation.episodes)} held-out starts"
        " succeed"
        f" (95 % interval {low:.0%} to {high:.0%})"
    )
    # Where demonstrations are held out, the references are theirs, and so are the starts of what is compared.
    aside = report.get("holdout") is not None
    with style.picture(path, title, WIDTH, HEIGHT) as figure:
        rows = figure.add_gridspec(2, 1, height_ratios=(1.45, 1) if image is not None else (1, 2))
        upper = rows[0].subgridspec(1, 2, width_ratios=(1, 1.1))
        panels = upper
        if image is not None:
            panels = upper[1].subgridspec(2, 1, height_ratios=(1, 1.35))
            caption = "Arm at the goal, at the start as a ghost; learned paths"
            style.show_image(figure.add_subplot(upper[0]), image, caption)
        views = rows[1].subgridspec(1, 2).subplots(squeeze=False)[0]
        _deviation(figure.add_subplot(panels[0]), evaluation, aside)
        demonstrated = [item.poses[:, pose.POSITION] for item in demonstrations.items]
        for axes, plane in zip(views, style.two_planes(demonstrated), strict=True):
            _projection(axes, plane, evaluation, demonstrated, task, aside)
            axes.set_title(f"Learned and demonstrated paths, from {style.VIEWS[plane]}")
        handles, labels = views[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        success, distance = panels[1].subgridspec(1, 2).subplots(sharey=True, squeeze=False)[0]
        _comparison(success, distance, report)


def _deviation(axes: Axes, evaluation: Evaluation, aside: bool) -> None:
    """Draw the distance from the references over the path's share: median and spread over episodes."""
    moved = [(e.poses, r) for e, r in zip(evaluation.compared, evaluation.references, strict=True) if e.steps]
    axes.set(xlabel="share of the path travelled [%]", ylabel="deviation [mm]")
    title = "Deviation from held-out demonstrations" if aside else "Deviation from the demonstrator's own path"
    axes.set(title=f"{title}, same start", xlim=(0, 100))
    if not moved:
        style.note(axes, "no episode made a step" if evaluation.compared else "no demonstration is held out")
        return
    apart = deviations([path for path, _ in moved], [reference for _, reference in moved])
    share = np.linspace(0, 100, SAMPLES)
    highest = 1e-6
    for values, colour, name in (
        (apart.matched, style.LEARNED, "matched by arc length"),
        (apart.lateral, style.RED, "sideways"),
    ):
        low, median, high = np.percentile(values * _MM, [5, 50, 95], axis=0)
        if len(values) > 1:
            axes.fill_between(share, low, high, color=colour, alpha=0.16, lw=0, label=f"{name}, 5–95 %")
        axes.plot(share, median, color=colour, label=f"{name}, median" if len(values) > 1 else name)
        highest = max(highest, float(high.max()))
    # Room above for the legend.
    axes.set_ylim(0, 1.45 * highest)
    axes.legend(loc="upper center", ncols=2)


def _projection(
    axes: Axes, plane: str, evaluation: Evaluation, demonstrated: list[Array], task: Task, aside: bool
) -> None:
    episodes = [*evaluation.compared, *evaluation.episodes] if aside else evaluation.episodes
    learned = [episode.poses[:, pose.POSITION] for episode in episodes[:_SHOWN]]
    meant = [reference[:, pose.POSITION] for reference in evaluation.references[:_SHOWN]]
    for paths, colour, dashes, width, label, order in (
        (meant, style.MEANT, ":", 1.0, "held out" if aside else "demonstrator, same starts", 2.2),
        (learned, style.LEARNED, "-", 1.1, "learned", 2.1),
        (demonstrated, style.DEMONSTRATED, "-", 1.3, "demonstrations", 2.0),
    ):
        for index, path in enumerate(paths):
            shown = f"{label} ({len(paths)})" if not index else None
            points = style.project(path, plane)
            axes.plot(*points, color=colour, linestyle=dashes, linewidth=width, label=shown, zorder=order)
    ends = [e.poses[-1:, pose.POSITION] for e in episodes[:_SHOWN] if e.outcome != SUCCESS]
    if ends:
        points = style.project(np.concatenate(ends), plane)
        axes.plot(*points, linestyle="", marker="x", color=style.RED, label="failed here", zorder=5)
    style.frame_projection(axes, plane, task, [*demonstrated, *learned])


def _comparison(success: Axes, distance: Axes, report: Mapping[str, Any]) -> None:
    """Draw success and deviation of the policy and of each baseline as bars."""
    methods: dict[str, Mapping[str, Any]] = {_POLICY: report, **(report["baselines"] or {})}
    rows = np.arange(len(methods))
    colours = [style.LEARNED if name == _POLICY else style.GREY for name in methods]
    rates = np.array([method["success_rate"] for method in methods.values()], dtype=float)
    intervals = np.array([method["success_interval_95"] for method in methods.values()], dtype=float)
    success.barh(rows, rates, color=colours, height=0.62)
    whiskers = np.clip([rates - intervals[:, 0], intervals[:, 1] - rates], 0.0, None)
    success.errorbar(rates, rows, xerr=whiskers, fmt="none", ecolor=style.INK, elinewidth=1.2, capsize=2)
    for row, (rate, top) in enumerate(zip(rates, intervals[:, 1], strict=True)):
        _value(success, max(rate, top), row, console.percent(rate))
    success.set_xlim(0, 1.3)
    success.set_xticks([0, 0.5, 1.0])
    success.xaxis.set_major_formatter(PercentFormatter(1.0))
    success.set_xlabel("success rate")
    success.set_yticks(rows, [name.replace("_", " ") for name in methods], fontsize=7.5)
    success.invert_yaxis()
    success.set_title("Success, 95 % interval")
    # Where demonstrations are held out, they alone are what a path can deviate from.
    if holdout := report.get("holdout"):
        methods = {_POLICY: holdout["policy"], **(holdout["baselines"] or {})}
    found = [method["path_deviation_mm"] for method in methods.values()]
    longest = 1e-6
    for row, (deviation, colour) in enumerate(zip(found, colours, strict=True)):
        mean, worst = deviation["mean"], deviation["p95_of_max"]
        if mean is None:
            _value(distance, 0.0, row, "nothing measured")
            continue
        reach = max(mean, worst or 0.0)
        longest = max(longest, reach)
        distance.barh(row, mean, color=colour, height=0.62)
        told = f"{mean:.1f}"
        if worst is not None:
            distance.plot(worst, row, marker="|", markersize=9, markeredgewidth=2, color=style.INK)
            told += f" | {worst:.1f}"
        _value(distance, reach, row, told)
    distance.tick_params(labelleft=False)
    distance.set(xlim=(0, 1.5 * longest), xlabel="mean, | 95 % of maxima [mm]", title="Path deviation")
    for axes in (success, distance):
        axes.grid(False, axis="y")


def _value(axes: Axes, place: float, row: int, text: str) -> None:
    axes.annotate(text, (place, row), (6, 0), textcoords="offset points", va="center", fontsize=7.5, color=style.INK)
