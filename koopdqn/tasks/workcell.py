"""The workcell: a task, the arm that does it, the scene it stands in, and which motions the arm can make there."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from koopdqn.errors import BadInputError
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm
from koopdqn.settings import shown
from koopdqn.tasks.task import Task

if TYPE_CHECKING:
    from koopdqn.robot.scene import Scene

COLLISION: Final = "collision"
UNREACHABLE: Final = "unreachable"
JUMP: Final = "posture_jump"
# Reasons to refuse a motion.
REASONS: Final = (UNREACHABLE, JUMP, COLLISION)
# A joint that turns more than this in a step of millimetres [rad] has changed to another solution of the inverse
# kinematics.
_JUMP = 0.5
_EVERY: Final = 6


@dataclass(frozen=True)
class Motion:
    """The result of a motion.

    Attributes:
        joints: joint angles (6,) [rad] after it, or None if it is refused.
        reason: one of :data:`REASONS`, or an empty string.
        detail: the reason in words.
    """

    joints: Array | None
    reason: str = ""
    detail: str = ""


class Reachability:
    """The arm in a scene, moved kinematically.

    Attributes:
        arm: the arm.
        scene: the scene.
        posture: joint angles (6,) [rad]; a path begins with the solution nearest to them.
    """

    def __init__(self, arm: Arm, scene: "Scene", posture: Array | None = None) -> None:
        """Set the parts; a posture of None is the arm's home."""
        self.arm = arm
        self.scene = scene
        self.posture = np.array(arm.home) if posture is None else posture.copy()

    def move(self, pose: Array, joints: Array) -> Motion:
        """Return the result of moving the flange to a pose (7,) from joint angles (6,) [rad] in one step."""
        result = self.arm.inverse(pose, joints)
        if not result.success:
            return Motion(None, UNREACHABLE, result.reason)
        step = np.abs(result.joints - joints)
        worst = int(step.argmax())
        if step[worst] > _JUMP:
            detail = f"{self.arm.joint_names[worst]} would jump by {step[worst]:.3f} rad, most {_JUMP} in a step"
            return Motion(None, JUMP, detail)
        return self._clear(result.joints)

    def move_batch(self, poses: Array, joints: Array) -> list[Motion]:
        """Return the results of N independent motions to poses (N, 7) from joint angles (N, 6) [rad]."""
        found = self.arm.inverse_batch(poses, joints)
        # NaN, of poses without solution, compares false; these and jumps are moved one by one for their reason.
        near = np.abs(found - joints).max(axis=1) <= _JUMP
        return [
            self._clear(found[row]) if near[row] else self.move(poses[row], joints[row]) for row in range(len(poses))
        ]

    def _clear(self, joints: Array) -> Motion:
        """Return the motion to joint angles (6,) [rad], refused if they are in collision."""
        contact = self.scene.contact(joints)
        return Motion(None, COLLISION, contact) if contact else Motion(joints)

    def durations(self, joints: Array) -> Array:
        """Return the durations (T − 1,) [s] of the steps along joint angles (T, 6) [rad], within velocity limits."""
        needed = np.abs(np.diff(joints, axis=0)) / np.array(self.arm.velocity_limits)
        return np.asarray(np.maximum(needed.max(axis=1), self.arm.step_seconds))

    def enter(self, pose: Array) -> Motion:
        """Return the joint angles for beginning at a pose (7,): the collision-free solution nearest to the posture.

        A joint with more than one turn begins in its middle turn, with room to both sides.
        """
        for joints in self.postures(pose):
            return Motion(joints)
        solutions = self.arm.solutions(pose, self.posture)
        if not len(solutions):
            return Motion(None, UNREACHABLE, self.arm.inverse(pose, self.posture).reason)
        return Motion(None, COLLISION, self.scene.contact(solutions[0]))

    def postures(self, pose: Array) -> Iterator[Array]:
        """Yield the joint angles (6,) [rad] at a pose (7,) that touch nothing, the nearest to the posture first."""
        for joints in self.arm.solutions(pose, self.posture):
            if not self.scene.contact(joints):
                yield self._with_room(joints)

    def _with_room(self, joints: Array) -> Array:
        lower, upper = np.array(self.arm.joint_lower), np.array(self.arm.joint_upper)
        middle = 0.5 * (lower + upper)
        wound = middle + (joints - middle + np.pi) % (2.0 * np.pi) - np.pi
        return np.where((wound >= lower) & (wound <= upper), wound, joints)

    def follow(self, poses: Array) -> tuple[Array | None, str]:
        """Return the joint angles (N, 6) [rad] along poses (N, 7) and an empty reason, or None and the reason."""
        joints, motion = self.follow_as_far(poses)
        return (np.array(joints), "") if motion.joints is not None else (None, motion.reason)

    def follow_as_far(self, poses: Array, joints: Array | None = None) -> tuple[list[Array], Motion]:
        """Return the joint angles (6,) [rad] along poses (N, 7) as far as the arm can follow, and the last motion.

        Args:
            poses: to follow; a refused last motion was to the pose after those reached.
            joints: at the first pose; None takes those of :meth:`enter`.
        """
        motion = self.enter(poses[0]) if joints is None else Motion(joints)
        path: list[Array] = []
        for pose in poses[1:]:
            if motion.joints is None:
                break
            path.append(motion.joints)
            motion = self.move(pose, motion.joints)
        return ([*path, motion.joints] if motion.joints is not None else path), motion

    def follows(self, paths: Sequence[Array]) -> bool:
        """Return whether the arm can follow all paths, poses (N, 7) each, in steps of six poses or in all of them.

        Long steps are enough to choose a posture by, and stricter where joints are fast; what touches between them is
        found when the path is followed.
        """
        return all(
            self.follow_as_far(path[::_EVERY])[1].joints is not None or self.follow_as_far(path)[1].joints is not None
            for path in paths
        )

    def flange_poses(self, joints: Array) -> Array:
        """Return the flange's poses (N, 7) at joint angles (N, 6) [rad], by MuJoCo."""
        return np.array([self.scene.flange_pose(row) for row in joints])

    def draw_starts(
        self, task: Task, rng: np.random.Generator, count: int, *, demonstrated: bool = False
    ) -> tuple[Array, Array, int]:
        """Return reachable starts (count, 7) of a task, their joints (count, 6) [rad], and the number of refused draws.

        With ``demonstrated`` they are of where demonstrations begin.

        Raises:
            BadInputError: hardly any start of the region is reachable.
        """
        poses: list[Array] = []
        joints: list[Array] = []
        refused, detail = 0, ""
        while len(poses) < count:
            start = (task.draw_demonstrated_starts if demonstrated else task.draw_starts)(rng, 1)[0]
            motion = self.enter(start)
            if motion.joints is None:
                refused, detail = refused + 1, f"{motion.reason}: {motion.detail}"
                if refused > 50 + 20 * len(poses):
                    raise BadInputError(
                        f"task {task.name}: the arm must be able to take starts of the start region,"
                        f" found {refused} refused of {refused + len(poses)} ({detail})"
                    )
                continue
            poses.append(start)
            joints.append(motion.joints)
        return np.array(poses), np.array(joints), refused

    def check(self, task: Task) -> None:
        """Check that the task's nominal start and goal are reachable with clearance.

        Raises:
            BadInputError: one is not, or the payload is nearer than ``least_clearance_m`` to the scene.
        """
        for name, pose in (("start", task.nominal_start), ("goal", task.goal)):
            motion = self.enter(pose)
            if motion.joints is None:
                raise BadInputError(
                    f"task {task.name}: the {name} at {np.round(pose[:3], 4).tolist()} m must be reachable without"
                    f" collision, found {motion.reason}: {motion.detail}"
                )
            clearance = self.scene.payload_clearance(motion.joints)
            if clearance < task.least_clearance_m:
                raise BadInputError(
                    f"task {task.name}: at the {name} the payload must clear the scene by"
                    f" {task.least_clearance_m * 1e3:g} mm, found {clearance * 1e3:.1f} mm"
                )


