"""The picture of a question: the arm where it went and where the model would have gone, in characters or pixels."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from rich.color import Color
from rich.style import Style
from rich.text import Text

from koopdqn import console, pose
from koopdqn.errors import WorkFailedError
from koopdqn.oracles.base import Question
from koopdqn.oracles.terminal.device import Device, Drawn
from koopdqn.oracles.terminal.screen import Region, Shown, compose, region, status_line
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Image, Line, Rgba, Sphere, View, choose_view, fitted_view
from koopdqn.tasks.workcell import Workcell, build_scene

WENT: Final[Rgba] = (0.90, 0.62, 0.0, 1.0)
MEANT: Final[Rgba] = (0.34, 0.71, 0.91, 1.0)
GOAL: Final[Rgba] = (0.0, 0.62, 0.45, 1.0)
BEFORE: Final[Rgba] = (0.95, 0.95, 0.95, 1.0)
AXES: Final[tuple[Rgba, ...]] = ((0.84, 0.37, 0.0, 1.0), (0.0, 0.45, 0.70, 1.0), (0.80, 0.47, 0.65, 1.0))
"""Of the base's x, y and z axis, as drawn at the flange."""

_SHOWN_M: Final = 0.08
_SHOWN_RAD: Final = 0.8
"""How far a motion is drawn: one of 2 mm or 1° would be less than a pixel."""
_AROUND_M: Final = 0.16
_AXIS_M: Final = 0.13
_AXIS_SHAFT_M: Final = 0.0025
_SHAFT_M: Final = 0.006
_TIP_M: Final = 0.014
_GHOST: Final = 0.45
_SAME_DIRECTION_M: Final = 0.1
"""How far the flange may go before it is looked at from another direction."""


@dataclass(frozen=True)
class Situation:
    """A picture and where things are in it.

    Attributes:
        image: (height, width, 3).
        marks: share (0…1) of width and height where things are: b before, r reached, m the model's, g the goal,
            x, y and z the ends of the base's axes.
        times: how many times as far as they are the motions are drawn.
    """

    image: Image
    marks: dict[str, tuple[float, float]]
    times: float


