"""Pictures of a scene: the arm at given joint angles, with paths, marks and ghosts of the arm drawn in."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from koopdqn import pose
from koopdqn.errors import WorkFailedError
from koopdqn.pose import Array
from koopdqn.robot.rendering_backend import VARIABLE
from koopdqn.robot.scene import Scene

Image = NDArray[np.uint8]
"""A picture (height, width, 3), red, green, blue."""
Rgba = tuple[float, float, float, float]

_MAX_GEOMS: Final = 10_000
_MARGIN: Final = 0.06
"""Share of the picture's half width and half height that stays free around what is to be seen."""
_AZIMUTHS: Final = (*range(-75, 80, 15), 105, -105, 135, -135)
_ELEVATIONS: Final = (-20.0, -32.0)
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
        self._option = mujoco.MjvOption()
        try:
            self._renderer = mujoco.Renderer(scene.model, height=size[1], width=size[0], max_geom=_MAX_GEOMS)
        # A missing library, driver or display shows in as many ways as there are backends, and not as one error type.
        except Exception as error:
            tried = os.environ.get(VARIABLE) or "the system's default"
            reason = str(error).strip().splitlines() or [type(error).__name__]
            raise WorkFailedError(
                f"pictures need a rendering backend that works; tried {VARIABLE}={tried}, which says: {reason[0]};"
                " see `koopdqn doctor`"
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

        Lines with more points than the picture has room for are thinned evenly.
        """
        model, data = self.scene.model, self.scene.data
        self._pose(joints)
        eye = mujoco.MjvCamera()
        eye.lookat[:] = view.lookat
        eye.distance, eye.azimuth, eye.elevation = view.distance, view.azimuth, view.elevation
        self._renderer.update_scene(data, eye, self._option)
        drawn = self._renderer.scene
        for ghost in ghosts:
            self._pose(ghost.joints)
            first = drawn.ngeom
            mujoco.mjv_addGeoms(model, data, self._option, mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_DYNAMIC, drawn)
            for geom in drawn.geoms[first : drawn.ngeom]:
                geom.rgba[3] *= ghost.opacity
        for sphere in spheres:
            self._sphere(drawn, sphere)
        self._lines(drawn, lines)
        return np.asarray(self._renderer.render(), dtype=np.uint8)

    def _pose(self, joints: Array) -> None:
        self.scene.place(joints)
        # The lights are placed with the bodies that carry them, which kinematics alone leaves out.
        mujoco.mj_comPos(self.scene.model, self.scene.data)
        mujoco.mj_camlight(self.scene.model, self.scene.data)

    def _lines(self, drawn: Any, lines: Sequence[Line]) -> None:
        room = drawn.maxgeom - drawn.ngeom
        wanted = sum(len(line.points) - 1 for line in lines)
        every = max(1, int(np.ceil(wanted / max(room - len(lines), 1))))
        for line in lines:
            keep = np.unique(np.append(np.arange(0, len(line.points), every), len(line.points) - 1))
            points = np.asarray(line.points, dtype=float)[keep]
            for start, end in zip(points[:-1], points[1:], strict=True):
                geom = self._new_geom(drawn, mujoco.mjtGeom.mjGEOM_CAPSULE, line.rgba)
                if geom is None:
                    return
                mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, line.radius, start, end)

    def _sphere(self, drawn: Any, sphere: Sphere) -> None:
        geom = self._new_geom(drawn, mujoco.mjtGeom.mjGEOM_SPHERE, sphere.rgba)
        if geom is not None:
            geom.size[:] = sphere.radius
            geom.pos[:] = sphere.center

    @staticmethod
    def _new_geom(drawn: Any, kind: Any, rgba: Rgba) -> Any:
        if drawn.ngeom >= drawn.maxgeom:
            return None
        geom = drawn.geoms[drawn.ngeom]
        drawn.ngeom += 1
        colour = np.array(rgba, dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
        # A drawn path is no thing in the scene: it shines by itself, so that its colour is that of the plots.
        geom.emission, geom.specular = 0.5, 0.0
        return geom


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


def choose_view(scene: Scene, joints: Array, size: tuple[int, int]) -> View:
    """Return the view that hides least of a motion and has the arm and its path in the picture.

    Of a fan of directions it takes the one from which most of the flange's path and of the payload at
    both ends can be seen, by rays cast from the eye with the arm at start and goal; of equals, the one
    that shows the path largest. It needs no OpenGL.

    Args:
        scene: the scene.
        joints: joint angles (N, 6) [rad] along the motion.
        size: width and height of the picture [pixels].
    """
    path = scene.arm.forward(joints)[:, pose.POSITION]
    probes = path[np.linspace(0, len(path) - 1, _PROBES).astype(int)]
    seen = np.concatenate([path, *(_arm_corners(scene, row) for row in (joints[0], joints[len(joints) // 2], joints[-1]))])
    best, best_score = None, -np.inf
    for elevation in _ELEVATIONS:
        for azimuth in _AZIMUTHS:
            view = fitted_view(seen, azimuth, elevation, size, scene.model.vis.global_.fovy)
            score = _visible(scene, joints, probes, view) + 0.5 * _spread(path, view)
            if score > best_score + 1e-9:
                best, best_score = view, score
    assert best is not None
    return best


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
    back = float(((high - low) / 2 / tangent).max())
    middle = (depth.min() + depth.max()) / 2
    lookat = center[0] * axes[0] + center[1] * axes[1] + middle * axes[2]
    return View((float(lookat[0]), float(lookat[1]), float(lookat[2])), float(back + middle), azimuth, elevation)


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


def _visible(scene: Scene, joints: Array, probes: Array, view: View) -> float:
    """Return the share (0…1) of path points and of the payload's middles that nothing hides, at start and goal."""
    model, data = scene.model, scene.data
    payload = [i for i in range(model.ngeom) if "payload_" in model.geom(i).name]
    hidden, total = 0.0, 0.0
    for row in (joints[0], joints[-1]):
        scene.place(row)
        targets = [(point, -1) for point in probes]
        # The payload is what the eye looks for: it weighs as much as a quarter of the path.
        weights = [1.0] * len(probes)
        for geom in payload:
            targets.append((data.geom_xpos[geom].copy(), geom))
            weights.append(len(probes) / 4 / len(payload))
        hit = np.zeros(1, dtype=np.int32)
        for (point, own), weight in zip(targets, weights, strict=True):
            ray = point - view.eye
            distance = mujoco.mj_ray(model, data, view.eye, ray, None, 1, -1, hit)
            total += weight
            # The distance is in lengths of the ray: under 1 something stands before the point.
            if 0 <= distance < 0.98 and int(hit[0]) != own:
                hidden += weight
    return 1.0 - hidden / total


def _spread(path: Array, view: View) -> float:
    """Return how large a path (N, 3) looks: the shorter side of its outline over its distance."""
    flat = (path - path.mean(axis=0)) @ view.axes()[:2].T
    return float(np.linalg.svd(flat / np.sqrt(len(flat)), compute_uv=False)[-1] / view.distance) * 10.0
