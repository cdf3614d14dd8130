"""The pictures of training: of one run, of several with their spread over seeds, and what a sweep comes to."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

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


def plot_training(path: Path, history: History, report: dict[str, Any]) -> None:
    """Draw a training's history, and what its ``train.json`` reports, into a PNG.

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
    axes.set(xlabel="actions tried", ylabel="success rate", title="Checks of the policy alone")
    _legend(axes, bool(steps), "no check was made")


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
    axes.set(ylim=(low, high + 0.35 * (high - low)), xlabel="episode", ylabel="reward gathered")
    axes.set_title("Reward of each episode")
    _legend(axes, bool(len(rewards)), "no episode was finished")


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
    axes.set(xlabel="updates", ylabel="loss [reward²]", title="Temporal-difference loss")
    _legend(axes, bool(updates), "no check was made")


def _rewards_given(axes: Axes, history: History) -> None:
    names = [name for i, name in enumerate(SOURCES) if i != RULE]
    counts = [int(history.labelled[SOURCES.index(name)]) for name in names]
    axes.barh(names, counts, color=[style.SOURCES[name] for name in names], height=0.6)
    total = max(sum(counts), 1)
    for row, count in enumerate(counts):
        text = f"{count:,} ({count / total:.2%})"
        axes.annotate(text, (count, row), (5, 0), textcoords="offset points", va="center", color=style.INK)
    axes.set_xlim(0, 1.75 * max(*counts, 1))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.locator_params(axis="x", nbins=5)
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    axes.set(xlabel="rewards given", title="Where rewards came from")


def _agreement(axes: Axes, history: History) -> None:
    shares = history.agreement()
    for row, (name, share) in enumerate(shares.items()):
        axes.barh(row, share or 0.0, color=style.SOURCES[name], height=0.6)
        text = "none given" if share is None else f"{share:.1%}"
        axes.annotate(text, (1.0, row), (5, 0), textcoords="offset points", va="center", color=style.INK)
    axes.axvline(1.0, color=style.GREY, linewidth=1.0)
    axes.set_yticks(range(len(shares)), list(shares))
    axes.set_xlim(0, 1.4)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0])
    axes.xaxis.set_major_formatter(PercentFormatter(1.0))
    axes.invert_yaxis()
    axes.grid(False, axis="y")
    axes.set(xlabel="rewards that the demonstrator agrees with", title="Agreement with the demonstrator")


def _legend(axes: Axes, anything: bool, otherwise: str) -> None:
    if anything:
        axes.legend(loc="best")
    else:
        style.note(axes, otherwise)


SEEDS_SIZE = 840, 900
"""Width and height of the picture of several runs [pixels]."""


