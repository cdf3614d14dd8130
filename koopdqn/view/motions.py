"""The motions that a view shows: learned paths, what the intent alone would do, and demonstrations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import WorkFailedError
from koopdqn.evaluation.evaluate import drawn_starts
from koopdqn.evaluation.metrics import reference_paths
from koopdqn.evaluation.schema import EvaluationSettings
from koopdqn.intent.model import IntentModel
from koopdqn.pose import Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.robot.arm import Arm
from koopdqn.tasks.actions import FIRST_TWIST
from koopdqn.tasks.knife import KnifeTask
from koopdqn.tasks.moved_goals import DrawnStarts
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, roll_out
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Reachability, Workcell
from koopdqn.view.bake import frames_of, link_poses, rounded

# Joints of another arm bring this one elsewhere than their poses by more than this [m].
_SAME_PLACE_M = 1e-3

Kind = Literal["learned", "intent", "demonstration"]
"""What made a motion."""


@dataclass(frozen=True)
class Strip:
    """A distance along a motion.

    Attributes:
        name: for people.
        unit: of its values.
        limit: a value that matters, or None.
        values: (T,) at every pose.
    """

    name: str
    unit: str
    limit: float | None
    values: Array


@dataclass(frozen=True)
class Motion:
    """A motion to show.

    Attributes:
        name: for people.
        kind: what made it.
        poses: (T, 7) of the flange.
        joints: (J, 6) [rad] at the first J poses, as far as the arm can follow.
        remark: what became of it.
        strips: distances along it.
        sources: (T,) where the reward of the step to each pose came from, as :mod:`koopdqn.intent.reward` numbers it,
            the first repeated; None where nothing was rewarded.
        edge: (T, 6) middle of a knife's edge [m] and its direction, or None.
        start: number of the held-out start that it begins at, or None.
        run: name of the run whose it is, where runs are compared.
        colour: in which its path is drawn; None: by its sources or kind.
        fails: whether it is a policy's that does not succeed.
    """

    name: str
    kind: Kind
    poses: Array
    joints: Array
    remark: str
    strips: Sequence[Strip]
    sources: np.ndarray | None = None
    edge: Array | None = None
    start: int | None = None
    run: str | None = None
    colour: str | None = None
    fails: bool = False

    def baked(self, workcell_scene: Any) -> dict[str, Any]:
        """Return it as JSON values: frames are the poses shown, ``links`` the arm's in those that it reaches."""
        frames = frames_of(len(self.poses))
        followed = frames[frames < len(self.joints)]
        return {
            **{key: getattr(self, key) for key in ("name", "kind", "remark", "fails", "start", "run", "colour")},
            "frames": frames.tolist(),
            "path": rounded(self.poses[frames, pose.POSITION]),
            "links": [rounded(row.ravel()) for row in link_poses(workcell_scene, self.joints[followed])],
            "sources": None if self.sources is None else self.sources[frames].tolist(),
            "edge": None if self.edge is None else rounded(self.edge[frames]),
            "strips": [
                {"name": s.name, "unit": s.unit, "limit": s.limit, "values": np.round(s.values[frames], 2).tolist()}
                for s in self.strips
            ],
        }


def learned_motions(
    workcell: Workcell,
    policy: Controller,
    feedback: Feedback,
    settings: EvaluationSettings,
    count: int,
    step_limit: int,
    *,
    referred: bool,
) -> list[Motion]:
    """Return the policy's motions from the first held-out starts, each followed by what the intent alone would do.

    Args:
        workcell: task, arm and scene.
        policy: what was learned.
        feedback: says where rewards come from.
        settings: which starts evaluation draws.
        count: how many of them.
        step_limit: steps after which a motion ends.
        referred: whether learned paths are compared with the demonstrator's own.

    Raises:
        BadInputError: hardly any start of the region can be taken.
    """
    task = workcell.task
    drawn = shown_starts(workcell, settings)
    starts, joints = drawn.starts[:count], drawn.joints[:count]
    references = reference_paths(task, starts, step_limit) if referred else [None] * len(starts)
    found = []
    for index, episode in enumerate(roll_out(policy, task, workcell.reachability, starts, joints, step_limit)):
        begun = task.begun(episode.poses)
        actions = policy(episode.poses, begun)
        twists = actions[:, None] if actions.ndim > 1 else None
        evaluation = feedback.evaluate_actions(episode.poses, np.arange(len(begun)), begun, twists)
        taken = evaluation.source[np.arange(len(begun)), actions if actions.ndim == 1 else FIRST_TWIST]
        motion = learned_motion(f"start {index}", episode, task, references[index])
        found.append(replace(motion, sources=np.append(taken[:1], taken[:-1]), start=index))
        wished = intended_path(feedback.reward.model, task, starts[index], step_limit)
        found.append(
            followed(f"intent from start {index}", "intent", wished, workcell.reachability, task, joints[index])
        )
    return found


def shown_starts(workcell: Workcell, settings: EvaluationSettings) -> DrawnStarts:
    """Return the held-out starts with the goal where it was demonstrated, where it is shown even if it moves.

    Raises:
        BadInputError: hardly any start of the region can be taken.
    """
    still = replace(workcell, task=workcell.task.with_still_goal())
    return drawn_starts(still, settings.model_copy(update={"goal": None}))