class SituationCamera:
    """Draws questions of one workcell in a scene of its own. Close it."""

    def __init__(self, workcell: Workcell, size: tuple[int, int], *, fine: bool = False) -> None:
        """Prepare for pictures of ``size`` (width, height) [pixels].

        Args:
            workcell: task and arm.
            size: of the pictures.
            fine: with shadows and smooth edges, which take a few tenths of a second a picture.

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        self._workcell = workcell
        scene = build_scene(workcell.task, workcell.arm)
        if not fine:
            # Shadows take nine tenths of the time where the processor draws.
            scene.model.vis.quality.shadowsize = scene.model.vis.quality.offsamples = 0
        self._camera = Camera(scene, size)
        self._direction: View | None = None
        self._seen_from = np.zeros(3)

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._camera.close()

    def picture(self, question: Question, share: float = 1.0) -> Situation:
        """Return the picture of a question, the arm having gone ``share`` (0…1) of its motion."""
        times = magnification(question)
        reached, meant = (magnified(question.pose, end, times) for end in (question.reached, question.predicted))
        here = magnified(question.pose, question.reached, share * times)
        before, goal = question.pose[pose.POSITION], self._workcell.task.goal[pose.POSITION]
        # All from one posture, or the elbow might be up in one and down in the other.
        posture = self._entered(question.pose)
        joints = self._joints(here, question.pose, posture)
        view = self._view(question, joints, np.array([before, goal]))
        axes = before + _AXIS_M * np.eye(3)
        ends = (("r", reached, WENT), ("m", meant, MEANT))
        image = self._camera.picture(
            joints,
            view,
            lines=[
                *(Line(np.array([before, end]), colour, _AXIS_SHAFT_M) for end, colour in zip(axes, AXES, strict=True)),
                *(Line(np.array([before, end[pose.POSITION]]), colour, _SHAFT_M) for _, end, colour in ends),
            ],
            spheres=[
                Sphere(before, BEFORE, _TIP_M),
                Sphere(goal, GOAL, _TIP_M),
                *(Sphere(end[pose.POSITION], colour, _TIP_M) for _, end, colour in ends),
            ],
            ghosts=[Ghost(self._joints(meant, question.predicted, posture), _GHOST)],
        )
        points = np.array([*axes, goal, meant[pose.POSITION], before, reached[pose.POSITION]])
        size = self._camera.size
        places = view.pixels(points, size, self._camera.scene.model.vis.global_.fovy) / np.array(size)
        return Situation(
            image, {mark: (float(x), float(y)) for mark, (x, y) in zip("xyzgmbr", places, strict=True)}, times
        )

    def _joints(self, wished: Array, otherwise: Array, near: Array) -> Array:
        """Return joints (6,) [rad], near others, of a pose drawn too far, or of the true one if it is out of reach."""
        for target in (wished, otherwise):
            solutions = self._workcell.arm.solutions(target, near)
            if len(solutions):
                return np.asarray(solutions[0])
        return near

    def _entered(self, pose_: Array) -> Array:
        joints = self._workcell.reachability.enter(pose_).joints
        return np.array(self._workcell.arm.home) if joints is None else joints

    def _view(self, question: Question, joints: Array, points: Array) -> View:
        scene = self._camera.scene
        far = self._direction is None or np.linalg.norm(points[0] - self._seen_from) > _SAME_DIRECTION_M
        if far:
            # Kept while the flange is about there, so that no one has to find their bearings anew each time.
            self._direction = choose_view(scene, np.array([self._entered(question.pose), joints]), self._camera.size)
            self._seen_from = points[0]
        around = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * _AROUND_M
        seen = np.concatenate([points, points[0] + around])
        assert self._direction is not None  # chosen above
        azimuth, elevation = self._direction.azimuth, self._direction.elevation
        return fitted_view(seen, azimuth, elevation, self._camera.size, scene.model.vis.global_.fovy)


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
_MARK_COLOURS: Final = {"r": "bright_yellow", "m": "bright_cyan", "g": "bright_green"}


def resized(image: Image, width: int, height: int) -> Image:
    """Return a picture (height, width, 3) whose every pixel is the mean of those it stands for."""
    from PIL import Image as Pictures

    return np.asarray(Pictures.fromarray(image).resize((width, height), Pictures.Resampling.BOX))


def block_lines(
    image: Image, width: int, rows: int, marks: dict[str, tuple[float, float]], *, colour: bool
) -> list[Text]:
    """Return a picture as lines of characters.

    Args:
        image: (height, width, 3).
        width: characters in a line.
        rows: number of lines.
        marks: characters put on the picture, each at its share (0…1) of width and height.
        colour: half blocks in colour; else shades of brightness.
    """
    small = resized(image, width, 2 * rows)
    lines = _in_colour(small) if colour else _in_shades(small)
    places = {(int(y * rows), int(x * width)): mark for mark, (x, y) in marks.items() if 0 <= x < 1 and 0 <= y < 1}
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
KITTY_CLEAR: Final = "\x1b_Ga=d,q=2\x1b\\"
"""Takes kitty's pictures off the screen, which outlast the text."""


def png(image: Image) -> bytes:
    """Return a picture (height, width, 3) as a PNG file's bytes."""
    from PIL import Image as Pictures

    buffer = io.BytesIO()
    Pictures.fromarray(image).save(buffer, format="PNG")
    return buffer.getvalue()


def kitty(image: Image, width: int, rows: int) -> str:
    """Return the sequence that draws a picture at the cursor, scaled to ``width`` by ``rows`` characters.

    Source: the terminal graphics protocol of kitty; the terminal is asked to answer nothing (q=2).
    """
    data = base64.standard_b64encode(png(image)).decode()
    chunks = [data[start : start + _KITTY_CHUNK] for start in range(0, len(data), _KITTY_CHUNK)]
    parts = []
    for number, chunk in enumerate(chunks):
        more = int(number + 1 < len(chunks))
        control = f"a=T,f=100,c={width},r={rows},C=1,q=2,m={more}" if number == 0 else f"q=2,m={more}"
        parts.append(f"\x1b_G{control};{chunk}\x1b\\")
    return "".join(parts)


def sixel(image: Image) -> str:
    """Return the sequence that draws a picture at the cursor, a pixel a pixel.

    Source: DEC's sixel graphics, as the VT340 manual gives them.
    """
    from PIL import Image as Pictures

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
    starts = np.flatnonzero(np.diff(bits, prepend=-1))
    lengths = np.diff(np.append(starts, len(bits)))
    text = ""
    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        character = chr(63 + int(bits[start]))
        text += character * length if length < 4 else f"!{length}{character}"
    return text


PICTURE_SIZE: Final = {"blocks": (240, 180), "kitty": (480, 360), "sixel": (480, 360)}
"""Width and height of the pictures before they are fitted to the screen [pixels]."""
# A terminal that knows it shows a screen whole: no one sees it half drawn.
_BEGIN: Final = "\x1b[?2026h"
_END: Final = "\x1b[?2026l"


