"""Pictures on a terminal: of a workcell and of a question; in characters, in kitty's protocol or in sixels."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import Final

import numpy as np
from PIL import Image as Pictures
from PIL import ImageDraw, ImageFont
from rich.color import Color
from rich.style import Style
from rich.text import Text

from koopdqn import pose
from koopdqn.oracles.base import Question
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Image, Line, Rgba, Sphere
from koopdqn.robot.view import View, choose_view, fitted_view
from koopdqn.tasks.workcell import Workcell, build_scene

WENT: Final[Rgba] = (0.90, 0.62, 0.0, 1.0)
MEANT: Final[Rgba] = (0.34, 0.71, 0.91, 1.0)
GOAL: Final[Rgba] = (0.0, 0.62, 0.45, 1.0)
BEFORE: Final[Rgba] = (0.95, 0.95, 0.95, 1.0)
AXES: Final[tuple[Rgba, ...]] = ((0.84, 0.37, 0.0, 1.0), (0.0, 0.45, 0.70, 1.0), (0.80, 0.47, 0.65, 1.0))
"""Of the base's x, y and z axis, as drawn at the flange."""

_AXIS_M: Final = 0.13
_AXIS_SHAFT_M: Final = 0.0025
_TIP_M: Final = 0.014

Marks = Mapping[str, tuple[float, float]]
"""Characters and the shares (0…1) of a picture's width and height where they are."""


@dataclass(frozen=True)
class Picture:
    """A picture (height, width, 3), where things are in it, and how many times as far as they are motions are drawn."""

    image: Image
    marks: Marks
    times: float = 1.0


class WorkcellCamera:
    """Draws a workcell in a scene of its own. Close it."""

    def __init__(self, workcell: Workcell, size: tuple[int, int], *, fine: bool = False) -> None:
        """Prepare for pictures of ``size`` (width, height) [pixels]; WorkFailedError where OpenGL does not work.

        ``fine`` ones have shadows and smooth edges, which take a few tenths of a second each.
        """
        self.workcell = workcell
        scene = build_scene(workcell.task, workcell.arm)
        if not fine:
            # Shadows take nine tenths of the time where the processor draws.
            scene.model.vis.quality.shadowsize = scene.model.vis.quality.offsamples = 0
        self.camera = Camera(scene, size)

    def close(self) -> None:
        """Free what OpenGL holds."""
        self.camera.close()

    def drawn(
        self,
        joints: Array,
        view: View,
        here: Array,
        lines: Sequence[Line],
        points: Mapping[str, tuple[Array, Rgba]],
        ghosts: Sequence[Ghost],
    ) -> Picture:
        """Return the picture of the arm at joints (6,) [rad].

        The base's axes are drawn from ``here`` (3,) [m], their ends marked x, y and z, and dots at points (3,) [m],
        under their marks and in their colours; where several are at one place, the last is seen.
        """
        ends = here + _AXIS_M * np.eye(3)
        axes = [Line(np.array([here, end]), colour, _AXIS_SHAFT_M) for end, colour in zip(ends, AXES, strict=True)]
        spheres = [Sphere(point, colour, _TIP_M) for point, colour in points.values()]
        image = self.camera.picture(joints, view, lines=[*axes, *lines], spheres=spheres, ghosts=ghosts)
        places = np.array([*ends, *(point for point, _ in points.values())])
        size, angle = self.camera.size, self.camera.scene.model.vis.global_.fovy
        shares = (view.pixels(places, size, angle) / np.array(size)).tolist()
        return Picture(image, {mark: (x, y) for mark, (x, y) in zip(["x", "y", "z", *points], shares, strict=True)})


_SHOWN_M: Final = 0.08
_SHOWN_RAD: Final = 0.8
"""How far a motion is drawn: one of 2 mm or 1° would be less than a pixel."""
_AROUND_M: Final = 0.16
_SHAFT_M: Final = 0.006
_GHOST: Final = 0.45
_SAME_DIRECTION_M: Final = 0.1
"""How far the flange may go before it is looked at from another direction."""


