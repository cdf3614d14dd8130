"""Scenes: an arm, what it holds and what stands around it, composed with dm_control and run by MuJoCo."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
from dm_control import mjcf

from koopdqn import pose
from koopdqn.errors import BadInputError, unknown_name
from koopdqn.pose import Array
from koopdqn.resources import asset_path
from koopdqn.robot.arm import Arm
from koopdqn.robot.model import driven_joints
from koopdqn.settings import shown

_ARENA = "arena.xml"
_FLOOR = "floor"
_TOOL = "tool"
_OBSTACLE_NAMES = "obstacle_"
_OBSTACLE = (0.85, 0.45, 0.10, 1.0)


class SceneBuilder:
    """Composes a scene: an arm at the world's origin (its base frame is the world frame), a tool, furniture."""

    def __init__(self, arm: Arm) -> None:
        """Start a scene with the arena and the arm, loaded from the arm's MJCF file."""
        self.arm = arm
        self._arena = mjcf.from_path(str(asset_path(_ARENA)))
        self._robot = _read(arm.mjcf)
        # A keyframe's numbers would be given to the wrong joints if another joint came before the arm's.
        for key in self._robot.find_all("key"):
            key.remove()
        _spare_mounting(self._robot)
        for part in ("option", "statistic", "visual"):
            _yield(getattr(self._robot, part), getattr(self._arena, part))
        for name, position in getattr(arm, "link_positions", {}).items():
            self._named("body", name).pos = position
        self._arena.attach(self._robot)
        self._tool = mjcf.RootElement(model=_TOOL)
        # A controller that knows its payload carries its weight, as a real UR does.
        self._grip = self._tool.worldbody.add("body", name="grip", gravcomp=1)
        self.floor_height = float(self._arena.find("geom", _FLOOR).pos[2])

    def furniture_box(
        self, name: str, center: Sequence[float], half_size: Sequence[float], rgba: Sequence[float]
    ) -> None:
        """Add a box that stands still: center and half sizes (3,) [m] in the world.

        Raises:
            BadInputError: a number is not finite, or a size not positive; so do the three below.
        """
        _check_numbers(name, center=center, half_size=half_size)
        self._arena.worldbody.add("geom", name=name, type="box", pos=center, size=half_size, rgba=rgba)

    def furniture_capsule(
        self, name: str, start: Sequence[float], end: Sequence[float], radius: float, rgba: Sequence[float]
    ) -> None:
        """Add a capsule that stands still, between two points (3,) [m] in the world."""
        _check_numbers(name, start=start, end=end, radius=radius)
        ends = [*start, *end]
        self._arena.worldbody.add("geom", name=name, type="capsule", fromto=ends, size=[radius], rgba=rgba)

    def tool_box(
        self,
        name: str,
        center: Sequence[float],
        half_size: Sequence[float],
        rgba: Sequence[float],
        mass: float,
        payload: bool = False,
    ) -> None:
        """Add a box to the tool: center and half sizes (3,) [m] in the flange frame, mass [kg]."""
        _check_numbers(name, center=center, half_size=half_size, mass=mass)
        self._grip.add(
            "geom", name=_tool_name(name, payload), type="box", pos=center, size=half_size, rgba=rgba, mass=mass
        )

    def tool_cylinder(
        self,
        name: str,
        start: Sequence[float],
        end: Sequence[float],
        radius: float,
        rgba: Sequence[float],
        mass: float,
        payload: bool = False,
    ) -> None:
        """Add a cylinder to the tool, between two points (3,) [m] in the flange frame, mass [kg]."""
        _check_numbers(name, start=start, end=end, radius=radius, mass=mass)
        ends = [*start, *end]
        self._grip.add(
            "geom", name=_tool_name(name, payload), type="cylinder", fromto=ends, size=[radius], rgba=rgba, mass=mass
        )

    def obstacle(
        self,
        name: str,
        shape: Literal["box", "sphere", "cylinder", "mesh"],
        pose: Array,
        size: Sequence[float],
        clearance: float,
        vertices: Sequence[Sequence[float]] = (),
    ) -> None:
        """Add an obstacle that stands still and counts as touched by what is nearer than its clearance [m].

        Args:
            name: of the obstacle; the scene tells it from furniture.
            shape: of the obstacle; of a mesh it is the convex hull.
            pose: (7,) in the world.
            size: [m] half the edges of a box; a sphere's radius; a cylinder's radius and half its height.
            clearance: least distance [m] of anything else.
            vertices: (V, 3) [m] of a mesh, in the obstacle's own frame.
        """
        name = f"{_OBSTACLE_NAMES}{name}"
        if shape == "mesh":
            flat = " ".join(f"{value:.9g}" for vertex in vertices for value in vertex)
            self._arena.asset.add("mesh", name=name, vertex=flat)
        form = {"mesh": name} if shape == "mesh" else {"size": size}
        # With a gap MuJoCo reports what is near, and nothing is pushed away before it touches.
        place = {"pos": pose[:3], "quat": pose[3:], "gap": clearance}
        self._arena.worldbody.add("geom", name=name, type=shape, rgba=_OBSTACLE, **form, **place)

    def build(self) -> "Scene":
        """Compile the scene.

        Raises:
            BadInputError: the arm's MJCF file lacks a site or joint that the arm names, or a joint's actuator.
            ValueError: MuJoCo refuses the scene.
        """
        site = self._named("site", self.arm.flange_site)
        for name in self.arm.joint_names:
            self._named("joint", name)
        driven = [actuator.joint.name for actuator in self._robot.find_all("actuator") if actuator.joint]
        undriven = sorted(set(self.arm.joint_names) - set(driven))
        if undriven:
            raise BadInputError(f"{self.arm.asset} must have an actuator for every joint, found none for {undriven[0]}")
        site.attach(self._tool)
        root = self._arena.root_model
        model = mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())
        return Scene(model, self.arm, prefix=f"{self._robot.model}/")

    def _named(self, kind: str, name: str) -> Any:
        found = self._robot.find(kind, name)
        if found is None:
            known = [element.name for element in self._robot.find_all(kind)]
            raise unknown_name(f"{kind} of {self.arm.asset}", name, known)
        return found