@dataclass(frozen=True)
class Picture:
    """A picture and where it goes.

    Attributes:
        image: (height, width, 3).
        marks: characters put on it where it is made of characters, each at its share (0…1) of width and height.
        place: the region of the screen.
    """

    image: Image
    marks: Mapping[str, tuple[float, float]]
    place: Region


class Canvas:
    """A terminal's screen to draw on."""

    def __init__(self, device: Device, graphics: Drawn) -> None:
        """Draw on a device in the given way."""
        self._device = device
        self.graphics = graphics

    def block_lines(self, picture: Picture | None) -> list[Text]:
        """Return the picture's lines of characters; none without one, or where it is drawn in pixels."""
        if picture is None or self.graphics != "blocks":
            return []
        colours = console.err()
        plain = colours.no_color or colours.color_system is None or not colours.encoding.startswith("utf")
        place = picture.place
        return block_lines(picture.image, place.width, place.rows, dict(picture.marks), colour=not plain)

    def put(self, lines: Sequence[Text], picture: Picture | None) -> None:
        """Put a whole screen on the terminal: a line a row, and over them the picture where it is made of pixels."""
        width, _ = self._device.size()
        text = self._encoded(lines, width)
        if picture is not None:
            text += self._pixels(picture)
        clear = KITTY_CLEAR if self.graphics == "kitty" else ""
        self._device.write(f"{_BEGIN}{clear}{text}{_END}")

    def put_line(self, line: Text, row: int) -> None:
        """Put only one line, at a row counted from 1, on the terminal."""
        width, _ = self._device.size()
        self._device.write(self._encoded([line], width, top=row))

    def clear(self) -> None:
        """Take pictures off the screen."""
        if self.graphics == "kitty" and self._device.entered:
            self._device.write(KITTY_CLEAR)

    def _pixels(self, picture: Picture) -> str:
        place = picture.place
        at = f"\x1b[{place.top + 1};{place.left + 1}H"
        if self.graphics == "kitty":
            return at + kitty(picture.image, place.width, place.rows)
        if self.graphics == "sixel":
            across, down = self._device.cell()
            return at + sixel(resized(picture.image, place.width * across, place.rows * down))
        return ""

    def _encoded(self, lines: Sequence[Text], width: int, top: int = 1) -> str:
        """Return lines as what the terminal reads, each at its row and the rest of the row empty."""
        real = console.err()
        buffer = io.StringIO()
        shown = console.LiteralConsole(
            file=buffer,
            force_terminal=True,
            color_system=real.color_system or "standard",
            no_color=real.no_color,
            width=width,
            legacy_windows=False,
        )
        for row, line in enumerate(lines, start=top):
            buffer.write(f"\x1b[{row};1H")
            shown.print(line, end="", no_wrap=True, crop=False, overflow="ignore")
            buffer.write("\x1b[0m\x1b[K")
        return buffer.getvalue()


class Painter:
    """Paints screens on a terminal. Close it."""

    def __init__(self, device: Device, workcell: Workcell, graphics: Drawn) -> None:
        """Prepare for questions about a workcell; where pictures cannot be drawn, text stands alone and says why."""
        self._device = device
        self._canvas = Canvas(device, graphics)
        self._camera: SituationCamera | None = None
        self.remark = ""
        if graphics != "none":
            try:
                self._camera = SituationCamera(workcell, PICTURE_SIZE[graphics])
            except WorkFailedError as error:
                self.remark = f"No picture: {error}"

    @property
    def pictures(self) -> bool:
        """Whether the screen keeps room for a picture."""
        return self._canvas.graphics != "none"

    def situation(self, question: Question, share: float = 1.0) -> Situation | None:
        """Return the picture of a question, the arm having gone ``share`` of its motion; None without pictures."""
        return None if self._camera is None else self._camera.picture(question, share)

    def paint(self, shown: Shown, situation: Situation | None) -> None:
        """Put a whole screen on the terminal."""
        width, height = self._device.size()
        place = region(width, height, pictures=self.pictures)
        fits = situation is not None and place.width > 0 and not shown.help
        picture = Picture(situation.image, situation.marks, place) if situation is not None and fits else None
        times = situation.times if situation is not None and fits else 0.0
        lines = self._canvas.block_lines(picture)
        content = replace(shown, picture=lines, times=times, remark=self.remark)
        self._canvas.put(compose(content, width, height, pictures=self.pictures), picture)

    def paint_status(self, status: str) -> None:
        """Put only the line at the bottom on the terminal."""
        width, height = self._device.size()
        self._canvas.put_line(status_line(status, width), height)

    def close(self) -> None:
        """Free the camera and take pictures off the screen."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self._canvas.clear()
