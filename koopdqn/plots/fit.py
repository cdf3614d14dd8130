"""The picture of ``koopdqn fit``: how well the intent model predicts, where it is trusted, and its eigenvalues."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.intent.box import Box
from koopdqn.intent.fit import Fitted, agent_steps
from koopdqn.intent.trust import TrustDomain
from koopdqn.intent.tube import Tube
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 1560, 1060
_MM, _DEGREE = 1e3, float(np.degrees(1.0))
_OUTSIDE = 5e-5
"""By how much an eigenvalue is over 1 before it shows in four decimals."""


def plot_fit(path: Path, fitted: Fitted, demonstrations: Demonstrations, task: Task) -> None:
    """Draw an intent fitted to demonstrations of a task into a PNG.

    Raises:
        BadInputError: the file cannot be written.
    """
    report = fitted.report
    title = f"Human intent of task {task.name} ({report['intent']})"
    measured = report["one_step_error_m"] is not None
    if measured:
        title += f": held-out one-step error {report['one_step_error_m']['rms'] * _MM:.2f} mm RMS"
    else:
        title += ", of a single demonstration: nothing is held out, no error is measured"
    turns = report["one_step_error_rad"] is not None
    if turns:
        title += f", {np.degrees(report['one_step_error_rad']['rms']):.2g}°"
    frame, recorded = fitted.model.start_frame, agent_steps(demonstrations, task)
    trajectories = frame.each(recorded)
    with style.picture(path, title, WIDTH, HEIGHT) as figure:
        grid = figure.add_gridspec(2, 6, height_ratios=(1, 1.15))
        if measured:
            cells = grid[0, :4].subgridspec(2 if turns else 1, 1)
            upper = figure.add_subplot(cells[0])
            _errors(upper, fitted, "m", _MM, task.position_tolerance_m, room=1.9 if turns else 1.45)
            upper.set_title("Held-out one-step error: each demonstration predicted by the others")
            if turns:
                lower = figure.add_subplot(cells[1], sharex=upper)
                _errors(lower, fitted, "rad", _DEGREE, task.rotation_tolerance_rad, room=1.6)
                upper.tick_params(labelbottom=False)
                upper.set_xlabel("")
        _eigenvalues(figure.add_subplot(grid[0, 4:] if measured else grid[:, 4:]), fitted)
        row = 1 if measured else slice(None)
        # What was unfolded is drawn where it lies; paths that follow their starts, as the trust domain has them.
        unfolding = frame.unfolding
        shown = [rows[:, pose.POSITION] for rows in (trajectories if unfolding is None else recorded)]
        rollouts = [
            (path if unfolding is None else unfolding.laid(path))[:, pose.POSITION]
            for path in _roll_outs(fitted, trajectories, task)
        ]
        begun = "as told from one start" if frame.follows else "from each start"
        trust = fitted.trust.drawn(frame)
        planes = style.two_planes(shown)
        for place, plane in zip((grid[row, :2], grid[row, 2:4]), planes, strict=True):
            axes = figure.add_subplot(place)
            corners = _tube(axes, trust, plane)
            _paths(axes, plane, shown, rollouts, corners, task)
            axes.set_title(f"Rolled out {begun}, from {style.VIEWS[plane]}")
            if plane == planes[0]:
                figure.legend(handles=_path_handles(axes, fitted.trust), loc="outside lower center", ncols=6)
        if not measured:
            return
        bars = grid[1, 4:].subgridspec(2 if turns else 1, 1)
        first = figure.add_subplot(bars[0])
        _components(first, report["one_step_error_m"], _MM, "one-step error [mm]")
        first.set_title("Held-out error by component")
        first.legend(loc="upper right", ncols=2)
        if turns:
            _components(figure.add_subplot(bars[1]), report["one_step_error_rad"], _DEGREE, "error [°]")


def _errors(axes: Axes, fitted: Fitted, kind: str, scale: float, tolerance: float, room: float) -> None:
    """Draw mean and largest error per step and the compare tolerance.

    Errors and tolerance are of a kind, "m" or "rad", and shown in millimetres or degrees by a scale. The vertical axis
    reaches ``room`` times higher than what is drawn, for the legend.
    """
    unit = {"m": "mm", "rad": "°"}[kind]
    limit = tolerance * scale
    per_step = fitted.report[f"one_step_error_per_step_{kind}"]
    mean, largest = (np.array(per_step[name]) * scale for name in ("mean", "max"))
    shade(axes, _asked(fitted.trust), len(mean))
    axes.plot(mean, color=style.BLUE, label="mean over demonstrations")
    axes.plot(largest, color=style.SKY, linewidth=1.0, label="largest")
    axes.axhline(limit, color=style.INK, linestyle="--", linewidth=1.2, label=f"compare tolerance: {limit:.3g} {unit}")
    axes.set_xlim(0, len(mean))
    # The worst few errors are cut off rather than flattening the rest.
    axes.set_ylim(0, room * max(float(np.quantile(largest, 0.95)), limit))
    axes.set(xlabel="step of the demonstration", ylabel=f"one-step error [{unit}]")
    handles, labels = axes.get_legend_handles_labels()
    # In the panel of turns only what the panel above it does not say.
    first = 0 if kind == "m" else -1
    axes.legend(handles[first:], labels[first:], loc="upper center", ncols=3 if kind == "m" else 2)


def shade(axes: Axes, asked: np.ndarray, steps: int) -> None:
    """Shade the places (S,) at which the expert is asked, spread over the steps."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], asked, [False]]).astype(int))) * steps / len(asked)
    for index, (start, end) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        axes.axvspan(start, end, color=style.ASK, lw=0, label=None if index else "the expert is asked", zorder=0)