class SituationCamera(WorkcellCamera):
    """Draws questions of one workcell."""

    _direction: View | None = None
    _seen_from: Array = np.zeros(3)

    def picture(self, question: Question, share: float = 1.0) -> Picture:
        """Return the picture of a question, the arm having gone ``share`` (0…1) of its motion."""
        times = magnification(question)
        reached, meant = (magnified(question.pose, end, times) for end in (question.reached, question.predicted))
        here = magnified(question.pose, question.reached, share * times)
        before, goal = question.pose[pose.POSITION], self.workcell.task.goal[pose.POSITION]
        # All from one posture, or the elbow might be up in one and down in the other.
        posture = self._entered(question.pose)
        joints = self._joints(here, question.pose, posture)
        ends = ((reached[pose.POSITION], WENT), (meant[pose.POSITION], MEANT))
        drawn = self.drawn(
            joints,
            self._view(question, joints, np.array([before, goal])),
            before,
            [Line(np.array([before, end]), colour, _SHAFT_M) for end, colour in ends],
            {"g": (goal, GOAL), "m": ends[1], "b": (before, BEFORE), "r": ends[0]},
            [Ghost(self._joints(meant, question.predicted, posture), _GHOST)],
        )
        return replace(drawn, times=times)

    def _joints(self, wished: Array, otherwise: Array, near: Array) -> Array:
        """Return joints (6,) [rad], near others, of a pose drawn too far, or of the true one if it is out of reach."""
        for target in (wished, otherwise):
            solutions = self.workcell.arm.solutions(target, near)
            if len(solutions):
                return np.asarray(solutions[0])
        return near

    def _entered(self, pose_: Array) -> Array:
        joints = self.workcell.reachability.enter(pose_).joints
        return np.array(self.workcell.arm.home) if joints is None else joints

    def _view(self, question: Question, joints: Array, points: Array) -> View:
        scene = self.camera.scene
        far = self._direction is None or np.linalg.norm(points[0] - self._seen_from) > _SAME_DIRECTION_M
        if far:
            # Kept while the flange is about there, so that no one has to find their bearings anew each time.
            self._direction = choose_view(scene, np.array([self._entered(question.pose), joints]), self.camera.size)
            self._seen_from = points[0]
        around = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * _AROUND_M
        seen = np.concatenate([points, points[0] + around])
        assert self._direction is not None  # chosen above
        azimuth, elevation = self._direction.azimuth, self._direction.elevation
        return fitted_view(seen, azimuth, elevation, self.camera.size, scene.model.vis.global_.fovy)


def magnification(question: Question) -> float:
    """Return how many times as far as they are a question's motions are drawn, 1 or more."""
    ends = np.array([question.reached, question.predicted])
    far = float(pose.position_distance(ends, question.pose).max())
    turn = float(pose.rotation_distance(ends, question.pose).max())
    limits = [shown / size for shown, size in ((_SHOWN_M, far), (_SHOWN_RAD, turn)) if size > 0]
    return max(1.0, min(limits, default=1.0))


def magnified(before: Array, after: Array, times: float) -> Array:
    """Return the pose (7,) that continues the motion between two poses (7,) to ``times`` its length and turn."""
    position = before[pose.POSITION] + times * (after - before)[pose.POSITION]
    turn = pose.to_rotation_vector(pose.multiply(after[pose.QUATERNION], pose.conjugate(before[pose.QUATERNION])))
    return pose.make(position, pose.multiply(pose.from_rotation_vector(times * turn), before[pose.QUATERNION]))


_UPPER_HALF: Final = "▀"
_SHADES: Final = " .:-=+*#%@"
_LUMINANCE: Final = (0.2126, 0.7152, 0.0722)
# Fewer colours, so that a picture holds fewer different characters; the eye does not see it at this size.
_COLOUR_STEP: Final = 8
_LETTERS: Final = 20
"""Letters one above the other in the height of a picture."""
_LETTER_COLOURS: Final = {"r": (255, 220, 60), "m": (90, 230, 255), "g": (80, 240, 130)}
_WHITE: Final = (255, 255, 255)
_MARK_COLOURS: Final = {"r": "bright_yellow", "m": "bright_cyan", "g": "bright_green"}


def resized(image: Image, width: int, height: int) -> Image:
    """Return a picture (height, width, 3) whose every pixel is the mean of those it stands for."""
    return np.asarray(Pictures.fromarray(image).resize((width, height), Pictures.Resampling.BOX))


def lettered(image: Image, marks: Mapping[str, tuple[float, float]], caption: str = "") -> Image:
    """Return a picture (height, width, 3) with marks on it, each at its share (0…1) of width and height.

    A caption stands in its lower left corner.
    """
    height, width, _ = image.shape
    drawn = Pictures.fromarray(image)
    pen = ImageDraw.Draw(drawn)
    size = height / _LETTERS
    font = ImageFont.load_default(size)
    edge = {"font": font, "stroke_width": max(1, round(size / 10)), "stroke_fill": (0, 0, 0)}
    taken: list[tuple[float, float]] = []
    for mark, (x, y) in marks.items():
        if 0 <= x < 1 and 0 <= y < 1:
            # Beside the dot, which it would hide, and beside letters that stand there already.
            left, middle = x * width + 0.5 * size, y * height
            while any(abs(left - x) < size and abs(middle - y) < 0.9 * size for x, y in taken):
                left += 0.1 * size
            taken.append((left, middle))
            pen.text((left, middle), mark, _LETTER_COLOURS.get(mark, _WHITE), anchor="lm", **edge)
    small = {**edge, "font": ImageFont.load_default(0.6 * size)}
    pen.text((0.5 * size, height - 0.5 * size), caption, _WHITE, anchor="lb", **small)
    return np.asarray(drawn)


