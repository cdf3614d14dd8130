"""The look of every picture: colours, type, and how a figure becomes the same PNG bytes each time."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from koopdqn import pose
from koopdqn.files import atomic_path
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Image, Line
from koopdqn.robot.scene import Scene
from koopdqn.robot.view import choose_view
from koopdqn.tasks.task import Task

DPI: Final = 120

# Okabe & Ito's palette, which colour-blind readers can tell apart.
BLUE: Final = "#0072B2"
ORANGE: Final = "#E69F00"
GREEN: Final = "#009E73"
RED: Final = "#D55E00"
PINK: Final = "#CC79A7"
SKY: Final = "#56B4E9"
INK: Final = "#222222"
GREY: Final = "#8A8F98"
PALE: Final = "#D5D9DF"

SERIES: Final = (BLUE, ORANGE, GREEN, PINK, SKY, RED)
"""Colours of things shown one by one, such as demonstrations; more than these run from dark to light."""
LEARNED: Final = BLUE
DEMONSTRATED: Final = ORANGE
MEANT: Final = INK
SOURCES: Final = {"rule": INK, "trusted": GREEN, "asked": RED, "remembered": PINK, "certified": SKY}
"""Of where a reward came from, by :data:`koopdqn.intent.reward.SOURCES`."""
TRUST: Final = "#CDEBDF"
ASK: Final = "#F7D9C4"

_STYLE: Final[dict[Any, Any]] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 10,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E7E9ED",
    "grid.linewidth": 0.8,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "legend.fontsize": 9,
    "lines.linewidth": 1.5,
    "figure.facecolor": "white",
    "figure.titlesize": 14,
    "figure.titleweight": "bold",
    "figure.constrained_layout.h_pad": 0.08,
    "figure.constrained_layout.w_pad": 0.08,
    "savefig.dpi": DPI,
}


@contextmanager
def picture(path: Path, title: str, width: int, height: int) -> Iterator[Figure]:
    """Yield an empty figure that is written to ``path`` as a PNG, whole or not at all, when the block ends well.

    The user's own matplotlib settings play no part, and no date or version is written, so that the same
    content gives the same bytes.

    Width and height are in pixels.

    Raises:
        BadInputError: the file cannot be written.
    """
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.01, ha="left", parse_math=False)
        yield figure
        with atomic_path(path) as temporary:
            figure.savefig(temporary, format="png", metadata={"Software": None})


def series_colours(count: int) -> list[str]:
    """Return a colour for each of ``count`` things shown one by one."""
    if count <= len(SERIES):
        return list(SERIES[:count])
    # The lightest of that map cannot be seen on white.
    return [to_hex(colormaps["viridis"](share)) for share in np.linspace(0.0, 0.85, count)]


def rgba(colour: str, opacity: float = 1.0) -> tuple[float, float, float, float]:
    """Return a colour as red, green, blue, opacity, each 0…1, as :mod:`koopdqn.robot.render` takes it."""
    red, green, blue = to_rgb(colour)
    return red, green, blue, opacity


def note(axes: Axes, text: str, colour: str = RED) -> None:
    """Write a text in the middle of axes that have nothing to show."""
    axes.text(0.5, 0.5, text, ha="center", va="center", color=colour, transform=axes.transAxes)


def show_image(axes: Axes, image: Image, title: str) -> None:
    """Fill axes with a rendered picture (height, width, 3)."""
    axes.imshow(image, interpolation="antialiased")
    axes.set_title(title)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(True)
        spine.set_color(PALE)


PLANES: Final = {"top": (0, 1), "side": (0, 2), "front": (1, 2)}
"""The two coordinates that each projection shows: from above x and y, from the side x and z, from the front y and z."""
VIEWS: Final = {"top": "above", "side": "the side", "front": "the front"}
"""From where each projection looks."""
# The front takes the place of a view that shows less than this share of what it shows.
_EDGE_ON = 0.25


def two_planes(paths: Sequence[Array]) -> tuple[str, str]:
    """Return which two projections show paths (N, 3) [m]: from above and the side, unless one sees them edge-on."""
    positions = np.concatenate([*paths])
    extent = positions.max(axis=0) - positions.min(axis=0)
    area = {plane: float(extent[i] * extent[j]) for plane, (i, j) in PLANES.items()}
    least = min(("top", "side"), key=lambda plane: area[plane])
    if area[least] >= _EDGE_ON * area["front"]:
        return "top", "side"
    return ("side" if least == "top" else "top"), "front"


def two_digits(value: float) -> str:
    """Return a number with two significant digits, a large one without an exponent: 0.42, 4.2, 420."""
    return f"{float(f'{value:.2g}'):g}"


def frame_projection(axes: Axes, plane: str, task: Task, positions: Sequence[Array]) -> None:
    """Set up a projection, a key of :data:`PLANES`: labels, start region, goal, equal scales and limits.

    Positions (N, 3) [m], start region and goal lie inside the limits; nothing else widens them.
    """
    i, j = PLANES[plane]
    center, half = task.nominal_start[pose.POSITION], np.array(task.start_half_range_m)
    corner = (float(center[i] - half[i]), float(center[j] - half[j]))
    size = (float(2 * half[i]), float(2 * half[j]))
    region: dict[str, Any] = {"fill": False, "edgecolor": GREY, "linestyle": "--", "linewidth": 1.2, "zorder": 4}
    axes.add_patch(Rectangle(corner, *size, label="start region", **region))
    goal = task.goal[pose.POSITION]
    star: dict[str, Any] = {"marker": "*", "markersize": 13, "color": INK, "markeredgecolor": "white", "zorder": 6}
    axes.plot(goal[i], goal[j], linestyle="", label="goal", **star)
    inside = np.concatenate([*positions, [center - half, center + half, goal]])[:, [i, j]]
    low, high = inside.min(axis=0), inside.max(axis=0)
    margin = 0.06 * float((high - low).max())
    low, high = low - margin, high + margin
    # Asks for automatic limits, so it must come before those below.
    axes.locator_params(nbins=6)
    # To keep the scales equal matplotlib may widen either limit (auto=True), or narrow it down to the data it
    # knows of: the two corners make the margin part of them.
    axes.update_datalim([low, high])
    axes.set_xlim(low[0], high[0], auto=True)
    axes.set_ylim(low[1], high[1], auto=True)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")


def project(positions: Array, plane: str) -> tuple[Array, Array]:
    """Return the two coordinates (N,), (N,) [m] of positions (N, 3) that a projection shows."""
    i, j = PLANES[plane]
    return positions[:, i], positions[:, j]


def draw_motion(
    scene: Scene,
    joints: Array,
    paths: Sequence[Array],
    colours: Sequence[str] | None = None,
    size: tuple[int, int] = (900, 720),
) -> Image:
    """Return a picture (height, width, 3) of the arm at a motion's end, its start as a ghost, and of paths beside it.

    Joint angles (N, 6) are in rad, the paths' positions (T, 3) in m, width and height in pixels. The paths have those
    colours, or by default :func:`series_colours`.

    Raises:
        WorkFailedError: OpenGL does not work here.
    """
    colours = series_colours(len(paths)) if colours is None else colours
    lines = [Line(path, rgba(colour)) for path, colour in zip(paths, colours, strict=True)]
    with closing(Camera(scene, size)) as camera:
        return camera.picture(joints[-1], choose_view(scene, joints, size), lines, ghosts=[Ghost(joints[0])])
