"""Figures 2 and 6, left: initial, intermediate and goal poses on the rendered arm, with demonstrated paths."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.plots.style import (
    DEMONSTRATED,
    GREY,
    INK,
    VIEWS,
    frame_projection,
    picture,
    project,
    rgba,
    show_image,
    two_planes,
)
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Line, Sphere
from koopdqn.robot.scene import Scene
from koopdqn.robot.view import View, choose_view, fitted_view
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 840, 760
SIZE: Final = (1000, 800)
"""Width and height of the rendering [pixels]."""
_SHARES: Final = (1 / 3, 2 / 3)
_GHOST: Final = 0.45
"""Opacity of the arm before the goal."""
_AXIS_M: Final = 0.07
_TOOL_M: Final = 0.4
"""About how far a tool with its payload reaches beyond the flange [m]."""
_CLOSE_ELEVATION: Final = -25.0
_AXIS_COLOURS: Final = ("#D62728", "#2CA02C", "#1F77B4")


def plot_poses(path: Path, scene: Scene, shown: Demonstration, view: View, title: str) -> None:
    """Draw the arm at the goal, its initial and two intermediate poses as ghosts, with the demonstrated path.

    The flange's axes are drawn at each of the four.

    Args:
        path: the PNG.
        scene: the arm and what stands around it.
        shown: a demonstration with joint angles.
        view: from where.
        title: above everything.

    Raises:
        BadInputError: the demonstration has no joint angles, or the file cannot be written.
        WorkFailedError: OpenGL does not work here.
    """
    joints = joints_of(shown)
    stops = _stops(shown)
    lines = [Line(shown.poses[:, pose.POSITION], rgba(DEMONSTRATED), 0.004)]
    for stop in stops:
        lines += _frame(shown.poses[stop])
    marks = [Sphere(shown.poses[stop, :3], rgba(INK), 0.008) for stop in stops]
    ghosts = [Ghost(joints[stop], _GHOST) for stop in stops[:-1]]
    with Camera(scene, SIZE) as camera:
        image = camera.picture(joints[-1], view, lines, marks, ghosts)
    with picture(path, title, WIDTH, HEIGHT) as figure:
        axes = figure.subplots()
        show_image(axes, image, "")
        handles: list[Line2D | Patch] = [
            Line2D([], [], color=DEMONSTRATED, linewidth=3, label="demonstrated flange path"),
            Line2D([], [], color=INK, marker="o", linestyle="", label="initial, two intermediate and goal poses"),
        ]
        handles += [
            Line2D([], [], color=colour, linewidth=2, label=f"flange {axis}")
            for axis, colour in zip("xyz", _AXIS_COLOURS, strict=True)
        ]
        handles.append(Patch(facecolor=GREY, alpha=0.4, label="arm before the goal"))
        figure.legend(handles=handles, loc="outside lower center", ncols=3)


def plot_paths(path: Path, items: Sequence[Demonstration], task: Task, shown: int) -> None:
    """Draw the same demonstration in two projections with axes in metres, over the others.

    Raises:
        BadInputError: the file cannot be written.
    """
    with picture(path, "The same path in the base frame", WIDTH, HEIGHT) as figure:
        stack = figure.subplots(2, 1, height_ratios=(1.8, 1))
        planes = two_planes([item.poses[:, pose.POSITION] for item in items])
        for axes, plane in zip(stack, planes, strict=True):
            for index, item in enumerate(items):
                if index != shown:
                    label = "other demonstrations" if index == (1 if shown == 0 else 0) else None
                    axes.plot(*project(item.poses, plane), color=GREY, linewidth=0.8, label=label)
            poses = items[shown].poses
            axes.plot(*project(poses, plane), color=DEMONSTRATED, linewidth=2.2, label=f"demonstration {shown}")
            stops = poses[_stops(items[shown])]
            axes.plot(*project(stops, plane), color=INK, marker="o", linestyle="", markersize=5, label="poses drawn")
            frame_projection(axes, plane, task, [item.poses[:, pose.POSITION] for item in items])
            axes.set_title(f"From {VIEWS[plane]}")
        handles, labels = stack[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)


def best_view(scene: Scene, shown: Demonstration) -> View:
    """Return the view that shows a demonstration best.

    Raises:
        BadInputError: it has no joint angles.
    """
    return choose_view(scene, joints_of(shown), SIZE)


def close_view(scene: Scene, shown: Demonstration, azimuth: float) -> View:
    """Return a near view of the tool in a demonstration's four poses, from a direction [degrees]."""
    stops = shown.poses[_stops(shown)]
    along, across = (pose.rotate(stops[:, pose.QUATERNION], np.array(axis)) for axis in ((0, 0, 1.0), (1.0, 0, 0)))
    origin = stops[:, pose.POSITION]
    ends = [origin + _TOOL_M * along, origin - 0.3 * _TOOL_M * along, origin + 0.25 * _TOOL_M * across]
    points = np.concatenate([*ends, origin - 0.25 * _TOOL_M * across])
    return fitted_view(points, azimuth, _CLOSE_ELEVATION, SIZE, scene.model.vis.global_.fovy)


def joints_of(item: Demonstration) -> Array:
    """Return the joint angles (N, 6) [rad] of a demonstration.

    Raises:
        BadInputError: it has none.
    """
    if item.joints is None:
        raise BadInputError("a demonstration must hold joint angles to be drawn on the arm, found none")
    return item.joints


def _stops(item: Demonstration) -> list[int]:
    """Return the samples of the initial, two intermediate and the goal pose, by share of path length."""
    moved = np.linalg.norm(np.diff(item.poses[:, pose.POSITION], axis=0), axis=1)
    arc = np.concatenate([[0.0], np.cumsum(moved)])
    return [0, *(int(np.searchsorted(arc, share * arc[-1])) for share in _SHARES), len(item) - 1]


def _frame(flange: Array) -> list[Line]:
    matrix = pose.to_matrix(flange[pose.QUATERNION])
    origin = flange[pose.POSITION]
    return [
        Line(np.array([origin, origin + _AXIS_M * matrix[:, i]]), rgba(colour), 0.0025)
        for i, colour in enumerate(_AXIS_COLOURS)
    ]