def block_lines(
    image: Image, width: int, rows: int, marks: Mapping[str, tuple[float, float]], *, colour: bool
) -> list[Text]:
    """Return a picture (height, width, 3) as ``rows`` lines of ``width`` characters.

    Half blocks in colour, or else shades of brightness; over them marks, each at its share (0…1) of width and height.
    """
    small = resized(image, width, 2 * rows)
    lines = _in_colour(small) if colour else _in_shades(small)
    places: dict[tuple[int, int], str] = {}
    for mark, (x, y) in marks.items():
        if 0 <= x < 1 and 0 <= y < 1:
            row, column = int(y * rows), int(x * width)
            while (row, column) in places and column < width - 1:
                column += 1
            places[row, column] = mark
    for (row, column), mark in places.items():
        line = lines[row]
        style = Style(bold=True, color=_MARK_COLOURS.get(mark, "bright_white"), bgcolor="black")
        lines[row] = Text.assemble(line[:column], (mark, style), line[column + 1 :])
    return lines


def _in_colour(small: Image) -> list[Text]:
    coarse = (small // _COLOUR_STEP * _COLOUR_STEP).tolist()
    return [
        Text.assemble(*((_UPPER_HALF, _style(*top, *bottom)) for top, bottom in zip(upper, lower, strict=True)))
        for upper, lower in zip(coarse[::2], coarse[1::2], strict=True)
    ]


@lru_cache(maxsize=65536)
def _style(red: int, green: int, blue: int, red_below: int, green_below: int, blue_below: int) -> Style:
    return Style(color=Color.from_rgb(red, green, blue), bgcolor=Color.from_rgb(red_below, green_below, blue_below))


def _in_shades(small: Image) -> list[Text]:
    light = (small @ np.array(_LUMINANCE) / 255).reshape(-1, 2, small.shape[1]).mean(axis=1)
    # The whole range of shades for the range of light there is.
    low, high = light.min(), light.max()
    levels = np.zeros_like(light) if high == low else (light - low) / (high - low)
    shades = np.minimum((levels * len(_SHADES)).astype(int), len(_SHADES) - 1)
    return [Text("".join(_SHADES[level] for level in row)) for row in shades.tolist()]


_KITTY_CHUNK: Final = 4096
_SIXEL_COLOURS: Final = 128
_BAND: Final = 6
"""Rows of pixels in one line of sixels."""


def png(image: Image) -> bytes:
    """Return a picture (height, width, 3) as a PNG file's bytes."""
    buffer = io.BytesIO()
    Pictures.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def kitty(image: Image, width: int, rows: int) -> str:
    """Return the sequence that draws a picture at the cursor in kitty's protocol, ``width`` by ``rows`` characters."""
    data = base64.standard_b64encode(png(image)).decode()
    chunks = [data[start : start + _KITTY_CHUNK] for start in range(0, len(data), _KITTY_CHUNK)]
    parts = []
    for number, chunk in enumerate(chunks):
        more = int(number + 1 < len(chunks))
        control = f"a=T,f=100,c={width},r={rows},C=1,q=2,m={more}" if number == 0 else f"q=2,m={more}"
        parts.append(f"\x1b_G{control};{chunk}\x1b\\")
    return "".join(parts)


def sixel(image: Image) -> str:
    """Return the sequence that draws a picture at the cursor in DEC's sixels (VT340 manual), a pixel a pixel."""
    height, width, _ = image.shape
    coded = Pictures.fromarray(image).quantize(_SIXEL_COLOURS)
    flat = np.array(coded.getpalette() or [], dtype=int).reshape(-1, 3)
    index = np.asarray(coded)
    used = np.unique(index)
    parts = [f'\x1bP0;1q"1;1;{width};{height}']
    parts += ["#{};2;{};{};{}".format(colour, *np.rint(flat[colour] / 2.55).astype(int)) for colour in used]
    for top in range(0, height, _BAND):
        band = index[top : top + _BAND]
        weights = (1 << np.arange(len(band)))[:, None]
        lines = []
        for colour in np.unique(band):
            bits = ((band == colour) * weights).sum(axis=0)
            lines.append(f"#{colour}{_run_lengths(bits)}")
        parts.append("$".join(lines) + "-")
    return "".join(parts) + "\x1b\\"


def _run_lengths(bits: np.ndarray) -> str:
    runs = ((chr(63 + bit), len(list(run))) for bit, run in groupby(bits.tolist()))
    return "".join(sign * length if length < 4 else f"!{length}{sign}" for sign, length in runs)
