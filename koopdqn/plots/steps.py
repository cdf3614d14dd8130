"""The pictures of demonstrations over their steps: each component of the pose, and how far the goal is."""

from pathlib import Path
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.intent.trust import COMPONENTS, components_of
from koopdqn.paths import to_count
from koopdqn.plots.style import BLUE, GREEN, GREY, ORANGE, RED, TRUST, picture, two_digits
from koopdqn.pose import Array
from koopdqn.tasks.knife import KnifeTask
from koopdqn.tasks.task import Task

WIDTH = 840
# A component that is held varies by rounding only; an axis that magnifies this would show noise.
_LEAST_SPAN: Final = {"m": 0.02, "°": 4.0}
_ROUNDING: Final = 1e-9


def plot_components(path: Path, trajectories: list[Array], task: Task, first: int, sigmas: float) -> None:
    """Draw x, y, z or roll, pitch, yaw of demonstrations over their steps, aligned by the share of their path.

    Args:
        path: the PNG.
        trajectories: demonstrated poses (N, 7) at the agent's step.
        task: gives the frame of the angles.
        first: the first of the three: 0 for positions, 3 for angles.
        sigmas: k, half the width of the band in standard deviations.

    Raises:
        BadInputError: the file cannot be written.
    """
    longest = max(len(trajectory) for trajectory in trajectories)
    rows = np.array([components_of(to_count(trajectory, longest), task.frame) for trajectory in trajectories])
    rows[..., 3:] = np.degrees(np.unwrap(rows[..., 3:], axis=1))
    what, unit, gap = ("orientation", "°", "") if first else ("position", "m", " ")
    with picture(path, f"{task.name.capitalize()}: {what}", WIDTH, 900) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for index, axes in enumerate(stack, first):
            samples = rows[..., index]
            mean, deviation = samples.mean(axis=0), samples.std(axis=0)
            low, high = mean - sigmas * deviation, mean + sigmas * deviation
            axes.fill_between(range(longest), low, high, color=TRUST, lw=0, label=f"mean ± {sigmas:g} σ")
            axes.plot(samples.T, color=GREY, linewidth=0.7)[0].set_label(f"{len(samples)} demonstrations")
            axes.plot(mean, color=BLUE, linewidth=1.8, label="mean")
            bottom, top = axes.get_ylim()
            half, middle = max(top - bottom, _LEAST_SPAN[unit]) / 2, (top + bottom) / 2
            axes.set(xlim=(0, longest - 1), ylim=(middle - half, middle + half))
            axes.set_ylabel(f"{COMPONENTS[index]} [{unit}]")
            extents = deviation.max(), np.ptp(samples[:, 0])
            largest, apart = (two_digits(extent if extent > _ROUNDING else 0.0) + f"{gap}{unit}" for extent in extents)
            axes.set_title(f"largest σ {largest}, starts differ by up to {apart}", fontsize=9)
        stack[-1].set_xlabel("step of the demonstration")
        stack[0].legend(loc="best", ncols=3)
        figure.align_ylabels(stack)


def spans(trajectories: list[Array], task: Task) -> dict[str, tuple[float, float]]:
    """Return the least and greatest value of every component over demonstrations (N, 7), in m and degrees."""
    rows = np.concatenate([components_of(trajectory, task.frame) for trajectory in trajectories])
    rows[:, 3:] = np.degrees(rows[:, 3:])
    # What is held varies by rounding; a minus before a zero would say nothing.
    low, high = (np.round(ends, 6) + 0.0 for ends in (rows.min(axis=0), rows.max(axis=0)))
    return dict(zip(COMPONENTS, zip(low.tolist(), high.tolist(), strict=True), strict=True))


def plot_turn(path: Path, trajectories: list[Array], task: KnifeTask, shown: int) -> None:
    """Draw the distances to the goal and the blade's turn, one demonstration over the others.

    Args:
        path: the PNG.
        trajectories: demonstrated poses (N, 7) at the agent's step.
        task: gives goal, edge and safe angle.
        shown: the demonstration drawn over the others.

    Raises:
        BadInputError: the file cannot be written.
    """
    order = [*(i for i in range(len(trajectories)) if i != shown), shown]
    with picture(path, "Distance to the goal, and the blade's turn", WIDTH, 1000) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for place, poses in enumerate(trajectories[index] for index in order):
            top = place == len(order) - 1
            curves = (
                (pose.position_distance(poses, task.goal), BLUE),
                (np.degrees(pose.rotation_distance(poses, task.goal)), ORANGE),
                (np.degrees(task.blade_angle(poses)), GREEN),
            )
            label = f"demonstration {shown}" if top else None if place else "the others"
            for axes, (values, colour) in zip(stack, curves, strict=True):
                axes.plot(values, color=colour if top else GREY, linewidth=2 if top else 0.8, label=label)
        half, _ = half_turn(trajectories[shown], task)
        for axes in stack[:2]:
            axes.axvline(half, color=GREY, linestyle="--", linewidth=1.2, label=f"turn half done: step {half}")
        safe = float(np.degrees(task.safe_angle_rad))
        stack[2].axhline(safe, color=RED, linestyle=":", label=f"safe below {safe:.3g}°")
        labels = ("position distance [m]", "rotation distance [°]", "edge from straight down [°]")
        for axes, label in zip(stack, labels, strict=True):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0)
            axes.legend(loc="upper right")
        stack[2].set(xlim=(0, max(map(len, trajectories)) - 1), xlabel="agent's step")
        figure.align_ylabels(stack)


def half_turn(poses: Array, task: KnifeTask) -> tuple[int, float]:
    """Return the step of poses (N, 7) at which half the turn is done, and the share of the way that is gone then."""
    turn, distance = pose.rotation_distance(poses, task.goal), pose.position_distance(poses, task.goal)
    half = int(np.argmax(turn <= turn[0] / 2))
    return half, float(1.0 - distance[half] / distance[0])
