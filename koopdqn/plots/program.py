"""The picture of a robot program: the arm on its path, the share of each limit over time, and how dynamics follows."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import PercentFormatter

from koopdqn import console, pose
from koopdqn.errors import WorkFailedError
from koopdqn.plots.style import BLUE, GREEN, INK, LEARNED, ORANGE, PINK, draw_motion, picture, show_image
from koopdqn.programs.program import Program
from koopdqn.robot.scene import Scene

WIDTH, HEIGHT = 1500, 720
_NAMES: Final = {
    "speed": ("joint speed", BLUE),
    "acceleration": ("joint acceleration", ORANGE),
    "jerk": ("joint jerk", PINK),
    "tool_speed": ("tool speed", GREEN),
}


def plot_program(path: Path, title: str, program: Program, scene: Scene) -> None:
    """Draw a program into a PNG; where OpenGL does not work the arm is left out, with a warning.

    Raises:
        BadInputError: the file cannot be written.
    """
    motion = program.motion
    try:
        image = draw_motion(scene, motion.joints, [motion.poses[:, pose.POSITION]], [LEARNED])
    except WorkFailedError as error:
        console.warn(f"{path.name} shows no arm: {error}")
        image = None
    with picture(path, title, WIDTH, HEIGHT) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.7, 1), width_ratios=(1, 1.2))
        limits = figure.add_subplot(grid[0, int(image is not None) :])
        tracking = figure.add_subplot(grid[1, int(image is not None) :], sharex=limits)
        if image is not None:
            show_image(figure.add_subplot(grid[:, 0]), image, "The arm at the path's end; its start as a ghost")
        _limits(limits, program)
        _tracking(tracking, program)


def _limits(axes: Axes, program: Program) -> None:
    for name, shares in program.motion.used(program.limits).items():
        label, colour = _NAMES[name]
        # Of differences, each belongs to the middle of its samples; rest before and after is cut evenly.
        times = program.motion.period * (np.arange(len(shares)) - (len(shares) - len(program.motion.joints)) / 2)
        axes.plot(times, shares, color=colour, label=label, linewidth=1.2)
    axes.axhline(1.0, color=INK, linewidth=0.8, linestyle=":")
    axes.set(ylim=(0, 1.3), ylabel="share of the limit")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    axes.set_title("What the motion uses of its limits, the largest joint's share")
    axes.legend(loc="upper center", ncols=4)


def _tracking(axes: Axes, program: Program) -> None:
    made = program.execution
    times = made.physics_seconds * (np.arange(len(made.tracking_error_mm)) + 1)
    axes.plot(times, made.tracking_error_mm, color=BLUE)
    axes.set(xlabel="time [s]", ylabel="off its sample [mm]", xlim=(0, float(program.motion.times[-1])))
    axes.set_ylim(bottom=0)
    axes.set_title("The flange in MuJoCo's dynamics")
