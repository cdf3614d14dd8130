"""Figures 4 and 9, right: reward of each episode, and success of the checks, with mean and spread over seeds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, PercentFormatter

from koopdqn.plots.style import BLUE, GREY, INK, ORANGE, SKY, picture
from koopdqn.pose import Array
from koopdqn.report.runs import Run

WIDTH, HEIGHT = 840, 900
WINDOW: Final = 25
"""Episodes in a running mean."""


def plot_rewards(path: Path, runs: Sequence[Run], title: str) -> None:
    """Draw the reward of every episode of runs of one configuration, and the success of their checks.

    Args:
        path: the PNG.
        runs: one a seed.
        title: above everything.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, title, WIDTH, HEIGHT) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=(1.6, 1))
        _rewards(upper, runs)
        _checks(lower, runs)


def _rewards(axes: Axes, runs: Sequence[Run]) -> None:
    curves = []
    for index, run in enumerate(runs):
        rewards = np.array(run.train["reward_per_episode"], dtype=float)
        episode, exploring = np.arange(1, len(rewards) + 1), np.array(run.train["exploring_episode"], dtype=bool)
        for chosen, colour, size, label in ((exploring, GREY, 2.5, "exploring"), (~exploring, ORANGE, 5, "whole")):
            shown = None if index else f"an episode, {label}"
            axes.plot(
                episode[chosen], rewards[chosen], linestyle="", marker=".", markersize=size, color=colour, label=shown
            )
        if len(rewards) >= WINDOW:
            curves.append(running_mean(rewards))
            axes.plot(
                np.arange(WINDOW, len(rewards) + 1),
                curves[-1],
                color=SKY,
                linewidth=1.0,
                label=f"a seed, mean of {WINDOW} episodes" if len(curves) == 1 else None,
            )
    if curves:
        shared = min(len(curve) for curve in curves)
        together = np.array([curve[:shared] for curve in curves])
        mean, deviation = together.mean(axis=0), together.std(axis=0)
        episode = np.arange(WINDOW, WINDOW + shared)
        if len(curves) > 1:
            axes.fill_between(
                episode, mean - deviation, mean + deviation, color=BLUE, alpha=0.18, lw=0, label="± 1 σ over seeds"
            )
        axes.plot(
            episode,
            mean,
            color=BLUE,
            linewidth=2.2,
            label=f"mean over {len(curves)} seeds" if len(curves) > 1 else "mean of the one seed",
        )
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.3 * (high - low))
    axes.set_xlim(left=0)
    axes.set_xlabel("episode, in the order in which they ended")
    axes.set_ylabel("reward gathered in the episode")
    axes.legend(loc="upper left", ncols=2)


def _checks(axes: Axes, runs: Sequence[Run]) -> None:
    for run in runs:
        checks = run.train["checks"]
        steps, rates = [check["env_steps"] for check in checks], [check["success_rate"] for check in checks]
        axes.plot(steps, rates, marker="o", markersize=4, label=f"seed {run.seed}", linewidth=1.2)
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set_ylim(-0.05, 1.3)
    axes.set_xlim(left=0)
    axes.set_yticks([0, 0.5, 1.0])
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel("actions tried")
    axes.set_ylabel("success of the policy alone")
    axes.set_title("Checks on held-out starts during training")
    axes.legend(loc="upper center", ncols=6)


def running_mean(values: Array) -> Array:
    """Return the means (N - 24,) of every 25 successive values (N,)."""
    sums = np.cumsum(np.concatenate([[0.0], values]))
    return np.asarray((sums[WINDOW:] - sums[:-WINDOW]) / WINDOW)
