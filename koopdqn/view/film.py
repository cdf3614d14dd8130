"""A film: the learned motion beside a demonstration, with their distances as a strip below."""

import io
import os
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
import PIL.Image
import PIL.ImageDraw

from koopdqn import pose
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.files import atomic_path
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Image
from koopdqn.robot.scene import Scene
from koopdqn.robot.view import choose_view
from koopdqn.view.motions import Motion

SIZE: Final = (640, 480)
SECONDS: Final = 10.0
"""How long a film takes, from the start of both motions to their ends."""
FRAMES_PER_SECOND: Final = {".mp4": 20, ".gif": 10}
"""By the ending of the file, which says what is written."""
_PANEL: Final = (320, 300)
_TOP: Final = 26
_DPI: Final = 100
# Left, bottom, width, height of the strip's two plots, in shares of the picture.
_PLOTS: Final = ((0.1, 0.085, 0.375, 0.17), (0.59, 0.085, 0.375, 0.17))


def check_film(path: Path, key: str) -> None:
    """Raise unless a film can be written to a path; ``key`` names it for the user.

    Raises:
        BadInputError: it ends otherwise than in .mp4 or .gif, is there already, or its folder cannot be written.
        WorkFailedError: an mp4 is asked for and the extra ``video`` is not installed.
    """
    if path.suffix not in FRAMES_PER_SECOND:
        raise BadInputError(f"{key}: must end in {' or '.join(FRAMES_PER_SECOND)}, found {str(path)!r}")
    if path.exists():
        raise BadInputError(f"{key}: must name a new file, found {str(path)!r}, which exists")
    if path.parent.is_dir() and not os.access(path.parent, os.W_OK | os.X_OK):
        raise BadInputError(f"{key}: must name a file in a folder that can be written, found {str(path)!r}")
    if path.suffix == ".mp4":
        _encoder()


def _encoder() -> Any:
    try:
        return import_module("imageio_ffmpeg")
    except ImportError as error:
        raise WorkFailedError(
            "films as .mp4 need imageio-ffmpeg: pip install 'koopdqn[video]' brings it; .gif needs nothing"
        ) from error


def write_film(
    path: Path,
    scene: Scene,
    learned: Motion,
    demonstrated: Motion,
    advance: Callable[[float], None] = lambda frames: None,
) -> None:
    """Write a film, .mp4 or .gif, of two motions side by side, the learned one left, each from its start to its end.

    The arm can begin both. ``advance`` is told of every frame made.

    Raises:
        BadInputError: the file cannot be written.
        WorkFailedError: OpenGL does not work here, or the extra ``video`` is not installed.
    """
    rate = FRAMES_PER_SECOND[path.suffix]
    frames = film_frames(scene, learned, demonstrated, round(SECONDS * rate))
    with atomic_path(path) as temporary:
        if path.suffix == ".gif":
            _write_gif(temporary, frames, rate, advance)
            return
        writer = _encoder().write_frames(str(temporary), SIZE, fps=rate, quality=7, output_params=["-f", "mp4"])
        with closing(writer):
            # A generator takes its first value when it has begun.
            writer.send(None)
            for frame in frames:
                writer.send(np.ascontiguousarray(frame))
                advance(1)