def _read(path: Path) -> Any:
    """Return an arm's MJCF file in radians, as the arena is: dm_control puts both together and converts nothing."""
    spec = mujoco.MjSpec.from_file(str(path))
    if not spec.compiler.degree:
        return mjcf.from_path(str(path))
    # What was compiled is written in radians.
    spec.compile()
    return mjcf.from_xml_string(spec.to_xml(), model_dir=str(path.parent))


def _yield(own: Any, arena: Any) -> None:
    """Take out of an element of the arm's file what the arena's sets too: its view, lights and integrator count."""
    for name in arena.get_attributes().keys() & own.get_attributes().keys():
        delattr(own, name)
    for part in arena.all_children():
        _yield(getattr(own, part.tag), part)


def _spare_mounting(robot: Any) -> None:
    """Let a first moving link touch what it is mounted on, as MuJoCo lets any other two neighbours."""
    mounts = list(robot.worldbody.all_children())
    while mounts:
        mount = mounts.pop()
        if mount.tag != "body" or mount.find_all("joint", immediate_children_only=True):
            continue
        for body in mount.find_all("body", immediate_children_only=True):
            if body.find_all("joint", immediate_children_only=True):
                robot.contact.add("exclude", body1=mount, body2=body)
            else:
                mounts.append(body)


def _check_numbers(name: str, **quantities: float | Sequence[float]) -> None:
    """Raise BadInputError if a quantity of a thing is not finite: MuJoCo takes NaN, and then collides with nothing."""
    for quantity, value in quantities.items():
        numbers = np.asarray(value, dtype=float)
        if not np.isfinite(numbers).all():
            raise BadInputError(f"the scene's {name}: {quantity} must be finite, found {shown(value)}")
        if quantity in ("half_size", "radius") and not (numbers > 0).all():
            raise BadInputError(f"the scene's {name}: {quantity} must be above 0, found {shown(value)}")


def _tool_name(name: str, payload: bool) -> str:
    return f"payload_{name}" if payload else name


_MIDPHASE = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)


