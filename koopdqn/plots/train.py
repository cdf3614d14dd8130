"""The picture of ``koopdqn train``: when it was learned, the rewards of episodes, and who gave them."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, PercentFormatter

from koopdqn.intent.reward import RULE, SOURCES
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.rl.checks import History

WIDTH, HEIGHT = 1560, 900
WINDOW = 25
"""Episodes in the running mean."""
_SOURCE_COLOURS = {
    "rule": style.GREY,
    "trusted": style.GREEN,
    "asked": style.ORANGE,
    "remembered": style.SKY,
    "certified": style.BLUE,
}


def plot_training(path: Path, history: History, report: dict[str, Any]) -> None:
    """Draw what happened during training into a PNG.

    Args:
        path: the file.
        history: what happened.
        report: the content of ``train.json``.

    Raises:
        BadInputError: the file cannot be written.
    """
    verdict = "learned" if report["learned"] else "not learned"
    title = (
        f"Training on task {report['task']}: {verdict}, {report['env_steps']:,} actions tried,"
        f" {report['episodes']:,} episodes, {report['oracle_queries']:,} questions asked"
    )
    with style.picture(path, title, WIDTH, HEIGHT) as figure:
        grid = figure.add_gridspec(2, 6)
        _success(figure.add_subplot(grid[0, :4]), history, report["learned_at_env_steps"])
        _rewards_given(figure.add_subplot(grid[0, 4:]), history)
        _rewards(figure.add_subplot(grid[1, :2]), history)
        _loss(figure.add_subplot(grid[1, 2:4]), history)
        _agreement(figure.add_subplot(grid[1, 4:]), history)


def _success(axes: Axes, history: History, learned_at: int | None) -> None:
    steps = [check.env_steps for check in history.checks]
    rates = [check.success_rate for check in history.checks]
    axes.plot(steps, rates, color=style.LEARNED, marker="o", markersize=5, label="success on held-out starts")
    if learned_at is not None:
        axes.axvline(
            learned_at, color=style.GREEN, linewidth=1.5, linestyle="--", label=f"learned at {learned_at:,} actions"
        )
    axes.set_ylim(-0.04, 1.04)
    axes.set_xlim(left=0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("actions tried")
    axes.set_ylabel("success rate")
    axes.set_title("Checks of the policy alone")
    _legend_or_note(axes, bool(steps), "no check was made")


def _rewards(axes: Axes, history: History) -> None:
    rewards = np.array(history.rewards, dtype=float)
    exploring = np.array(history.exploring, dtype=bool)
    number = np.arange(1, len(rewards) + 1)
    for chosen, dot, line, label in (
        (exploring, style.PALE, style.GREY, "short, exploring"),
        (~exploring, style.SKY, style.BLUE, "whole"),
    ):
        if chosen.any():
            axes.plot(number[chosen], rewards[chosen], linestyle="", marker=".", markersize=5, color=dot, label=label)
        if chosen.sum() >= WINDOW:
            mean = running_mean(rewards[chosen])
            axes.plot(number[chosen][WINDOW - 1 :], mean, color=line, linewidth=2, label=f"mean of {WINDOW} of them")
    # Room above for the legend.
    axes.margins(y=0.05)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.35 * (high - low))
    axes.set_xlabel("episode")
    axes.set_ylabel("reward gathered")
    axes.set_title("Reward of each episode")
    _legend_or_note(axes, bool(len(rewards)), "no episode was finished")


def running_mean(values: Array) -> Array:
    """Return the means (N − 24,) of every 25 successive values (N,)."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    return np.asarray((sums[WINDOW:] - sums[:-WINDOW]) / WINDOW)


def _loss(axes: Axes, history: History) -> None:
    updates = [check.updates for check in history.checks]
    axes.plot(updates, history.losses, color=style.BLUE, marker="o", markersize=4, label="mean since the last check")
    if any(loss > 0 for loss in history.losses):
        axes.set_yscale("log")
        axes.grid(True, which="minor", axis="y", linewidth=0.4)
    axes.set_xlabel("updates")
    axes.set_ylabel("loss [reward²]")
    axes.set_title("Temporal-difference loss")
    _legend_or_note(axes, bool(updates), "no check was made")


def _rewards_given(axes: Axes, history: History) -> None:
    names = [name for i, name in enumerate(SOURCES) if i != RULE]
    counts = [int(history.labelled[SOURCES.index(name)]) for name in names]
    axes.barh(names, counts, color=[_SOURCE_COLOURS[name] for name in names], height=0.6)
    total = max(sum(counts), 1)
    for row, count in enumerate(counts):
        axes.annotate(
            f"{count:,} ({count / total:.2%})",
            (count, row),
            (5, 0),
            textcoords="offset points",
            va="center",
            color=style.INK,
        )
    axes.set_xlim(0, 1.75 * max(*counts, 1))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.locator_params(axis="x", nbins=5)
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    axes.set_xlabel("rewards given")
    axes.set_title("Where rewards came from")


def _agreement(axes: Axes, history: History) -> None:
    shares = history.agreement()
    for row, (name, share) in enumerate(shares.items()):
        axes.barh(row, share or 0.0, color=_SOURCE_COLOURS[name], height=0.6)
        text = "none given" if share is None else f"{share:.1%}"
        axes.annotate(text, (1.0, row), (5, 0), textcoords="offset points", va="center", color=style.INK)
    axes.axvline(1.0, color=style.GREY, linewidth=1.0)
    axes.set_yticks(range(len(shares)), list(shares))
    axes.set_xlim(0, 1.4)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    axes.set_xlabel("rewards that the demonstrator agrees with")
    axes.set_title("Agreement with the demonstrator")


def _legend_or_note(axes: Axes, anything: bool, note: str) -> None:
    if anything:
        axes.legend(loc="best")
    else:
        axes.text(0.5, 0.5, note, transform=axes.transAxes, ha="center", va="center", color=style.RED)
