"""Scenes and motions baked into plain numbers, for a page that knows no MuJoCo."""

from typing import Any, Final

import mujoco
import numpy as np

from koopdqn import pose
from koopdqn.intent.box import Box
from koopdqn.intent.trust import TrustDomain
from koopdqn.intent.tube import Tube
from koopdqn.pose import Array
from koopdqn.robot.scene import Scene

DIGITS: Final = 4
"""Decimals of what is baked: tenths of a millimetre, and as fine in quaternions."""
MOST_FRAMES: Final = 160
"""Frames of one motion; longer ones are thinned."""
_MOST_GEOMS: Final = 5_000
_RING: Final = 16
_RINGS: Final = 100
# What is shorter [m] has no direction, and no surface would have room in what is narrower.
_LEAST_M: Final = 1e-6
_SHAPES: Final = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
}


def rounded(values: Array) -> Any:
    """Return an array as nested lists, rounded to what the page needs."""
    return (np.round(np.asarray(values, dtype=float), DIGITS) + 0.0).tolist()


def frames_of(count: int) -> np.ndarray:
    """Return the indices (F,) of at most :data:`MOST_FRAMES` of ``count`` poses, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, MOST_FRAMES)).round().astype(int))


def moving_links(scene: Scene) -> np.ndarray:
    """Return the bodies (L,) that move by themselves; what is fixed to one moves with it."""
    links = np.unique(scene.model.body_weldid)
    return np.asarray(links[links != 0])


def link_poses(scene: Scene, joints: Array) -> Array:
    """Return where the moving links are, (T, L, 7), at joint angles (T, 6) [rad], by MuJoCo."""
    links = moving_links(scene)
    poses = np.empty((len(joints), len(links), 7))
    for row, angles in zip(poses, joints, strict=True):
        scene.place(angles)
        row[:, pose.POSITION], row[:, pose.QUATERNION] = scene.data.xpos[links], scene.data.xquat[links]
    return poses


def baked_scene(scene: Scene) -> dict[str, Any]:
    """Return everything that MuJoCo draws of a scene: each geom's shape, size, colour, link, and its pose there.

    A geom that stands still has link −1 and its pose in the world. Sizes are MuJoCo's. Meshes are listed apart.
    """
    model, data = scene.model, scene.data
    scene.place(np.array(scene.arm.home))
    drawn = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
    every = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), every, drawn)
    links = moving_links(scene).tolist()
    meshes: dict[int, dict[str, Any]] = {}
    geoms = []
    for shown in drawn.geoms[: drawn.ngeom]:
        if shown.objtype != mujoco.mjtObj.mjOBJ_GEOM or shown.type not in _SHAPES:
            continue
        index = int(shown.objid)
        body = int(model.body_weldid[model.geom_bodyid[index]])
        matrix = data.geom_xmat[index].reshape(3, 3)
        here = pose.make(data.geom_xpos[index], pose.from_matrix(matrix))
        if body:
            here = pose.compose(pose.inverse(pose.make(data.xpos[body], data.xquat[body])), here)
        geom = {
            "name": scene.thing(index),
            "shape": _SHAPES[shown.type],
            "size": rounded(np.array(shown.size)),
            "rgba": rounded(np.array(shown.rgba)),
            "link": links.index(body) if body else -1,
            "pose": rounded(here),
        }
        if shown.type == mujoco.mjtGeom.mjGEOM_MESH:
            number = int(model.geom_dataid[index])
            meshes.setdefault(number, _mesh(model, number))
            geom["mesh"] = list(meshes).index(number)
        geoms.append(geom)
    return {"geoms": geoms, "meshes": list(meshes.values()), "links": len(links)}


def _mesh(model: Any, number: int) -> dict[str, Any]:
    vertices = slice(model.mesh_vertadr[number], model.mesh_vertadr[number] + model.mesh_vertnum[number])
    faces = slice(model.mesh_faceadr[number], model.mesh_faceadr[number] + model.mesh_facenum[number])
    return {"vertices": rounded(model.mesh_vert[vertices]), "faces": model.mesh_face[faces].tolist()}


def baked_trust(trust: TrustDomain) -> dict[str, Any]:
    """Return the trust domain's positions: a surface of vertices and triangles, and the balls that answers added.

    The surface is empty for a domain that has no place, such as one that trusts everything.
    """
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=int)
    if isinstance(trust, Tube):
        vertices, faces = _surface(trust.middle[:, :3], np.tile(trust.radius[:, :1], 3), trust.known, 2)
    elif isinstance(trust, Box) and trust.shaped:
        half = trust.settings.sigmas * trust.deviation[:, :3]
        vertices, faces = _surface(trust.mean[:, :3], half, trust.known, np.inf)
    balls = [
        {"center": rounded(center[:3]), "radius": rounded(np.array(radius))}
        for center, radius in zip(trust.balls.poses, trust.balls.radii, strict=True)
    ]
    return {"vertices": rounded(vertices), "faces": faces.tolist(), "balls": balls}


def _surface(middle: Array, half: Array, known: np.ndarray, order: float) -> tuple[Array, np.ndarray]:
    """Return vertices (V, 3) and triangles (F, 3) of a tube about a middle (S, 3), left out where nothing is known.

    ``half`` (S, 3) are half widths along x, y and z, ``known`` (S,) says where the tube is. The cross-section is the
    unit ball of the norm of an order: 2 an ellipsoid, infinity a box.
    """
    chosen = np.unique(np.linspace(0, len(middle) - 1, min(len(middle), _RINGS)).round().astype(int))
    # A turn in place has no direction, and no ring of its own.
    moved = np.linalg.norm(np.diff(middle[chosen], axis=0), axis=1) > _LEAST_M
    chosen = chosen[np.append(True, moved)]
    if len(chosen) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=int)
    middle, half, known = middle[chosen], half[chosen], known[chosen]
    tangents = np.gradient(middle, axis=0)
    lengths = np.linalg.norm(tangents, axis=1)
    # A path that turns straight back has no direction there, and keeps the one it came with.
    turned = np.maximum.accumulate(np.where(lengths > _LEAST_M, np.arange(len(lengths)), 0))
    tangents = tangents[turned] / lengths[turned, None]
    half = np.maximum(half, _LEAST_M)
    normal = np.eye(3)[np.abs(tangents[0]).argmin()]
    angles = np.linspace(0.0, 2.0 * np.pi, _RING, endpoint=False)[:, None]
    vertices = []
    for center, widths, tangent in zip(middle, half, tangents, strict=True):
        # Carried along, so that neighbouring rings are not twisted against each other.
        normal = normal - (normal @ tangent) * tangent
        if np.linalg.norm(normal) < _LEAST_M:
            normal = np.cross(tangent, np.eye(3)[np.abs(tangent).argmin()])
        normal /= np.linalg.norm(normal)
        directions = np.cos(angles) * normal + np.sin(angles) * np.cross(tangent, normal)
        vertices.append(center + directions / np.linalg.norm(directions / widths, ord=order, axis=1, keepdims=True))
    faces = []
    for ring in np.flatnonzero(known[:-1] & known[1:]):
        for i in range(_RING):
            a, b = ring * _RING + i, ring * _RING + (i + 1) % _RING
            faces += [(a, b, a + _RING), (b, b + _RING, a + _RING)]
    return np.concatenate(vertices), np.array(faces, dtype=int).reshape(-1, 3)