def _write_gif(path: Path, frames: Iterator[Image], rate: int, advance: Callable[[float], None]) -> None:
    made = []
    for frame in frames:
        advance(1)
        made.append(frame)
    # One palette for all, so that what stays the same is written once; the curves are whole in the last one alone.
    shades = PIL.Image.fromarray(np.concatenate([made[0], made[-1]])).quantize(
        method=PIL.Image.Quantize.MAXCOVERAGE, dither=PIL.Image.Dither.NONE
    )
    first, *rest = (PIL.Image.fromarray(frame).quantize(palette=shades, dither=PIL.Image.Dither.NONE) for frame in made)
    first.save(path, format="GIF", save_all=True, append_images=rest, duration=1000 // rate, loop=0)


def film_frames(scene: Scene, learned: Motion, demonstrated: Motion, count: int) -> Iterator[Image]:
    """Yield the ``count`` frames (480, 640, 3) of a film.

    Raises:
        WorkFailedError: OpenGL does not work here.
    """
    motions = (learned, demonstrated)
    colours = (style.LEARNED, style.DEMONSTRATED)
    back, cursors = _background(motions, colours)
    view = choose_view(scene, learned.joints, _PANEL)
    angle = scene.model.vis.global_.fovy
    lines = [view.pixels(motion.poses[:, pose.POSITION], _PANEL, angle) for motion in motions]
    with closing(Camera(scene, _PANEL)) as camera:
        for share in np.linspace(0.0, 1.0, count):
            frame = back.copy()
            for index, motion in enumerate(motions):
                now = round(share * (len(motion.poses) - 1))
                image = camera.picture(motion.joints[min(now, len(motion.joints) - 1)], view)
                image = _with_lines(image, lines, colours, index, now)
                left = index * _PANEL[0]
                frame[_TOP : _TOP + _PANEL[1], left : left + _PANEL[0]] = image
            for left, right, top, bottom in cursors:
                column = round(left + share * (right - left))
                frame[top:bottom, column - 1 : column + 1] = 34
            yield frame


def _with_lines(image: Image, lines: list[Array], colours: tuple[str, ...], own: int, now: int) -> Image:
    """Return a picture with both paths in it: the other thin, its own as far as the arm has come."""
    picture = PIL.Image.fromarray(image)
    pen = PIL.ImageDraw.Draw(picture)
    other = 1 - own
    for points, colour, width in ((lines[other], colours[other], 1), (lines[own][: now + 1], colours[own], 3)):
        if len(points) > 1:
            pen.line([tuple(point) for point in points.tolist()], fill=colour, width=width, joint="curve")
    return np.asarray(picture)


def _background(
    motions: tuple[Motion, Motion], colours: tuple[str, str]
) -> tuple[Image, list[tuple[int, int, int, int]]]:
    """Return the picture without the arm, and where a cursor goes in each plot: left, right, top, bottom [pixels]."""
    # Behind koopdqn.plots, which sees to it that matplotlib can be imported.
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = SIZE
    learned, _ = motions
    with mpl.rc_context():
        # Not as somebody's own file of settings has it.
        mpl.rcdefaults()
        mpl.rcParams.update({"font.family": "DejaVu Sans", "font.size": 8})
        figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor="white")
        FigureCanvasAgg(figure)
        for index, (name, motion) in enumerate(zip(("learned", "demonstrated"), motions, strict=True)):
            text = f"{name}: {motion.name}" + (" (fails)" if motion.fails else "")
            figure.text(0.015 + 0.5 * index, 0.968, text, color=colours[index], fontsize=10, weight="bold", va="center")
        cursors = []
        for place, strip in zip(_PLOTS, learned.strips, strict=False):
            axes = figure.add_axes(place)
            for motion, colour in zip(motions, colours, strict=True):
                values = next((s.values for s in motion.strips if s.name == strip.name), None)
                if values is not None:
                    axes.plot(np.linspace(0, 100, len(values)), values, color=colour, linewidth=1.4)
            axes.set_title(f"{strip.name} [{strip.unit}]", fontsize=8, loc="left", pad=3)
            axes.set_xlim(0, 100)
            axes.set_ylim(bottom=0)
            axes.set_xlabel("share of the motion [%]", fontsize=7, labelpad=1)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=7, pad=2)
            x, y, w, h = place
            cursors.append(
                (round(x * width), round((x + w) * width), round((1 - y - h) * height), round((1 - y) * height))
            )
        with io.BytesIO() as file:
            figure.savefig(file, format="png", dpi=_DPI)
            return np.array(PIL.Image.open(file).convert("RGB")), cursors
