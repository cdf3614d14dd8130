"""Pictures of a scene: camera, view, paths and ghosts drawn in, and the backend that renders without a screen."""

import ctypes
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import TracebackType
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from koopdqn import pose
from koopdqn.errors import BadInputError, WorkFailedError, unknown_name
from koopdqn.pose import Array
from koopdqn.robot.scene import Scene

VARIABLE: Final = "MUJOCO_GL"
DISABLED: Final = "disable"
_BACKENDS: Final = ("egl", "glfw", "osmesa", DISABLED)
# Other spellings that MuJoCo and dm_control both take.
_SYNONYMS: Final = ("disabled", "off", "false", "0", "enable", "enabled", "on", "true", "1")

# Of each inner tuple one library must load; without them `import mujoco` fails, not only drawing.
_LIBRARIES: Final = {
    "egl": (("libEGL.so.1",), ("libOpenGL.so.0", "libGL.so.1")),
    "osmesa": (("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),),
}


def prepare_rendering(loads: Callable[[str], bool] | None = None) -> None:
    """Choose a backend that needs no display, where there is none; call it before anything imports mujoco.

    On Linux without a display, and with MUJOCO_GL unset, it sets MUJOCO_GL to the first of ``egl`` and
    ``osmesa`` whose libraries load, else to ``disable``, so that all but pictures works.

    Args:
        loads: whether a shared library of that name can be loaded; None tries it.

    Raises:
        BadInputError: MUJOCO_GL names no backend, or one whose libraries cannot be loaded.
    """
    if sys.platform != "linux":
        return
    loads = loads or _loads
    asked = os.environ.get(VARIABLE, "").strip().lower()
    if asked:
        if asked not in _BACKENDS + _SYNONYMS:
            raise unknown_name(f"rendering backend {VARIABLE}", asked, _BACKENDS)
        # dm_control takes lower case only
        os.environ[VARIABLE] = asked
        missing = _missing(asked, loads)
        if missing:
            raise BadInputError(
                f"{VARIABLE} must name a rendering backend whose libraries load, found {asked!r} without {missing};"
                " unset it, or see `koopdqn doctor`"
            )
        return
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return
    working = (name for name in _LIBRARIES if not _missing(name, loads))
    os.environ[VARIABLE] = next(working, DISABLED)


def _missing(backend: str, loads: Callable[[str], bool]) -> str:
    """Return the libraries that a backend lacks, for people; empty if none."""
    lacking = [names[0] for names in _LIBRARIES.get(backend, ()) if not any(map(loads, names))]
    return " and ".join(lacking)


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


_MARGIN: Final = 0.10
"""Share of the picture's half width and half height that stays free around what is to be seen."""
_AZIMUTHS: Final = tuple(range(-120, 121, 15))
_ELEVATIONS: Final = (-20.0, -32.0)
_STAND_OFF: Final = 0.2
"""Least distance of the eye from the plane of the nearest point [m]."""
_SURROUNDINGS: Final = 0.8
"""What stands within this distance [m] of the goal, by its middle, is in the picture."""
_ABOVE: Final = 0.15
"""How far above its middle what stands about the goal is still in the picture [m]."""
_PROBES: Final = 24
"""Points of the path that are tested for being hidden."""


@dataclass(frozen=True)
class View:
    """From where a scene is looked at, in MuJoCo's terms.

    Attributes:
        lookat: the point (3,) [m] in the middle of the picture.
        distance: from there to the eye [m].
        azimuth: direction of sight about z [degrees]; 0 looks along +x, 90 along +y.
        elevation: direction of sight above the horizon [degrees]; negative looks down.
    """

    lookat: tuple[float, float, float]
    distance: float
    azimuth: float
    elevation: float

    @property
    def forward(self) -> Array:
        """The direction of sight, a unit vector (3,)."""
        azimuth, elevation = np.radians([self.azimuth, self.elevation])
        level = np.cos(elevation)
        return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])

    @property
    def eye(self) -> Array:
        """Where the eye is (3,) [m]."""
        return np.asarray(np.array(self.lookat) - self.distance * self.forward)

    def axes(self) -> Array:
        """Return the unit vectors (3, 3) to the right, up and forward, one a row."""
        azimuth = np.radians(self.azimuth)
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        return np.array([right, np.cross(right, self.forward), self.forward])

    def pixels(self, points: Array, size: tuple[int, int], field_of_view: float) -> Array:
        """Return where points (N, 3) [m] appear, as columns and rows (N, 2) [pixels].

        Args:
            points: in front of the eye.
            size: width and height of the picture.
            field_of_view: vertical angle that the picture spans [degrees].
        """
        right, up, depth = ((points - self.eye) @ self.axes().T).T
        focal = size[1] / 2 / np.tan(np.radians(field_of_view) / 2)
        return np.stack([size[0] / 2 + focal * right / depth, size[1] / 2 - focal * up / depth], axis=1)


