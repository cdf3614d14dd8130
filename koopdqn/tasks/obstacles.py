"""Obstacles: what stands in a task's scene besides its own furniture, each with a clearance."""

import re
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, Strict, model_validator

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.settings import FARTHEST_M, Metres3, Settings, Vector3, Vector4, in_metres, plain, shown, validate

if TYPE_CHECKING:
    from koopdqn.robot.scene import SceneBuilder

_NEEDED = {
    "box": ("size_m",),
    "sphere": ("radius_m",),
    "cylinder": ("radius_m", "height_m"),
    "mesh": ("vertices_m",),
}
_MEASURES = ("size_m", "radius_m", "height_m", "vertices_m")
# A convex hull of more corners says nothing that matters for keeping clear, and every artifact holds them.
_MOST_VERTICES = 500
# A floor and a wall reach farther than any arm [m].
_FARTHEST_M = 100.0
_Far3 = Annotated[Vector3, in_metres(_FARTHEST_M)]


class Obstacle(Settings):
    """A thing that stands still in the scene and is kept clear of, drawn and collided with.

    A mesh counts as its convex hull. Where ``file`` names an STL or OBJ file, its hull's corners become ``vertices_m``.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    shape: Literal["box", "sphere", "cylinder", "mesh"]
    center_m: _Far3 = Field(description="in UR Base; of a mesh, the origin of its vertices [m]")
    quaternion: Vector4 = Field(default=(1.0, 0.0, 0.0, 0.0), description="w, x, y, z in UR Base")
    size_m: _Far3 | None = Field(default=None, description="edges of a box [m]")
    radius_m: float | None = Field(default=None, gt=0, le=FARTHEST_M, description="of a sphere or a cylinder [m]")
    height_m: float | None = Field(default=None, gt=0, le=_FARTHEST_M, description="of a cylinder along its z axis [m]")
    file: None = Field(default=None, exclude=True, description="an STL or OBJ file of a mesh, read into vertices_m")
    vertices_m: Annotated[tuple[Metres3, ...], Strict(False)] | None = Field(
        default=None, description="points of a mesh, in its own frame [m]"
    )
    clearance_m: float = Field(default=0.01, ge=0, le=0.5, description="least distance of everything else [m]")

    @model_validator(mode="before")
    @classmethod
    def _read_file(cls, content: Any) -> Any:
        if not isinstance(content, dict) or content.get("file") is None:
            return content
        held = {key: value for key, value in content.items() if key != "file"}
        if held.get("vertices_m") is not None:
            raise ValueError("a mesh must come from file or from vertices_m, found both")
        return {**held, "vertices_m": hull_of_file(Path(str(content["file"])))}

    @model_validator(mode="after")
    def _check_measures(self) -> "Obstacle":
        needed = _NEEDED[self.shape]
        for name in _MEASURES:
            value = getattr(self, name)
            if value is None and name in needed:
                wanted = "file or vertices_m" if name == "vertices_m" else name
                raise ValueError(f"{self.name}: a {self.shape} must have {wanted}, found none")
            if value is not None and name not in needed:
                raise ValueError(f"{self.name}: a {self.shape} must have {' and '.join(needed)} alone, found {name}")
        if self.size_m is not None and min(self.size_m) <= 0:
            raise ValueError(f"{self.name}: size_m must be above 0 along each axis, found {self.size_m}")
        if self.vertices_m is not None and not 4 <= len(self.vertices_m) <= _MOST_VERTICES:
            raise ValueError(
                f"{self.name}: vertices_m must be 4 to {_MOST_VERTICES} points, found {len(self.vertices_m)}"
            )
        if self.vertices_m is not None and _is_flat(np.array(self.vertices_m)):
            raise ValueError(f"{self.name}: vertices_m must not lie in one plane, found {len(self.vertices_m)} that do")
        length = float(np.linalg.norm(self.quaternion))
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"{self.name}: quaternion must have length 1 within 0.001, found {length:g}")
        return self

    def stand_in(self, scene: "SceneBuilder") -> None:
        """Add the obstacle to a scene."""
        size = {
            "box": [0.5 * edge for edge in self.size_m or ()],
            "sphere": [self.radius_m or 0.0],
            "cylinder": [self.radius_m or 0.0, 0.5 * (self.height_m or 0.0)],
            "mesh": [],
        }[self.shape]
        place = pose.make(self.center_m, self.quaternion)
        scene.obstacle(self.name, self.shape, place, size, self.clearance_m, self.vertices_m or ())


def _is_flat(points: np.ndarray) -> bool:
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[-1] <= 1e-6 * max(sizes[0], 1e-9))


def _check_names(obstacles: tuple[Obstacle, ...]) -> tuple[Obstacle, ...]:
    names = [each.name for each in obstacles]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"obstacles must have a name each, found two named {twice}")
    return obstacles


Obstacles = Annotated[tuple[Obstacle, ...], Strict(False), AfterValidator(_check_names)]


_LARGEST_FILE, _MOST_ITEMS = 1_000_000, 100_000


def _written_out(node: Any, known: dict[int, float]) -> float:
    """Return of how many items a node of YAML consists, those of aliases included; no end where it holds itself."""
    if id(node) not in known:
        known[id(node)] = np.inf
        held = node.value if isinstance(getattr(node, "value", None), list) else []
        parts = [part for each in held for part in (each if isinstance(each, tuple) else (each,))]
        known[id(node)] = 1.0 + sum(_written_out(part, known) for part in parts)
    return known[id(node)]


class _File(Settings):
    obstacles: Obstacles


def read_obstacles(path: Path) -> tuple[Obstacle, ...]:
    """Return the obstacles of a YAML file: a list, or a mapping with the key ``obstacles``; mesh files lie beside it.

    Raises:
        BadInputError: the file is missing or no YAML, or an obstacle breaks a rule.
    """
    import yaml
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if not path.is_file():
        raise BadInputError(f"obstacles: must name a YAML file, found no file {str(path)!r}")
    if path.stat().st_size > _LARGEST_FILE:
        raise BadInputError(f"obstacles {path}: must hold at most {_LARGEST_FILE} bytes, found {path.stat().st_size}")
    try:
        text = path.read_text(encoding="utf-8")
        # A few lines of aliases can stand for more than any memory holds.
        if _written_out(yaml.compose(text), {}) > _MOST_ITEMS:
            raise BadInputError(f"obstacles {path}: must hold at most {_MOST_ITEMS} items, aliases written out")
        # Hydra's YAML, in which 3e-2 is a number.
        content: Any = OmegaConf.to_container(OmegaConf.load(StringIO(text)), resolve=False)
    except (yaml.YAMLError, UnicodeDecodeError, OmegaConfBaseException, OSError, RecursionError) as error:
        raise BadInputError(f"obstacles {path}: must be YAML, found {' '.join(str(error).split())}") from error
    if content == {}:
        raise BadInputError(f"obstacles {path}: must be a list, each item a group of keys, found nothing in it")
    found = content if isinstance(content, dict) else {"obstacles": content}
    if "obstacles" not in found:
        raise BadInputError(f"obstacles {path}: must be a list, each item a group of keys, found {shown(content)}")
    items = found["obstacles"]
    if isinstance(items, list):
        found = {**found, "obstacles": [_beside(path, item) for item in items]}
    return checked_obstacles(found)


def checked_obstacles(content: Any) -> tuple[Obstacle, ...]:
    """Return the obstacles of a mapping with the key ``obstacles``, whose mesh files are read.

    Raises:
        BadInputError: an obstacle breaks a rule.
    """
    return validate(plain(content), _File, "").obstacles


def _beside(path: Path, item: Any) -> Any:
    if isinstance(item, dict) and isinstance(item.get("file"), str):
        return {**item, "file": str(path.parent / item["file"])}
    return item


def hull_of_file(path: Path) -> list[list[float]]:
    """Return the corners [m] of the convex hull of an STL or OBJ file, as MuJoCo reads it.

    Raises:
        ValueError: the file is missing or MuJoCo cannot read it.
    """
    import mujoco

    if not path.is_file():
        raise ValueError(f"file must name an STL or OBJ file, found no file {str(path)!r}")
    content = path.read_bytes()
    # A binary one may begin with the same word, but has its length from its number of triangles.
    binary = len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
    if not binary and content.lstrip().startswith(b"solid") and b"facet" in content:
        # STL in text, which MuJoCo does not read.
        corners = [each.split() for each in re.findall(rb"\bvertex\s+(.*)", content)]
        try:
            points = np.array(corners, dtype=float).reshape(len(corners), 3)
        except ValueError as error:
            raise ValueError(f"file must hold three numbers after every vertex, found others in {path}") from error
        return _corners(points)
    spec = mujoco.MjSpec()
    spec.add_mesh(name="mesh", file=str(path.resolve()))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="mesh")
    try:
        model = spec.compile()
    except ValueError as error:
        raise ValueError(f"file must be a mesh that MuJoCo reads, found {' '.join(str(error).split())}") from error
    # MuJoCo moves a mesh to its principal axes.
    points = pose.rotate(model.mesh_quat[0], model.mesh_vert.astype(float)) + model.mesh_pos[0]
    return _corners(points)


def _corners(points: np.ndarray) -> list[list[float]]:
    """Return the corners of the convex hull of points (N, 3).

    Raises:
        ValueError: they are not three numbers each, or lie in one plane.
    """
    from scipy.spatial import ConvexHull

    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all() or _is_flat(points):
        raise ValueError(f"file must hold points of three numbers that do not lie in one plane, found {points.shape}")
    corners = points[ConvexHull(points).vertices]
    return [[round(float(value), 6) for value in corner] for corner in corners]
