"""From where a scene is looked at, and the choice of a view that shows a motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import mujoco
import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.robot.scene import Scene

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
        """Return where points (N, 3) [m] in front of the eye appear, as columns and rows (N, 2) [pixels].

        The picture has a ``size`` (width, height) and spans a vertical angle ``field_of_view`` [degrees].
        """
        right, up, depth = ((points - self.eye) @ self.axes().T).T
        focal = size[1] / 2 / np.tan(np.radians(field_of_view) / 2)
        return np.stack([size[0] / 2 + focal * right / depth, size[1] / 2 - focal * up / depth], axis=1)


def choose_view(scene: Scene, joints: Array, size: tuple[int, int]) -> View:
    """Return the view that shows a motion best, of joint angles (N, 6) [rad], with the arm and its path in the picture.

    Of a fan of directions it takes the one from which, by rays cast from the eye, the payload can be seen
    at the goal, little of the flange's path is hidden, the path looks long and wide, and nothing stands
    right before the eye. What stands about the goal is in the picture too, whose ``size`` is width and height
    [pixels]. It needs no OpenGL.
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
    """Return the nearest view in a direction [degrees] in which all points (N, 3) [m] are in the picture.

    The picture has a ``size`` (width, height) [pixels] and spans a vertical angle ``field_of_view`` [degrees].
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
