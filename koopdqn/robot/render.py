"""Off-screen pictures of a scene, with paths, marks and ghosts of the arm drawn in."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from koopdqn.errors import WorkFailedError
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.robot import DISABLED, VARIABLE
from koopdqn.robot.scene import Scene
from koopdqn.robot.view import View

Image = NDArray[np.uint8]
"""A picture (height, width, 3), red, green, blue."""
Rgba = tuple[float, float, float, float]
"""Red, green, blue and opacity, each 0…1."""

_MAX_GEOMS: Final = 10_000
_SEGMENT: Final = 0.012
"""Length of a drawn line's pieces [m]: on a bend of 0.1 m they leave the curve by 0.2 mm."""
_SHINES_THROUGH: Final = 0.55
"""Opacity of a line that something stands before."""
_COVERED: Final = 6.0
"""By how much of 255 a pixel differs where a line is drawn on it."""
_DEPTH_SLACK: Final = 2e-3
"""What is nearer by less [m] counts as the same."""


@dataclass(frozen=True)
class Line:
    """A path drawn as a tube: points (N, 3) [m], a colour and the tube's radius [m]."""

    points: Array
    rgba: Rgba
    radius: float = 0.003


@dataclass(frozen=True)
class Sphere:
    """A mark: its center (3,) [m], colour and radius [m]."""

    center: Array
    rgba: Rgba
    radius: float = 0.01


@dataclass(frozen=True)
class Ghost:
    """The arm once more, seen through: its joint angles (6,) [rad] and an opacity 0…1."""

    joints: Array
    opacity: float = 0.3


class Camera:
    """Draws pictures of one scene, all of one size. Close it.

    Attributes:
        scene: what is drawn; its ``data`` is overwritten.
        size: width and height [pixels].
    """

    def __init__(self, scene: Scene, size: tuple[int, int]) -> None:
        """Prepare for pictures of ``size`` (width, height) [pixels].

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        self.scene = scene
        self.size = size
        display = scene.model.vis.global_
        display.offwidth, display.offheight = max(display.offwidth, size[0]), max(display.offheight, size[1])
        try:
            self._renderer = mujoco.Renderer(scene.model, height=size[1], width=size[0], max_geom=_MAX_GEOMS)
        # A missing library, driver or display shows in as many ways as there are backends, and not as one error type.
        except Exception as error:
            asked = os.environ.get(VARIABLE, "")
            tried = f"{VARIABLE}={asked}" if asked else "the system's default"
            reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
            if asked == DISABLED:
                reason = "it was asked for, or the libraries of neither egl nor osmesa were found"
            raise WorkFailedError(
                f"pictures need a rendering backend that works; tried {tried}: {reason}; see `koopdqn doctor`"
            ) from error

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._renderer.close()

    def picture(
        self,
        joints: Array,
        view: View,
        lines: Sequence[Line] = (),
        spheres: Sequence[Sphere] = (),
        ghosts: Sequence[Ghost] = (),
    ) -> Image:
        """Return the picture (height, width, 3) of the arm at joint angles (6,) [rad].

        Where something stands before a line, the line shines through faintly. Ghosts are seen where
        they are nearer than anything else.
        """
        self._look(joints, view)
        draw(self._renderer.scene, lines, spheres)
        image = self._renderer.render().astype(float)
        if ghosts:
            image = self._with_ghosts(image, joints, view, ghosts, lines, spheres)
        if lines:
            image = self._with_hidden(image, lines)
        return np.asarray(np.rint(image), dtype=np.uint8)

    def _look(self, joints: Array, view: View) -> None:
        self.scene.place(joints)
        # The lights are placed with the bodies that carry them, which kinematics alone leaves out.
        mujoco.mj_comPos(self.scene.model, self.scene.data)
        mujoco.mj_camlight(self.scene.model, self.scene.data)
        eye = mujoco.MjvCamera()
        eye.lookat[:] = view.lookat
        eye.distance, eye.azimuth, eye.elevation = view.distance, view.azimuth, view.elevation
        self._renderer.update_scene(self.scene.data, eye)

    def _with_ghosts(
        self,
        image: Array,
        joints: Array,
        view: View,
        ghosts: Sequence[Ghost],
        lines: Sequence[Line],
        spheres: Sequence[Sphere],
    ) -> Array:
        # Two solid pictures blended by depth: transparent geoms would show every joint inside the others.
        self._look(joints, view)
        draw(self._renderer.scene, lines, spheres)
        nearest = self._depth()
        for ghost in ghosts:
            self._look(ghost.joints, view)
            solid = self._renderer.render().astype(float)
            depth = self._depth()
            nearer = depth < nearest - _DEPTH_SLACK
            image = np.where(nearer[..., None], (1 - ghost.opacity) * image + ghost.opacity * solid, image)
        self._look(joints, view)
        return image

    def _with_hidden(self, image: Array, lines: Sequence[Line]) -> Array:
        drawn = self._renderer.scene
        drawn.ngeom = 0
        empty = self._renderer.render().astype(float)
        draw(drawn, lines)
        alone = self._renderer.render().astype(float)
        covered = np.abs(alone - empty).max(axis=2, keepdims=True) > _COVERED
        return np.where(covered, (1 - _SHINES_THROUGH) * image + _SHINES_THROUGH * alone, image)

    def _depth(self) -> Array:
        self._renderer.enable_depth_rendering()
        depth = np.array(self._renderer.render(), dtype=float)
        self._renderer.disable_depth_rendering()
        return depth


def draw(drawn: Any, lines: Sequence[Line], spheres: Sequence[Sphere] = ()) -> None:
    """Add lines and marks to what MuJoCo draws, a ``mujoco.MjvScene``; where there is little room lines get coarser."""
    for sphere in spheres:
        if geom := _new_geom(drawn, mujoco.mjtGeom.mjGEOM_SPHERE, sphere.rgba):
            geom.size[:] = sphere.radius
            geom.pos[:] = sphere.center
    thinned = [_thinned(line.points, _SEGMENT) for line in lines]
    # Longer segments rather than missing lines where there are more than the scene has room for.
    room = max(drawn.maxgeom - drawn.ngeom, 1)
    every = max(1, -(-sum(map(len, thinned)) // room))
    # Each line rounds up.
    while (
        every < max(map(len, thinned), default=1) and sum(-(-(len(points) - 1) // every) for points in thinned) > room
    ):
        every += 1
    for line, points in zip(lines, thinned, strict=True):
        kept = np.concatenate([points[:-1:every], points[-1:]])
        for start, end in pairwise(kept):
            if geom := _new_geom(drawn, mujoco.mjtGeom.mjGEOM_CAPSULE, line.rgba):
                mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, line.radius, start, end)


def _new_geom(drawn: Any, kind: Any, rgba: Rgba) -> Any:
    if drawn.ngeom >= drawn.maxgeom:
        return None
    geom = drawn.geoms[drawn.ngeom]
    drawn.ngeom += 1
    colour = np.array(rgba, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
    # It shines by itself, so that its colour is that of the plots.
    geom.emission, geom.specular = 0.1, 0.0
    return geom


def _thinned(points: Array, spacing: float) -> Array:
    """Return points (M, 3) of a polyline (N, 3) at least ``spacing`` [m] of its length apart, both ends kept."""
    _, first = np.unique(np.floor(arc_lengths(points) / spacing), return_index=True)
    return np.asarray(points[np.unique(np.append(first, len(points) - 1))], dtype=float)