def choose_view(scene: Scene, joints: Array, size: tuple[int, int]) -> View:
    """Return the view that shows a motion best, with the arm and its path in the picture.

    Of a fan of directions it takes the one from which, by rays cast from the eye, the payload can be seen
    at the goal, little of the flange's path is hidden, the path looks long and wide, and nothing stands
    right before the eye. What stands about the goal is in the picture too. It needs no OpenGL.

    Args:
        scene: the scene.
        joints: joint angles (N, 6) [rad] along the motion.
        size: width and height of the picture [pixels].
    """
    path = scene.arm.forward(joints)[:, pose.POSITION]
    poses = (joints[0], joints[len(joints) // 2], joints[-1])
    seen = np.concatenate([path, *(_arm_corners(scene, row) for row in poses), _surroundings(scene, path[-1])])
    views = [
        fitted_view(seen, azimuth, elevation, size, scene.model.vis.global_.fovy)
        for elevation in _ELEVATIONS
        for azimuth in _AZIMUTHS
    ]
    return max(views, key=lambda view: _score(scene, joints, path, view))


def fitted_view(points: Array, azimuth: float, elevation: float, size: tuple[int, int], field_of_view: float) -> View:
    """Return the nearest view in a direction in which all points (N, 3) [m] are in the picture.

    Args:
        points: what is to be seen.
        azimuth: direction of sight [degrees].
        elevation: direction of sight [degrees].
        size: width and height of the picture [pixels].
        field_of_view: vertical angle that the picture spans [degrees].
    """
    axes = View((0.0, 0.0, 0.0), 1.0, azimuth, elevation).axes()
    tangent = np.tan(np.radians(field_of_view) / 2) * (1 - _MARGIN) * np.array([size[0] / size[1], 1.0])
    sideways, depth = (points @ axes.T)[:, :2], points @ axes[2]
    # Seen from height h above the plane of depth 0, a point is inside if |sideways − c| <= tangent (depth + h):
    # both edges are linear in c and h, so the least h leaves the middle between the two that bind.
    high, low = (sideways - tangent * depth[:, None]).max(axis=0), (sideways + tangent * depth[:, None]).min(axis=0)
    center = (high + low) / 2
    # Points in a row before the eye bind nothing; it still stands off from the first.
    back = max(float(((high - low) / 2 / tangent).max()), _STAND_OFF - float(depth.min()))
    middle = (depth.min() + depth.max()) / 2
    lookat = center[0] * axes[0] + center[1] * axes[1] + middle * axes[2]
    return View((float(lookat[0]), float(lookat[1]), float(lookat[2])), float(back + middle), azimuth, elevation)


def _surroundings(scene: Scene, goal: Array) -> Array:
    """Return the middles (M, 3) [m] of what stands about a goal (3,) [m], and points a little above them."""
    model, data = scene.model, scene.data
    standing = [i for i in range(model.ngeom) if model.body_weldid[model.geom_bodyid[i]] == 0]
    middles = data.geom_xpos[standing]
    middles = middles[np.linalg.norm(middles - goal, axis=1) < _SURROUNDINGS]
    return np.concatenate([middles, middles + np.array([0.0, 0.0, _ABOVE])])


def _arm_corners(scene: Scene, joints: Array) -> Array:
    """Return the corners (8 N, 3) [m] of the boxes around every moving geom at joints (6,) [rad]."""
    scene.place(joints)
    model, data = scene.model, scene.data
    moving = [i for i in range(model.ngeom) if model.body_weldid[model.geom_bodyid[i]] != 0]
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = []
    for i in moving:
        center, half = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
        corners.append(data.geom_xpos[i] + (center + signs * half) @ data.geom_xmat[i].reshape(3, 3).T)
    return np.concatenate([*corners, np.zeros((1, 3))])


def _seen_share(scene: Scene, joints: Array, targets: Sequence[tuple[Array, int]], eye: Array) -> float:
    """Return the share of targets, points (3,) [m] with the geom each lies in or −1, that nothing hides."""
    scene.place(joints)
    hit = np.zeros(1, dtype=np.int32)
    seen = 0
    for point, own in targets:
        # The distance is in lengths of the ray: under 1 something stands before the point, −1 is nothing at all.
        distance = mujoco.mj_ray(scene.model, scene.data, eye, point - eye, None, 1, -1, hit)
        seen += distance < 0 or distance > 0.98 or int(hit[0]) == own
    return seen / max(len(targets), 1)


def _score(scene: Scene, joints: Array, path: Array, view: View) -> float:
    """Return how good a view of a motion is; the weights were set by looking at the tasks from all around."""
    probes = [(path[i], -1) for i in np.linspace(0, len(path) - 1, _PROBES).astype(int)]
    unhidden = np.mean([_seen_share(scene, row, probes, view.eye) for row in (joints[0], joints[-1])])
    # Leaves the arm at the goal, for what follows.
    scene.place(joints[-1])
    payload = [i for i in range(scene.model.ngeom) if "payload_" in scene.model.geom(i).name]
    targets = [(scene.data.geom_xpos[i].copy(), i) for i in payload]
    flat = (path - path.mean(axis=0)) @ view.axes()[:2].T
    # How long and how wide the path looks, as angles at the eye; a single pose has no width.
    length, width = np.append(np.linalg.svd(flat / np.sqrt(len(flat)), compute_uv=False), 0.0)[:2] / view.distance
    # What stands about the goal should not stand right before the eye.
    nearest = float(((_surroundings(scene, path[-1]) - view.eye) @ view.forward).min(initial=np.inf)) / view.distance
    return float(
        _seen_share(scene, joints[-1], targets, view.eye)
        + 0.2 * unhidden
        + 4.0 * length
        + 30.0 * width
        + 0.5 * min(nearest, 0.9)
    )


Image = NDArray[np.uint8]
"""A picture (height, width, 3), red, green, blue."""
Rgba = tuple[float, float, float, float]

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
    """A path drawn as a tube.

    Attributes:
        points: (N, 3) [m].
        rgba: colour, each part 0…1.
        radius: of the tube [m].
    """

    points: Array
    rgba: Rgba
    radius: float = 0.003


@dataclass(frozen=True)
class Sphere:
    """A mark.

    Attributes:
        center: (3,) [m].
        rgba: colour, each part 0…1.
        radius: [m].
    """

    center: Array
    rgba: Rgba
    radius: float = 0.01


@dataclass(frozen=True)
class Ghost:
    """The arm once more, seen through.

    Attributes:
        joints: (6,) [rad].
        opacity: 0…1.
    """

    joints: Array
    opacity: float = 0.3


class Camera:
    """Draws pictures of one scene, all of one size. Close it, or use it in a ``with`` block.

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

    def __enter__(self) -> "Camera":
        """Return the camera."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the camera."""
        self.close()

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
        self._draw(lines, spheres)
        image = self._renderer.render().astype(float)
        if ghosts:
            image = self._with_ghosts(image, joints, view, ghosts)
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

    def _with_ghosts(self, image: Array, joints: Array, view: View, ghosts: Sequence[Ghost]) -> Array:
        # Two solid pictures blended by depth: transparent geoms would show every joint inside the others.
        self._look(joints, view)
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
        self._draw(lines, ())
        alone = self._renderer.render().astype(float)
        covered = np.abs(alone - empty).max(axis=2, keepdims=True) > _COVERED
        return np.where(covered, (1 - _SHINES_THROUGH) * image + _SHINES_THROUGH * alone, image)

    def _depth(self) -> Array:
        self._renderer.enable_depth_rendering()
        depth = np.array(self._renderer.render(), dtype=float)
        self._renderer.disable_depth_rendering()
        return depth

    def _draw(self, lines: Sequence[Line], spheres: Sequence[Sphere]) -> None:
        drawn = self._renderer.scene
        for sphere in spheres:
            if geom := self._new_geom(mujoco.mjtGeom.mjGEOM_SPHERE, sphere.rgba):
                geom.size[:] = sphere.radius
                geom.pos[:] = sphere.center
        thinned = [_thinned(line.points, _SEGMENT) for line in lines]
        # Longer segments rather than missing lines where there are more than the scene has room for.
        room = max(drawn.maxgeom - drawn.ngeom, 1)
        every = max(1, -(-sum(map(len, thinned)) // room))
        for line, points in zip(lines, thinned, strict=True):
            kept = np.concatenate([points[:-1:every], points[-1:]])
            for start, end in pairwise(kept):
                if geom := self._new_geom(mujoco.mjtGeom.mjGEOM_CAPSULE, line.rgba):
                    mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, line.radius, start, end)

    def _new_geom(self, kind: Any, rgba: Rgba) -> Any:
        drawn = self._renderer.scene
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
    points = np.asarray(points, dtype=float)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    _, first = np.unique(np.floor(arc / spacing), return_index=True)
    return np.asarray(points[np.unique(np.append(first, len(points) - 1))])


def render(
    scene: Scene,
    joints: Array,
    view: View,
    size: tuple[int, int],
    lines: Sequence[Line] = (),
    spheres: Sequence[Sphere] = (),
    ghosts: Sequence[Ghost] = (),
) -> Image:
    """Return one picture, as :meth:`Camera.picture` does; for several of one scene keep a :class:`Camera`.

    Raises:
        WorkFailedError: OpenGL does not work here.
    """
    with Camera(scene, size) as camera:
        return camera.picture(joints, view, lines, spheres, ghosts)