@dataclass(frozen=True)
class Workcell:
    """A task, the arm, and the scene.

    Attributes:
        task: the task.
        arm: the arm.
        scene: the compiled MuJoCo scene.
        reachability: of motions in the scene, beginning nearest to the posture at the nominal start.
    """

    task: Task
    arm: Arm
    scene: "Scene"
    reachability: Reachability

    def without_obstacles(self) -> "Workcell":
        """Return the workcell with nothing in its scene but the task's own furniture, as demonstrations knew it."""
        return open_workcell(self.task.without_obstacles(), self.arm) if self.task.obstacles else self


def open_workcell(task: Task, arm: Arm) -> Workcell:
    """Return the workcell of a task and an arm.

    Raises:
        BadInputError: the scene does not compile, the task's start or goal is not reachable in it, or a method of the
            task's class returns what it may not.
    """
    _check_methods(task, arm.step_seconds)
    scene = build_scene(task, arm)
    reachability = reachability_in(scene, task, arm)
    reachability.check(task)
    return Workcell(task, arm, scene, reachability)


def reachability_in(scene: "Scene", task: Task, arm: Arm) -> Reachability:
    """Return the arm in a task's scene, in the posture in which episodes begin.

    That is the one at the nominal start that is nearest to the arm's home, or the nearest in which the arm can follow
    every demonstration that defines the task, if there is one: another elbow may reach where this one does not.
    """
    nearest = Reachability(arm, scene).enter(task.nominal_start).joints
    first = () if nearest is None else (nearest,)
    # Obstacles stand where demonstrations went.
    clear = build_scene(task.without_obstacles(), arm) if task.obstacles and task.demonstrated else scene
    others = Reachability(arm, clear).postures(task.nominal_start)
    for posture in chain(first, (other for other in others if not any(np.array_equal(other, each) for each in first))):
        if Reachability(arm, clear, posture).follows(task.demonstrated):
            return Reachability(arm, scene, posture)
    return Reachability(arm, scene, nearest)


