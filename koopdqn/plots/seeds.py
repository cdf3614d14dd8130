"""The pictures of several runs with their spread over seeds: rewards in training, and what a sweep comes to."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import EngFormatter, PercentFormatter

from koopdqn.plots.style import BLUE, GREY, INK, ORANGE, RED, SKY, picture
from koopdqn.plots.train import WINDOW, running_mean

WIDTH, HEIGHT = 840, 900


def plot_rewards(path: Path, reports: Sequence[Mapping[str, Any]], title: str) -> None:
    """Draw the reward of every episode, its running mean with the spread over seeds, and the checks' success.

    Args:
        path: the PNG.
        reports: the contents of ``train.json`` of runs of one configuration, one a seed.
        title: above everything.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, title, WIDTH, HEIGHT) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=(1.6, 1))
        _rewards(upper, reports)
        _checks(lower, reports)


def _rewards(axes: Axes, reports: Sequence[Mapping[str, Any]]) -> None:
    rewards = [np.array(report["reward_per_episode"], dtype=float) for report in reports]
    exploring = np.concatenate([report["exploring_episode"] for report in reports]).astype(bool)
    number, every = np.concatenate([np.arange(len(each)) + 1 for each in rewards]), np.concatenate(rewards)
    for chosen, colour, size, label in ((exploring, GREY, 2.5, "exploring"), (~exploring, ORANGE, 5, "whole")):
        look: dict[str, Any] = {"linestyle": "", "marker": ".", "markersize": size, "color": colour}
        axes.plot(number[chosen], every[chosen], label=f"an episode, {label}", **look)
    curves = [running_mean(each) for each in rewards if len(each) >= WINDOW]
    for index, curve in enumerate(curves):
        once = None if index else f"a seed, mean of {WINDOW} episodes"
        axes.plot(np.arange(len(curve)) + WINDOW, curve, color=SKY, linewidth=1.0, label=once)
    if curves:
        shared = min(map(len, curves))
        together, episode = np.array([curve[:shared] for curve in curves]), np.arange(shared) + WINDOW
        mean, deviation = together.mean(axis=0), together.std(axis=0)
        if len(curves) > 1:
            band: dict[str, Any] = {"color": BLUE, "alpha": 0.18, "lw": 0, "label": "± 1 σ over seeds"}
            axes.fill_between(episode, mean - deviation, mean + deviation, **band)
        label = f"mean over {len(curves)} seeds" if len(curves) > 1 else "mean of the one seed"
        axes.plot(episode, mean, color=BLUE, linewidth=2.2, label=label)
    low, high = axes.get_ylim()
    axes.set(ylim=(low, high + 0.3 * (high - low)), ylabel="reward gathered in the episode")
    axes.set_xlim(left=0)
    axes.set_xlabel("episode, in the order in which they ended")
    axes.legend(loc="upper left", ncols=2)


def _checks(axes: Axes, reports: Sequence[Mapping[str, Any]]) -> None:
    for report in reports:
        steps, rates = ([check[key] for check in report["checks"]] for key in ("env_steps", "success_rate"))
        axes.plot(steps, rates, marker="o", markersize=4, label=f"seed {report['seed']}", linewidth=1.2)
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle=":")
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

    Args:
        path: the PNG.
        title: above everything.
        variants: the label of each, and the known values of its runs by the quantity's name with its unit; the
            same quantities in each.

    Raises:
        BadInputError: the file cannot be written.
    """
    names = list(variants[0][1])
    row_height = LINE * max(2, *(label.count("\n") + 2 for label, _ in variants))
    with picture(path, title, SWEEP_WIDTH, AROUND + row_height * len(variants)) as figure:
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for axes, name in zip(panels, names, strict=True):
            for row, (_, quantities) in enumerate(variants):
                values = np.asarray(quantities[name], dtype=float)
                if not values.size:
                    continue
                places = row + np.linspace(-_JITTER, _JITTER, values.size) * (values.size > 1)
                axes.plot(values, places, linestyle="", marker="o", markersize=4, color=GREY)
                deviation = values.std(ddof=1) if values.size > 1 else 0.0
                bar: dict[str, Any] = {
                    "fmt": "D",
                    "markersize": 6,
                    "color": BLUE,
                    "ecolor": INK,
                    "elinewidth": 1.4,
                    "capsize": 4,
                }
                axes.errorbar(values.mean(), row, xerr=deviation, **bar)
            known = [value for _, quantities in variants for value in quantities[name]]
            if not known:
                note: dict[str, Any] = {"transform": axes.transAxes, "ha": "center", "va": "center", "color": RED}
                axes.text(0.5, 0.5, "not measured", **note)
                axes.tick_params(labelbottom=False)
            # Every quantity is 0 or more; a share has an end.
            end = 100.0 if name.endswith("[%]") else max([*known, axes.get_xlim()[1]])
            axes.set_xlim(-0.04 * end, 1.04 * end)
            axes.locator_params(axis="x", nbins=5)
            axes.set_xlabel(name)
            axes.grid(False, axis="y")
        panels[0].set_yticks(range(len(variants)), [label for label, _ in variants])
        panels[0].set_ylim(len(variants) - 0.5, -0.5)
