"""The pictures over the steps of demonstrations: components of the pose, the way to the goal, errors of intents."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from koopdqn import pose
from koopdqn.intent.separate import line_through
from koopdqn.intent.trust import COMPONENTS, components_of
from koopdqn.paths import to_count
from koopdqn.plots.fit import shade
from koopdqn.plots.style import BLUE, DEMONSTRATED, GREEN, GREY, INK, ORANGE, PINK, RED, TRUST, picture, two_digits
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
        sigmas: half the width of the band in standard deviations.

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
    """Draw the distances to the goal and the blade's turn along demonstrated poses (N, 7), one over the others.

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


COLOURS: Final = {"paper": ORANGE, "pose": BLUE}
NAMES: Final = {"paper": "the paper's lift", "pose": "default lift"}
"""What the drawn intents are called."""
_PAPER_BOUNDS_MM: Final = {"most steps": 1.5, "its steps 48 to 52": 2.3}
"""§5.1: what position errors on the shelf are under."""


class Errors(NamedTuple):
    """One-step errors of an intent: raw (N,), rescaled to the step (N,) or None, asked (N,), at 60 samples (59,)."""

    raw: Array
    rescaled: Array | None
    asked: np.ndarray
    sixty: Array


def plot_errors(
    path: Path, title: str, errors: Mapping[str, Errors], unit: Literal["mm", "°"], tolerance: float, *, bounds: bool
) -> None:
    """Draw the errors of the paper's lift and of the default, a panel each, and both at the paper's sampling.

    Errors and the tolerance within which a prediction is right are in the unit. With ``bounds`` those that the paper
    states for the shelf are drawn too.

    Raises:
        BadInputError: the file cannot be written.
    """
    lines = _PAPER_BOUNDS_MM if bounds else {}
    with picture(path, title, WIDTH, 1050) as figure:
        *panels, sixty = figure.subplots(3, 1)
        for axes, name in zip(panels, NAMES, strict=True):
            _at_agents_step(axes, errors[name], COLOURS[name], f"tolerance {tolerance:.3g}", tolerance, unit)
            what = f"{NAMES[name][0].upper()}{NAMES[name][1:]} (intent={name})"
            axes.set_title(f"{what}: the expert is asked at {errors[name].asked.mean():.0%} of steps")
            sixty.plot(errors[name].sixty, color=COLOURS[name], marker=".", markersize=4, label=NAMES[name])
        for meaning, bound in lines.items():
            label = f"the paper's bound, {meaning}: {bound:g} mm"
            sixty.axhline(bound, color=GREY, linestyle=":", linewidth=1.4, label=label)
        highest = max(*lines.values(), *(each.sixty.max() for each in errors.values()))
        sixty.set(xlim=(0, len(errors["pose"].sixty) - 1), ylim=(0, 1.5 * highest))
        sixty.set_xlabel(f"step of the demonstration resampled to {len(errors['pose'].sixty) + 1} poses")
        sixty.set_title("Raw prediction at about the paper's sampling")
        for axes in (*panels, sixty):
            axes.set_ylabel(f"one-step error [{unit}]")
            axes.legend(loc="upper center", ncols=2)


def _at_agents_step(axes: Axes, errors: Errors, colour: str, label: str, tolerance: float, unit: str) -> None:
    shade(axes, errors.asked, len(errors.asked))
    axes.plot(errors.raw, color=colour, label="raw prediction")
    axes.axhline(
        tolerance, color=INK, linestyle="--", linewidth=1.2, label=label + (unit if unit == "°" else f" {unit}")
    )
    highest = max(errors.raw.max(), tolerance)
    if errors.rescaled is not None:
        axes.plot(errors.rescaled, color=GREY, linewidth=1.1, label="rescaled to the step, as compared")
        highest = max(highest, errors.rescaled.max())
    # A few steps far over the tolerance are cut off rather than flattening the rest.
    axes.set(xlim=(0, len(errors.raw) - 1), ylim=(0, 1.55 * min(highest, 6 * tolerance)), xlabel="agent's step")


def line_distance(positions: Array) -> Array:
    """Return the distance (N,) [m] of each position (N, 3) from the least-squares line at the same step (Fig. 5)."""
    return np.asarray(np.linalg.norm(positions - _line(positions), axis=1))


def _line(positions: Array) -> Array:
    offset, step = line_through(positions)
    return offset + np.arange(len(positions))[:, None] * step


def plot_line_fit(path: Path, positions: Array) -> None:
    """Draw demonstrated positions (N, 3) [m] and the least-squares line through them, one component a panel.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "Line fit against the trajectory", WIDTH, 900) as figure:
        stack = figure.subplots(3, 1, sharex=True)
        for i, axes in enumerate(stack):
            axes.plot(positions[:, i], color=DEMONSTRATED, linewidth=2, label="demonstrated")
            axes.plot(_line(positions)[:, i], color=PINK, linestyle="--", label="least-squares line")
            axes.set(xlim=(0, len(positions) - 1), ylabel=f"{'xyz'[i]} [m]")
        stack[0].legend(loc="best", ncols=2)
        stack[-1].set_xlabel("agent's step")
        figure.align_ylabels(stack)


def plot_line_error(path: Path, positions: Array, errors: Mapping[str, Array]) -> None:
    """Draw the distance of positions (N, 3) [m] from their line beside one-step errors (N − 1,) [mm] by intent.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "Error of the line fit", WIDTH, 900) as figure:
        axes = figure.subplots()
        axes.plot(1e3 * line_distance(positions), color=PINK, label="trajectory from its fitted line")
        for name in NAMES:
            axes.plot(errors[name], color=COLOURS[name], label=f"one-step error, {NAMES[name]}")
        axes.set(yscale="log", xlim=(0, len(positions) - 1), xlabel="agent's step", ylabel="error [mm]")
        axes.grid(True, which="minor", axis="y", linewidth=0.4)
        low, high = axes.get_ylim()
        axes.set_ylim(low, high * (high / low) ** 0.2)
        axes.legend(loc="upper center")
