"""The three-dimensional panel of a picture: the arm at the end of a motion, its start as a ghost, paths drawn in."""

from collections.abc import Sequence

from koopdqn.plots.style import Image, rgba, series_colours
from koopdqn.pose import Array
from koopdqn.robot.render import Ghost, Line, choose_view, render
from koopdqn.robot.scene import Scene

SIZE = (900, 720)
"""Width and height of the panel [pixels]."""


def draw_motion(
    scene: Scene,
    joints: Array,
    paths: Sequence[Array],
    colours: Sequence[str] | None = None,
    size: tuple[int, int] = SIZE,
) -> Image:
    """Return a picture (height, width, 3) of a motion and of paths beside it.

    Args:
        scene: the arm and what stands around it.
        joints: joint angles (N, 6) [rad] along the motion.
        paths: flange positions (T, 3) [m] to draw.
        colours: of the paths; None takes those of :func:`koopdqn.plots.style.series_colours`.
        size: width and height [pixels].

    Raises:
        WorkFailedError: OpenGL does not work here.
    """
    colours = series_colours(len(paths)) if colours is None else colours
    lines = [Line(path, rgba(colour)) for path, colour in zip(paths, colours, strict=True)]
    return render(scene, joints[-1], choose_view(scene, joints, size), size, lines, ghosts=[Ghost(joints[0])])