def _eigenvalues(axes: Axes, fitted: Fitted) -> None:
    models = fitted.model.matrices.items()
    matrices = [
        (name, model.matrix, colour) for (name, model), colour in zip(models, (style.BLUE, style.ORANGE), strict=False)
    ]
    angle = np.linspace(0, 2 * np.pi, 361)
    axes.plot(np.cos(angle), np.sin(angle), color=style.GREY, linewidth=1.0, label="unit circle")
    reach = 1.0
    for name, matrix, colour in matrices:
        values = np.linalg.eigvals(matrix)
        reach = max(reach, float(np.abs(values).max()))
        outside = np.abs(values) > 1.0 + _OUTSIDE
        for chosen, marker, label in ((~outside, "o", "within"), (outside, "X", "outside")):
            if chosen.any():
                axes.plot(
                    values[chosen].real,
                    values[chosen].imag,
                    linestyle="",
                    marker=marker,
                    markersize=6,
                    color=colour if marker == "o" else style.RED,
                    markeredgecolor="white",
                    markeredgewidth=0.5,
                    label=f"{name}: {int(chosen.sum())} {label}, largest {np.abs(values[chosen]).max():.4f}",
                )
    axes.set_xlim(-1.15 * reach, 1.15 * reach, auto=True)
    axes.set_ylim(-1.15 * reach, 1.15 * reach, auto=True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel="real part", ylabel="imaginary part")
    axes.set_title("Eigenvalues of K" if len(matrices) == 1 else "Eigenvalues of K_p and K_o")
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 0.06))


def _roll_outs(fitted: Fitted, trajectories: list[Array], task: Task) -> list[Array]:
    """Return the poses (T, 7) of the intent followed from each demonstration's start, until it rests."""
    starts = np.array([trajectory[0] for trajectory in trajectories])
    steps = 2 * max(len(trajectory) for trajectory in trajectories)
    poses = fitted.model.roll_out(starts, steps, task.step_m)
    return [poses[:, i] for i in range(len(trajectories))]


def _tube(axes: Axes, trust: TrustDomain, plane: str) -> Array:
    """Draw the trust domain at every place, in another colour where the model errs; return its corners (M, 3)."""
    if not trust.shaped:
        return np.zeros((0, 3))
    middle, width = _extent(trust)
    i, j = style.PLANES[plane]
    if isinstance(trust, Tube):
        angle = np.linspace(0, 2 * np.pi, 49)
        edge = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        edge = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    outlines = middle[:, None, [i, j]] + edge * width[:, None, [i, j]]
    for chosen, colour, order in ((~trust.known, style.ASK, 1.0), (trust.known, style.TRUST, 1.1)):
        drawn = PolyCollection(list(outlines[chosen]), facecolors=colour, edgecolors="none", zorder=order)
        axes.add_collection(drawn, autolim=False)
    return np.concatenate([middle - width, middle + width])