def plot_rewards(path: Path, reports: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draw the reward of every episode, its running mean with the spread over seeds, and the checks' success.

    Reports are the contents of ``train.json`` of runs of one configuration, one a seed.

    Raises:
        BadInputError: the file cannot be written.
    """
    with style.picture(path, title, *SEEDS_SIZE) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=(1.6, 1))
        _rewards_of_seeds(upper, reports)
        _checks_of_seeds(lower, reports)


def _rewards_of_seeds(axes: Axes, reports: Sequence[Mapping[str, Any]]) -> None:
    rewards = [np.array(report["reward_per_episode"], dtype=float) for report in reports]
    exploring = np.concatenate([report["exploring_episode"] for report in reports]).astype(bool)
    number, every = np.concatenate([np.arange(len(each)) + 1 for each in rewards]), np.concatenate(rewards)
    for chosen, colour, size, label in (
        (exploring, style.GREY, 2.5, "exploring"),
        (~exploring, style.ORANGE, 5, "whole"),
    ):
        look: dict[str, Any] = {"linestyle": "", "marker": ".", "markersize": size, "color": colour}
        if chosen.any():
            axes.plot(number[chosen], every[chosen], label=f"an episode, {label}", **look)
    curves = [running_mean(each) for each in rewards if len(each) >= WINDOW]
    for index, curve in enumerate(curves):
        once = None if index else f"a seed, mean of {WINDOW} episodes"
        axes.plot(np.arange(len(curve)) + WINDOW, curve, color=style.SKY, linewidth=1.0, label=once)
    if curves:
        shared = min(map(len, curves))
        together, episode = np.array([curve[:shared] for curve in curves]), np.arange(shared) + WINDOW
        mean = together.mean(axis=0)
        if len(curves) > 1:
            deviation = together.std(axis=0, ddof=1)
            low, high = mean - deviation, mean + deviation
            axes.fill_between(episode, low, high, color=style.BLUE, alpha=0.18, lw=0, label="± 1 σ over seeds")
        label = f"mean over {len(curves)} seeds" if len(curves) > 1 else "mean of the one seed"
        axes.plot(episode, mean, color=style.BLUE, linewidth=2.2, label=label)
    low, high = axes.get_ylim()
    axes.set(ylim=(low, high + 0.3 * (high - low)), ylabel="reward gathered in the episode")
    axes.set_xlim(left=0)
    axes.set_xlabel("episode, in the order in which they ended")
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", ncols=2)


def _checks_of_seeds(axes: Axes, reports: Sequence[Mapping[str, Any]]) -> None:
    for report in reports:
        steps, rates = ([check[key] for check in report["checks"]] for key in ("env_steps", "success_rate"))
        axes.plot(steps, rates, marker="o", markersize=4, label=f"seed {report['seed']}", linewidth=1.2)
    axes.axhline(1.0, color=style.INK, linewidth=0.8, linestyle=":")
    axes.set(ylim=(-0.05, 1.3), yticks=(0, 0.5, 1.0), xlabel="actions tried", ylabel="success of the policy alone")
    axes.set_xlim(left=0)
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_title("Checks on held-out starts during training")
    axes.legend(loc="upper center", ncols=6)


SWEEP_WIDTH, LINE, AROUND = 1560, 22, 220
"""Width of the picture, height of a line of a variant's label, and of what stands around the rows [pixels]."""
_JITTER: Final = 0.16
"""Over how much of its row, to each side, the dots of a variant's runs are spread."""


def plot_sweep(path: Path, title: str, variants: Sequence[tuple[str, Mapping[str, Sequence[float]]]]) -> None:
    """Draw a panel a quantity with a row a variant: a dot a run, the mean, and one standard deviation to each side.

    A variant is its label, and the known values of its runs by the quantity's name with its unit; all have the same
    quantities.

    Raises:
        BadInputError: the file cannot be written.
    """
    names = list(variants[0][1])
    row_height = LINE * max(2, *(label.count("\n") + 2 for label, _ in variants))
    with style.picture(path, title, SWEEP_WIDTH, AROUND + row_height * len(variants)) as figure:
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            for row, (_, quantities) in enumerate(variants):
                values = np.asarray(quantities[name], dtype=float)
                if not values.size:
                    continue
                places = row + np.linspace(-_JITTER, _JITTER, values.size) * (values.size > 1)
                axes.plot(values, places, linestyle="", marker="o", markersize=4, color=style.GREY)
                deviation = values.std(ddof=1) if values.size > 1 else 0.0
                look: dict[str, Any] = {"fmt": "D", "markersize": 6, "color": style.BLUE, "ecolor": style.INK}
                axes.errorbar(values.mean(), row, xerr=deviation, elinewidth=1.4, capsize=4, **look)
            known = [value for _, quantities in variants for value in quantities[name]]
            if not known:
                style.note(axes, "not measured;\nkoopdqn eval does")
                axes.tick_params(labelbottom=False)
            # Every quantity is 0 or more; a share has an end.
            end = 100.0 if name.endswith("[%]") else max([*known, axes.get_xlim()[1]])
            axes.set_xlim(-0.04 * end, 1.04 * end)
            axes.locator_params(axis="x", nbins=5)
            axes.set_xlabel(name)
            axes.grid(False, axis="y")
        panels[0].set_yticks(range(len(variants)), [label for label, _ in variants], parse_math=False)
        panels[0].set_ylim(len(variants) - 0.5, -0.5)
