"""Figure 6, right: how far position and orientation are from the goal along the knife demonstrations."""

from pathlib import Path

import numpy as np

from koopdqn import pose
from koopdqn.plots.style import BLUE, GREEN, GREY, ORANGE, RED, picture
from koopdqn.pose import Array
from koopdqn.tasks.knife import KnifeTask

WIDTH, HEIGHT = 840, 1000


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
    degree = float(np.degrees(1.0))
    with picture(path, "Distance to the goal, and the blade's turn", WIDTH, HEIGHT) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for index in [*(i for i in range(len(trajectories)) if i != shown), shown]:
            poses, top = trajectories[index], index == shown
            rows = (
                (pose.position_distance(poses, task.goal), BLUE),
                (pose.rotation_distance(poses, task.goal) * degree, ORANGE),
                (task.blade_angle(poses) * degree, GREEN),
            )
            others = index == (1 if shown == 0 else 0)
            for axes, (values, colour) in zip(stack, rows, strict=True):
                label = f"demonstration {shown}" if top else "the others" if others else None
                axes.plot(values, color=colour if top else GREY, linewidth=2 if top else 0.8, label=label)
        half = _first_below_half(pose.rotation_distance(trajectories[shown], task.goal))
        for axes in stack[:2]:
            axes.axvline(half, color=GREY, linestyle="--", linewidth=1.2, label=f"turn half done: step {half}")
        safe = task.safe_angle_rad * degree
        stack[2].axhline(safe, color=RED, linestyle=":", label=f"safe below {safe:.3g}°")
        labels = ("position distance [m]", "rotation distance [°]", "edge from straight down [°]")
        for axes, label in zip(stack, labels, strict=True):
            axes.set_ylabel(label)
            axes.set_ylim(bottom=0)
            axes.legend(loc="upper right")
        stack[2].set_xlim(0, max(len(poses) for poses in trajectories) - 1)
        stack[2].set_xlabel("agent's step")
        figure.align_ylabels(stack)


def _first_below_half(distance: Array) -> int:
    return int(np.argmax(distance <= distance[0] / 2))


def travelled_at_half_turn(trajectory: Array, task: KnifeTask) -> float:
    """Return the share of the position distance to the goal that poses (N, 7) have lost when half the turn is done."""
    half = _first_below_half(pose.rotation_distance(trajectory, task.goal))
    distance = pose.position_distance(trajectory, task.goal)
    return float(1.0 - distance[half] / distance[0])