def learned_motion(name: str, episode: Episode, task: Task, reference: Array | None) -> Motion:
    """Return an episode of a policy as a motion; a reference (R, 7) is the demonstrator's path from its start."""
    remark = "reaches the goal" if episode.outcome == SUCCESS else f"fails: {episode.outcome.replace('_', ' ')}"
    if episode.detail:
        remark += f" ({episode.detail})"
    remark += f" after {episode.steps} steps"
    strips = strips_of(episode.poses, task.goal, task, None if reference is None else reference[:, pose.POSITION])
    edge, fails = edge_of(episode.poses, task), episode.outcome != SUCCESS
    return Motion(name, "learned", episode.poses, episode.joints, remark, strips, edge=edge, fails=fails)


def nearest_motion(motions: Sequence[Motion], start: Array) -> Motion:
    """Return the motion, of those that the arm can begin, that begins nearest to a start (7,).

    Raises:
        WorkFailedError: the arm can begin none.
    """
    begun = [motion for motion in motions if len(motion.joints)]
    if not begun:
        raise WorkFailedError("a film needs a demonstration that the arm can follow, found none")
    return min(begun, key=lambda motion: float(pose.position_distance(motion.poses[0], start)))


def intended_path(model: IntentModel, task: Task, start: Array, step_limit: int) -> Array:
    """Return the poses (T, 7) of following the intent's predictions from a start (7,), a step of the agent each.

    It ends at the goal, where the prediction rests, or at the limit.
    """
    path = model.intended_paths(start[None], step_limit, task.step_m)[:, 0]
    reached = np.flatnonzero(task.arrived(path[1:], task.begun(path)[:-1]))
    return path if not len(reached) else path[: reached[0] + 2]


def demonstrated_motions(
    items: Sequence[Demonstration], reachability: Reachability, task: Task | None, most: int
) -> list[Motion]:
    """Return demonstrations as motions, the first ``most`` of them; of no task each has its own end as its goal."""
    arm = reachability.arm
    return [
        followed(
            f"demonstration {index}", "demonstration", item.poses, reachability, task, known=_own_joints(item, arm)
        )
        for index, item in enumerate(items[:most])
    ]


def _own_joints(item: Demonstration, arm: Arm) -> Array | None:
    """Return a demonstration's joints (T, n) [rad] if they bring this arm where its poses are."""
    if item.joints is None or item.joints.shape[1] != len(arm.joint_names):
        return None
    off = pose.position_distance(arm.forward(item.joints), item.poses).max()
    return item.joints if off < _SAME_PLACE_M else None


def followed(
    name: str,
    kind: Kind,
    poses: Array,
    reachability: Reachability,
    task: Task | None,
    begin: Array | None = None,
    known: Array | None = None,
) -> Motion:
    """Return the motion along given poses (T, 7) of the flange, of a task or of none, the arm as far as it can follow.

    The joints (T, 6) [rad] are those known, or else found, beginning with joints (6,) [rad] or by entering the first
    pose.
    """
    remark, goal = "the arm follows to its end", poses[-1] if task is None else task.goal
    if known is None:
        path, last = reachability.follow_as_far(poses, begin)
        known = np.array(path).reshape(-1, len(reachability.arm.joint_names))
        if last.joints is None:
            why = f"{last.reason.replace('_', ' ')} {last.detail}".strip()
            remark = f"the arm follows {len(path)} of {len(poses)} poses: {why}"
    return Motion(name, kind, poses, known, remark, strips_of(poses, goal, task), None, edge_of(poses, task))


def strips_of(poses: Array, goal: Array, task: Task | None, reference: Array | None = None) -> list[Strip]:
    """Return the distances along poses (T, 7): to the goal, to a reference path (R, 3), and those of a knife."""
    strips = [Strip("to the goal", "mm", None, 1e3 * pose.position_distance(poses, goal))]
    if reference is not None:
        gaps = [np.linalg.norm(reference - row, axis=1).min() for row in poses[:, pose.POSITION]]
        strips.append(Strip("from the demonstrator's own path", "mm", None, 1e3 * np.array(gaps)))
    strips.append(Strip("turn left to the goal", "°", None, np.degrees(pose.rotation_distance(poses, goal))))
    if isinstance(task, KnifeTask):
        safe, near = float(np.degrees(task.safe_angle_rad)), 1e3 * task.rule_distance_m
        strips.append(Strip("edge from straight down", "°", safe, np.degrees(task.blade_angle(poses))))
        strips.append(Strip("blade to the receiver", "mm", near, 1e3 * task.blade_distance(poses)))
    return strips


def edge_of(poses: Array, task: Task | None) -> Array | None:
    """Return the middle (T, 3) [m] of a knife's edge and its direction (T, 3) at poses (T, 7); None without a knife."""
    if not isinstance(task, KnifeTask):
        return None
    direction = pose.rotate(poses[:, pose.QUATERNION], np.array(task.edge))
    middle = np.array([0.0, 0.0, task.blade_start_m + 0.5 * task.blade_length_m])
    point = poses[:, pose.POSITION] + pose.rotate(poses[:, pose.QUATERNION], middle)
    return np.concatenate([point + 0.5 * task.blade_height_m * direction, direction], axis=1)
