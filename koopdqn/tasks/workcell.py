"""The workcell: a task, the arm that does it, and the scene it stands in."""

from dataclasses import dataclass

from koopdqn.errors import BadInputError
from koopdqn.robot.arm import Arm
from koopdqn.robot.scene import Scene, SceneBuilder
from koopdqn.tasks.reachability import Reachability
from koopdqn.tasks.task import Task


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
    scene: Scene
    reachability: Reachability


def open_workcell(task: Task, arm: Arm) -> Workcell:
    """Return the workcell of a task and an arm.

    Raises:
        BadInputError: the scene does not compile, or the task's start or goal is not reachable in it.
    """
    scene = build_scene(task, arm)
    posture = Reachability(arm, scene, arm.step_seconds).enter(task.nominal_start).joints
    reachability = Reachability(arm, scene, arm.step_seconds, posture)
    reachability.check(task)
    return Workcell(task, arm, scene, reachability)


def build_scene(task: Task, arm: Arm) -> Scene:
    """Return the scene of a task with an arm.

    Raises:
        BadInputError: MuJoCo refuses the scene, or the payload cannot stand clear at start and goal.
    """
    try:
        builder = SceneBuilder(arm)
        task.furnish(builder)
        return builder.build()
    # MJCF that is no XML raises SyntaxError.
    except (ValueError, SyntaxError) as error:
        found = " ".join(str(error).split())
        raise BadInputError(f"the scene of task {task.name} must compile in MuJoCo, which says: {found}") from error
