"""The pictures of a demonstration's initial, two intermediate and goal poses: on the arm, and as paths in space."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.paths import arc_lengths
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Line, Sphere
from koopdqn.robot.scene import Scene
from koopdqn.robot.view import View, choose_view, fitted_view
from koopdqn.tasks.task import Task

WIDTH, HEIGHT = 840, 760
SIZE: Final = (1000, 800)
"""Width and height of the rendering [pixels]."""
_AXES: Final = {"x": "#D62728", "y": "#2CA02C", "z": "#1F77B4"}
_AXIS_M: Final = 0.07
# About a tool with its payload, in the flange's frame.
_TOOL_M: Final = np.array([[0, 0, 0.4], [0, 0, -0.12], [0.1, 0, 0], [-0.1, 0, 0]])


def plot_poses(path: Path, scene: Scene, item: Demonstration, view: View, title: str) -> None:
    """Draw the arm at a demonstration's goal, its earlier poses as ghosts, with the flange's axes in each and the path.

    Raises:
        BadInputError: the demonstration has no joint angles, or the file cannot be written.
        WorkFailedError: OpenGL does not work here.
    """
    joints, stops = joints_of(item), stops_of(item)
    lines = [Line(item.poses[:, pose.POSITION], style.rgba(style.DEMONSTRATED), 0.004)]
    for flange in item.poses[stops]:
        origin, axes = flange[pose.POSITION], pose.to_matrix(flange[pose.QUATERNION]).T
        ends = zip(origin + _AXIS_M * axes, _AXES.values(), strict=True)
        lines += [Line(np.array([origin, end]), style.rgba(colour), 0.0025) for end, colour in ends]
    marks = [Sphere(item.poses[stop, pose.POSITION], style.rgba(style.INK), 0.008) for stop in stops]
    ghosts = [Ghost(joints[stop], 0.45) for stop in stops[:-1]]
    with closing(Camera(scene, SIZE)) as camera:
        image = camera.picture(joints[-1], view, lines, marks, ghosts)
    with style.picture(path, title, WIDTH, HEIGHT) as figure:
        style.show_image(figure.subplots(), image, "")
        handles = [
            Line2D([], [], color=style.DEMONSTRATED, linewidth=3, label="demonstrated flange path"),
            Line2D([], [], color=style.INK, marker="o", linestyle="", label="initial, two intermediate and goal poses"),
            *(Line2D([], [], color=colour, linewidth=2, label=f"flange {axis}") for axis, colour in _AXES.items()),
            Patch(facecolor=style.GREY, alpha=0.4, label="arm before the goal"),
        ]
        figure.legend(handles=handles, loc="outside lower center", ncols=3)


def plot_paths(path: Path, items: Sequence[Demonstration], task: Task, shown: int) -> None:
    """Draw a demonstration over the others in two projections with axes in metres.

    Raises:
        BadInputError: the file cannot be written.
    """
    paths = [item.poses[:, pose.POSITION] for item in items]
    stops = paths[shown][stops_of(items[shown])]
    with style.picture(path, "The same path in the base frame", WIDTH, HEIGHT) as figure:
        stack = figure.subplots(2, 1, height_ratios=(1.8, 1))
        for axes, plane in zip(stack, style.two_planes(paths), strict=True):
            for index, other in enumerate(paths[:shown] + paths[shown + 1 :]):
                label = None if index else "other demonstrations"
                axes.plot(*style.project(other, plane), color=style.GREY, linewidth=0.8, label=label)
            drawn = {"color": style.DEMONSTRATED, "linewidth": 2.2, "label": f"demonstration {shown}"}
            axes.plot(*style.project(paths[shown], plane), **drawn)
            marks = {"color": style.INK, "marker": "o", "linestyle": "", "markersize": 5, "label": "poses drawn"}
            axes.plot(*style.project(stops, plane), **marks)
            style.frame_projection(axes, plane, task, paths)
            axes.set_title(f"From {style.VIEWS[plane]}")
        figure.legend(*stack[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)


def best_view(scene: Scene, item: Demonstration) -> View:
    """Return the view that shows a demonstration best.

    Raises:
        BadInputError: it has no joint angles.
    """
    return choose_view(scene, joints_of(item), SIZE)


def close_view(scene: Scene, item: Demonstration, azimuth: float) -> View:
    """Return a near view of the tool in a demonstration's four poses, from a direction [degrees]."""
    stops = item.poses[stops_of(item)]
    points = [stops[:, pose.POSITION] + pose.rotate(stops[:, pose.QUATERNION], offset) for offset in _TOOL_M]
    return fitted_view(np.concatenate(points), azimuth, -25.0, SIZE, scene.model.vis.global_.fovy)


def joints_of(item: Demonstration) -> Array:
    """Return the joint angles (N, 6) [rad] of a demonstration.

    Raises:
        BadInputError: it has none.
    """
    if item.joints is None:
        raise BadInputError("a demonstration must hold joint angles to be drawn on the arm, found none")
    return item.joints


def stops_of(item: Demonstration) -> list[int]:
    """Return the samples of the initial, two intermediate and the goal pose, by share of path length."""
    arc = arc_lengths(item.poses[:, pose.POSITION])
    return [0, *np.searchsorted(arc, arc[-1] * np.array([1, 2]) / 3).tolist(), len(item) - 1]
