"""Figure 1: from demonstrations to a policy, drawn as boxes and arrows (after the paper's description of its own)."""

from pathlib import Path
from typing import Final

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch, Rectangle

from koopdqn.plots.style import BLUE, GREEN, GREY, INK, ORANGE, PALE, RED, TRUST, picture

WIDTH, HEIGHT = 1200, 980

Point = tuple[float, float]

_FILLS: Final = {BLUE: "#DCEBF5", GREEN: "#DDF2EA", ORANGE: "#FBEFD5", RED: "#F9E3D5", GREY: "#EEF0F2"}


def plot_workflow(path: Path) -> None:
    """Draw the workflow into a PNG.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "From demonstrations to a learned path", WIDTH, HEIGHT) as figure:
        axes = figure.subplots()
        axes.set_xlim(0, 120)
        axes.set_ylim(0, 98)
        axes.axis("off")
        _knowledge(axes)
        _loop(axes)


def _knowledge(axes: Axes) -> None:
    """Draw parts A and B: the demonstrations, and what is made of them."""
    _frame(axes, (1, 70), 118, 27, "A, B   Knowledge from demonstrations, before training")
    _box(axes, (14, 81), 22, 14, "demonstrations\nend-effector poses\n$T_1 \\ldots T_n$", GREY)
    _box(axes, (48, 87), 28, 10, "lift and fit (Eqs. 9–12)\n$K = A\\,G^{+}$", BLUE)
    _box(axes, (48, 75.5), 28, 8.5, "mean and σ of every\ncomponent (§3.4)", GREEN)
    _box(axes, (92, 87), 40, 10, "human intent model (Eqs. 13, 14)\n$s'_{t+1} = g^{-1}(K\\,g(s_t))$", BLUE)
    _box(axes, (92, 75.5), 40, 8.5, "trust domain: within k σ, and\nrewards there right, one left out", GREEN)
    for y in (87, 75.5):
        _arrow(axes, (25, 81), (34, y))
        _arrow(axes, (62, y), (72, y))


def _loop(axes: Axes) -> None:
    """Draw part C: the training loop with the reward function."""
    _frame(axes, (1, 2), 54, 63, "C   Training loop (Algorithm 1)")
    _frame(axes, (60, 2), 59, 63, "Reward function")
    _box(axes, (28, 54), 38, 9, "double DQN agent: action $a_t$\nof Table 1, ε-greedy", ORANGE)
    _box(axes, (28, 38.5), 38, 9, "arm in its scene (MuJoCo):\n$s_{t+1} = F(s_t, a_t)$", GREY)
    _box(axes, (28, 23), 38, 9, "experience replay\n$(s_t, a_t, r_{t+1}, s_{t+1})$", GREY)
    _box(axes, (28, 9.5), 38, 9, "update: squared loss (Eq. 3),\ntarget network", ORANGE)
    _arrow(axes, (28, 49.5), (28, 43))
    _arrow(axes, (28, 34), (28, 27.5))
    _arrow(axes, (28, 18.5), (28, 14))
    _bend(axes, [(9, 9.5), (4.5, 9.5), (4.5, 54), (9, 54)])
    _box(axes, (90, 54), 36, 9, "indomain: is the state\nin the trust domain?", GREEN)
    _box(axes, (75, 35), 26, 11, "dist (Eqs. 15, 16):\n$s_{t+1}$ close to $s'_{t+1}$?", BLUE)
    _box(axes, (105, 35), 25, 11, "a person, or the\nscripted oracle:\nright or wrong?", RED)
    _box(axes, (90, 15), 36, 9, "reward $r_{t+1}$: + or −", ORANGE)
    _arrow(axes, (83, 49.5), (77, 40.5), "yes", (-13, 2))
    _arrow(axes, (97, 49.5), (103, 40.5), "no", (11, 2))
    _arrow(axes, (77, 29.5), (83, 19.5))
    _arrow(axes, (103, 29.5), (97, 19.5))
    _bend(axes, [(47, 38.5), (57.5, 38.5), (57.5, 54), (72, 54)], "$s_{t+1}$", (65.5, 56.3))
    _bend(axes, [(72, 15), (57.5, 15), (57.5, 23), (47, 23)], "$r_{t+1}$", (65.5, 17.3))
    _arrow(axes, (90, 70), (90, 58.5), "model and domain", (58, -3))
    note = "After a wrong action the agent steps back and tries\nanother; both experiences are stored (§3.3)."
    axes.text(90, 6.2, note, ha="center", va="center", fontsize=10, color=INK, style="italic")


def _box(axes: Axes, center: Point, width: float, height: float, text: str, colour: str) -> None:
    corner = (center[0] - width / 2, center[1] - height / 2)
    style = "round,pad=0,rounding_size=1.4"
    axes.add_patch(
        FancyBboxPatch(
            corner, width, height, boxstyle=style, facecolor=_FILLS.get(colour, TRUST), edgecolor=colour, linewidth=1.6
        )
    )
    axes.text(*center, text, ha="center", va="center", fontsize=11.5, color=INK, linespacing=1.25)


def _frame(axes: Axes, corner: Point, width: float, height: float, title: str) -> None:
    axes.add_patch(Rectangle(corner, width, height, facecolor="white", edgecolor=PALE, linewidth=1.6, zorder=0))
    axes.text(corner[0] + 1.2, corner[1] + height - 1.2, title, ha="left", va="top", fontsize=11, color=GREY)


def _arrow(axes: Axes, start: Point, end: Point, label: str = "", offset: Point = (0, 0)) -> None:
    axes.annotate(
        "", end, start, arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.5, "mutation_scale": 15}
    )
    if label:
        middle = ((start[0] + end[0]) / 2, (start[1] + end[1]) / 2)
        axes.annotate(
            label, middle, offset, textcoords="offset points", ha="center", va="center", fontsize=11, color=INK
        )


def _bend(axes: Axes, corners: list[Point], label: str = "", place: Point = (0, 0)) -> None:
    """Draw an arrow along corners, the head at the last."""
    xs, ys = [corner[0] for corner in corners[:-1]], [corner[1] for corner in corners[:-1]]
    axes.plot(xs, ys, color=INK, linewidth=1.5, solid_joinstyle="round")
    _arrow(axes, corners[-2], corners[-1])
    if label:
        axes.text(*place, label, ha="center", va="center", fontsize=12, color=INK)