def _check_methods(task: Task, step_seconds: float) -> None:
    """Raise BadInputError if a method of the task's class, along its waypoints, does not return what others count on.

    Otherwise it would be noticed in training, or only in the evaluation after it.
    """
    if task.orientation not in ("held", "learned"):
        raise _returns(task, "orientation", "be 'held' or 'learned', as a property", task.orientation)
    if not isinstance(task.rule, str):
        raise _returns(task, "rule", "be a text, as a property", task.rule)
    share = np.linspace(0.0, 1.0, 101)
    turned = task.turned(share)
    if odd := _odd(turned, share.shape, "fiu", np.isfinite):
        raise _returns(task, "turned", f"return finite shares of shape {share.shape}", *odd)
    path = task.waypoint_path.poses
    broken = task.rule_broken(path)
    broken = np.asarray(broken) if isinstance(broken, list | tuple) else broken
    if odd := _odd(broken, (len(path),), "biu", lambda values: (values == 0) | (values == 1)):
        raise _returns(task, "rule_broken", f"return booleans of shape {(len(path),)}, one a pose", *odd)
    following = task.demonstrator.next_pose(path)
    if odd := _odd(following, path.shape, "f", np.isfinite):
        raise _returns(task, f"person {task.person.name}", "aim at finite positions, one a pose", *odd)
    measures = task.measures(path, step_seconds)
    values = measures.values() if isinstance(measures, Mapping) else [None]
    if not all(_is_array(np.asarray(each), (), "biuf") for each in values):
        raise _returns(task, "measures", "return a dict of a number by each name", measures)


def _is_array(found: object, shape: tuple[int, ...], kinds: str) -> bool:
    return isinstance(found, np.ndarray) and found.shape == shape and found.dtype.kind in kinds


def _odd(found: Any, shape: tuple[int, ...], kinds: str, sound: Callable[[Array], np.ndarray]) -> list[Any]:
    """Return what is found if it is no such array, or the first of its values that is not sound; else nothing."""
    return list(found[~sound(found)][:1].tolist()) if _is_array(found, shape, kinds) else [found]


def _returns(task: Task, name: str, rule: str, found: object) -> BadInputError:
    array = f"an array of {found.dtype} of shape {found.shape}" if isinstance(found, np.ndarray) else None
    return BadInputError(f"task {task.name}: {name} must {rule}, found {array or shown(found)}")


def build_scene(task: Task, arm: Arm) -> "Scene":
    """Return the scene of a task with an arm.

    Raises:
        BadInputError: MuJoCo refuses the scene, or the payload cannot stand clear at start and goal.
    """
    # MuJoCo takes a while to load, and who only reads settings needs none.
    from koopdqn.robot.scene import SceneBuilder

    try:
        builder = SceneBuilder(arm)
        task.furnish(builder)
        for obstacle in task.obstacles:
            obstacle.stand_in(builder)
        return builder.build()
    # MJCF that is no XML raises SyntaxError, an element that dm_control does not know KeyError.
    except (ValueError, SyntaxError, KeyError) as error:
        found = " ".join(str(error).split())
        raise BadInputError(f"the scene of task {task.name} must compile in MuJoCo, which says: {found}") from error