def _extent(trust: TrustDomain) -> tuple[Array, Array]:
    """Return middle (S, 3) [m] and half widths (S, 3) [m] of a trust domain at every place."""
    if isinstance(trust, Tube):
        return trust.middle[:, pose.POSITION], np.repeat(trust.radius[:, :1], 3, axis=1)
    if isinstance(trust, Box):
        return trust.mean[:, :3], (trust.settings.sigmas * trust.deviation)[:, :3]
    return np.zeros((len(trust.right), 3)), np.zeros((len(trust.right), 3))


def _asked(trust: TrustDomain) -> np.ndarray:
    """Return at which of its places (S,) too few rewards are right; all where nothing is trusted, else none."""
    return ~trust.known if trust.shaped else np.full(len(trust.right), _trusts_nothing(trust))


def _trusts_nothing(trust: TrustDomain) -> bool:
    return isinstance(trust, Box) and trust.settings.matching == "nowhere"


def _named(trust: TrustDomain) -> str:
    """Return what the legend says of the trust domain."""
    if not trust.shaped:
        return "nothing is trusted" if _trusts_nothing(trust) else "trusted everywhere"
    if isinstance(trust, Tube):
        radius = trust.radius[:, 0] * _MM
        return f"trusted: radius {style.two_digits(radius.min())} to {style.two_digits(radius.max())} mm"
    return f"trusted: mean ± {trust.settings.sigmas:g} σ" if isinstance(trust, Box) else "trusted"


def _paths(
    axes: Axes, plane: str, demonstrated: list[Array], rollouts: list[Array], corners: Array, task: Task
) -> None:
    for path in demonstrated:
        axes.plot(*style.project(path, plane), color=style.DEMONSTRATED, linewidth=1.2, zorder=2)
    for path in rollouts:
        axes.plot(*style.project(path, plane), color=style.BLUE, linewidth=1.2, linestyle=(0, (4, 2)), zorder=3)
    style.frame_projection(axes, plane, task, [*demonstrated, corners])


def _path_handles(axes: Axes, trust: TrustDomain) -> list[Any]:
    handles: list[Patch | Line2D] = [
        Line2D([], [], color=style.DEMONSTRATED, label="demonstration"),
        Line2D([], [], color=style.BLUE, linestyle=(0, (4, 2)), label="intent, rolled out"),
        Patch(color=style.ASK if _trusts_nothing(trust) else style.TRUST, label=_named(trust)),
    ]
    if trust.shaped and not trust.known.all():
        handles.append(Patch(color=style.ASK, label="too few rewards right: ask"))
    existing, _ = axes.get_legend_handles_labels()
    return [*handles, *existing]


def _components(axes: Axes, error: dict[str, dict[str, float]], scale: float, label: str) -> None:
    names = list(error["rms_per_component"])
    rms, largest = (np.array([error[f"{k}_per_component"][n] for n in names]) * scale for k in ("rms", "max"))
    place = np.arange(len(names))
    axes.bar(place - 0.2, rms, 0.38, color=style.BLUE, label="RMS")
    axes.bar(place + 0.2, largest, 0.38, color=style.PALE, label="largest")
    for x, value in (*zip(place - 0.2, rms, strict=True), *zip(place + 0.2, largest, strict=True)):
        text = style.two_digits(value) if value >= 1e-3 else "0"
        axes.annotate(text, (x, value), (0, 2), textcoords="offset points", ha="center", fontsize=9, color=style.INK)
    axes.set_xticks(place, [name.replace("_", " ") for name in names])
    axes.set_ylim(0, 1.45 * max(float(largest.max()), 1e-6))
    axes.grid(False, axis="x")
    axes.set_ylabel(label)