class Scene:
    """A compiled scene. It answers for joint angles: where is the flange, and does anything touch?

    Attributes:
        model: the MuJoCo model.
        data: the MuJoCo state that the questions below overwrite.
        arm: the arm in it.
    """

    def __init__(self, model: Any, arm: Arm, prefix: str) -> None:
        """Wrap a compiled model in which the arm's names carry a prefix."""
        self.model = model
        self.data = mujoco.MjData(model)
        self.arm = arm
        self.joint_index = np.array([model.joint(prefix + name).qposadr[0] for name in arm.joint_names])
        self.velocity_index = np.array([model.joint(prefix + name).dofadr[0] for name in arm.joint_names])
        driven = driven_joints(model)
        self.actuator_index = np.array([driven.index(model.joint(prefix + name).id) for name in arm.joint_names])
        self._qpos = self.data.qpos
        first, last = int(self.joint_index[0]), int(self.joint_index[-1])
        in_order = self.joint_index.tolist() == list(range(first, last + 1))
        # A slice is set in a third of the time that an index takes.
        self._joints: slice | np.ndarray = slice(first, last + 1) if in_order else self.joint_index
        self._site = model.site(prefix + arm.flange_site).id
        names = [model.geom(i).name for i in range(model.ngeom)]
        self._payload = [i for i, name in enumerate(names) if "payload_" in name]
        self._fixed = [i for i in range(model.ngeom) if model.geom_bodyid[i] == 0 and model.geom_contype[i]]
        self._furniture = [i for i in self._fixed if names[i] != _FLOOR]
        self._obstacles = {i for i in self._fixed if names[i].startswith(_OBSTACLE_NAMES)}
        # Of every geom, the distance [m] nearer than which it counts as touched.
        self._clearances = model.geom_gap.copy()
        self._clears = bool(self._clearances.any())

    @cached_property
    def reach(self) -> float:
        """A distance [m] from the base's origin that the flange never exceeds: its links' lengths laid end to end."""
        body = int(self.model.site_bodyid[self._site])
        length = float(np.linalg.norm(self.model.site_pos[self._site]))
        while body:
            length += float(np.linalg.norm(self.model.body_pos[body]))
            body = int(self.model.body_parentid[body])
        return length

    def link_points(self, joints: Array) -> Array:
        """Return where the bodies of the arm begin (B, 3) [m], from the base to the flange, at joint angles (6,)."""
        self.place(joints)
        body, points = int(self.model.site_bodyid[self._site]), [self.data.site_xpos[self._site].copy()]
        while body:
            points.append(self.data.xpos[body].copy())
            body = int(self.model.body_parentid[body])
        return np.array(points[::-1])

    def place(self, joints: Array) -> None:
        """Set the arm to joint angles (6,) [rad] and update where everything is."""
        self._qpos[self._joints] = joints
        mujoco.mj_kinematics(self.model, self.data)

    def flange_pose(self, joints: Array) -> Array:
        """Return the flange's pose (7,) at joint angles (6,) [rad], by MuJoCo's forward kinematics."""
        self.place(joints)
        matrix = self.data.site_xmat[self._site].reshape(3, 3)
        return pose.make(self.data.site_xpos[self._site], pose.from_matrix(matrix))

    def contact(self, joints: Array) -> str:
        """Return which two things touch at joint angles (6,) [rad], as "a with b", or an empty string."""
        self.place(joints)
        mujoco.mj_collision(self.model, self.data)
        return self.current_contact()

    def current_contact(self) -> str:
        """Return which two things touch in the present state of ``data``, or an empty string."""
        if not self.data.ncon:
            return ""
        for contact in self.data.contact:
            if contact.dist < (self._clearances[contact.geom].max() if self._clears else 0.0):
                first, second = (self.thing(int(geom)) for geom in contact.geom)
                return f"{first} with {second}"
        return ""

    def rooms(self, joints: Array, most: float) -> tuple[float, float]:
        """Return how much nearer [m] the arm may come to obstacles and to anything else at joint angles (6,) [rad].

        At most ``most`` each. Negative where something touches, or is nearer to an obstacle than its clearance.
        """
        self.place(joints)
        self.model.geom_gap[self._fixed] = self._clearances[self._fixed] + most
        # Its trees of boxes are made when the model is compiled, with the gaps of then.
        self.model.opt.disableflags |= _MIDPHASE
        mujoco.mj_collision(self.model, self.data)
        self.model.opt.disableflags &= ~_MIDPHASE
        self.model.geom_gap[self._fixed] = self._clearances[self._fixed]
        rooms = [most, most]
        for contact in self.data.contact if self.data.ncon else ():
            first, second = contact.geom
            of = int(not (first in self._obstacles or second in self._obstacles))
            rooms[of] = min(rooms[of], contact.dist - max(self._clearances[first], self._clearances[second]))
        return rooms[0], rooms[1]

    def thing(self, geom: int) -> str:
        """Return a name for people of a geom: its own, or its body's if it has none."""
        name = self.model.geom(geom).name.rsplit("/", 1)[-1]
        # dm_control names what has no name.
        if not name or name.startswith("unnamed_geom_"):
            name = self.model.body(self.model.geom_bodyid[geom]).name.rsplit("/", 1)[-1]
        return str(name.removeprefix("payload_"))

    def payload_clearance(self, joints: Array, at_most: float = 0.2) -> float:
        """Return the least distance [m] between payload and furniture at joints (6,) [rad], capped at ``at_most``."""
        self.place(joints)
        segment = np.zeros(6)
        return min(
            (
                mujoco.mj_geomDistance(self.model, self.data, mine, theirs, at_most, segment)
                for mine in self._payload
                for theirs in self._furniture
            ),
            default=at_most,
        )
