"""The picture of the method, after the paper's description of its Figure 1: boxes and arrows."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.patches import FancyBboxPatch

from koopdqn.plots.style import BLUE, GREEN, GREY, INK, ORANGE, PALE, RED, picture, rgba

WIDTH, HEIGHT = 1200, 980

_BOXES: Final[Sequence[tuple[float, float, float, float, str, str]]] = (
    (14, 81, 22, 14, GREY, "demonstrations\nend-effector poses\n$T_1 \\ldots T_n$"),
    (48, 87, 28, 10, BLUE, "lift and fit (Eqs. 9–12)\n$K = A\\,G^{+}$"),
    (48, 75.5, 28, 8.5, GREEN, "mean and σ of every\ncomponent (§3.4)"),
    (92, 87, 40, 10, BLUE, "human intent model (Eqs. 13, 14)\n$s'_{t+1} = g^{-1}(K\\,g(s_t))$"),
    (92, 75.5, 40, 8.5, GREEN, "trust domain: within k σ, and\nrewards there right, one left out"),
    (28, 54, 38, 9, ORANGE, "double DQN agent: action $a_t$\nof Table 1, ε-greedy"),
    (28, 38.5, 38, 9, GREY, "arm in its scene (MuJoCo):\n$s_{t+1} = F(s_t, a_t)$"),
    (28, 23, 38, 9, GREY, "experience replay\n$(s_t, a_t, r_{t+1}, s_{t+1})$"),
    (28, 9.5, 38, 9, ORANGE, "update: squared loss (Eq. 3),\ntarget network"),
    (90, 54, 36, 9, GREEN, "indomain: is the state\nin the trust domain?"),
    (75, 35, 26, 11, BLUE, "dist (Eqs. 15, 16):\n$s_{t+1}$ close to $s'_{t+1}$?"),
    (105, 35, 25, 11, RED, "a person, or the\nscripted oracle:\nright or wrong?"),
    (90, 15, 36, 9, ORANGE, "reward $r_{t+1}$: + or −"),
)
"""Middle, width and height, colour and text of each box."""
_FRAMES: Final[Sequence[tuple[float, float, float, float, str]]] = (
    (60, 83.5, 118, 27, "A, B   Knowledge from demonstrations, before training"),
    (28, 33.5, 54, 63, "C   Training loop (Algorithm 1)"),
    (89.5, 33.5, 59, 63, "Reward function"),
)
"""Middle, width and height, and title of each part."""
_ARROWS: Final = (
    *(((25, 81), (34, y)) for y in (87, 75.5)),
    *(((62, y), (72, y)) for y in (87, 75.5)),
    ((90, 70), (90, 58.5)),
    *(((28, high), (28, low)) for high, low in ((49.5, 43), (34, 27.5), (18.5, 14))),
    ((9, 9.5), (4.5, 9.5), (4.5, 54), (9, 54)),
    ((83, 49.5), (77, 40.5)),
    ((97, 49.5), (103, 40.5)),
    ((77, 29.5), (83, 19.5)),
    ((103, 29.5), (97, 19.5)),
    ((47, 38.5), (57.5, 38.5), (57.5, 54), (72, 54)),
    ((72, 15), (57.5, 15), (57.5, 23), (47, 23)),
)
"""The corners of each arrow, the head at the last."""
_LABELS: Final[Sequence[tuple[float, float, str]]] = (
    (77.5, 46, "yes"),
    (102.5, 46, "no"),
    (65.5, 56.3, "$s_{t+1}$"),
    (65.5, 17.3, "$r_{t+1}$"),
    (99, 63.5, "model and domain"),
    (90, 6.2, "After a wrong action the agent steps back and tries\nanother; both experiences are stored (§3.3)."),
)


def plot_workflow(path: Path) -> None:
    """Draw the workflow into a PNG.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "From demonstrations to a learned path", WIDTH, HEIGHT) as figure:
        axes = figure.subplots()
        axes.set(xlim=(0, 120), ylim=(0, 98))
        axes.axis("off")
        for x, y, width, height, title in _FRAMES:
            _box(axes, x, y, width, height, facecolor="white", edgecolor=PALE)
            axes.text(x - width / 2 + 1.2, y + height / 2 - 1.2, title, va="top", fontsize=11, color=GREY)
        for x, y, width, height, colour, text in _BOXES:
            _box(axes, x, y, width, height, facecolor=rgba(colour, 0.14), edgecolor=colour)
            axes.text(x, y, text, ha="center", va="center", fontsize=11.5, color=INK, linespacing=1.25)
        head = {"arrowstyle": "-|>", "color": INK, "linewidth": 1.5, "mutation_scale": 15, "shrinkA": 0, "shrinkB": 0}
        for corners in _ARROWS:
            axes.plot(*zip(*corners[:-1], strict=True), color=INK, solid_joinstyle="round")
            axes.annotate("", corners[-1], corners[-2], arrowprops=head)
        for x, y, text in _LABELS:
            axes.text(x, y, text, ha="center", va="center", fontsize=11, color=INK)


def _box(axes: Axes, x: float, y: float, width: float, height: float, **colours: Any) -> None:
    corner, style = (x - width / 2, y - height / 2), "round,pad=0,rounding_size=1.4"
    axes.add_patch(FancyBboxPatch(corner, width, height, boxstyle=style, linewidth=1.6, **colours))
