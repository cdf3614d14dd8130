"""Baselines: methods that learn nothing, from the same starts as a policy, some with K replaced."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.validation import mean_expert
from koopdqn.paths import between, mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.actions import COUNT, nearest_actions, twists_between
from koopdqn.tasks.person import ReferencePath
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, follow, roll_out
from koopdqn.tasks.step import IN_PLACE, TURNS_PER_STEP
from koopdqn.tasks.task import Task, demonstrator_next_poses
from koopdqn.tasks.workcell import Workcell

NextPose = Callable[[Array], Array]
"""Gives the next poses (N, 7) of poses (N, 7), both told in the intent's start frame."""


def nearest_velocity(trajectories: list[Array], task: Task) -> NextPose:
    """Return what moves as the nearest demonstrated pose moved, by its displacement and its turn in the tool's frame.

    Nearest is by position in steps of the agent and by orientation in its turns in place, added as squares. Nothing
    leads back to the demonstrations. Where a demonstration's last pose is nearest, which has no velocity, the goal is
    next. Trajectories are demonstrated poses (N, 7) at the agent's step, told in the start frame.
    """
    from scipy.spatial import KDTree

    before = np.concatenate([rows[:-1] for rows in trajectories])
    after = np.concatenate([rows[1:] for rows in trajectories])
    known = np.concatenate([before, [rows[-1] for rows in trajectories]])
    # Twice the distance of two unit quaternions is the angle between them, to 3 % up to a right angle.
    scale = 2.0 / (IN_PLACE * task.rotation_tolerance_rad)

    def coordinates(poses: Array) -> Array:
        return np.concatenate([poses[:, pose.POSITION] / task.step_m, scale * poses[:, pose.QUATERNION]], axis=1)

    # q and −q are the same rotation.
    opposite = pose.make(known[:, pose.POSITION], -known[:, pose.QUATERNION])
    tree = KDTree(coordinates(np.concatenate([known, opposite])))

    def next_poses(poses: Array) -> Array:
        nearest = tree.query(coordinates(poses))[1] % len(known)
        moving = np.minimum(nearest, len(before) - 1)
        here, there = before[moving], after[moving]
        turn = pose.multiply(pose.conjugate(here[:, pose.QUATERNION]), there[:, pose.QUATERNION])
        onward = pose.make(
            poses[:, pose.POSITION] + there[:, pose.POSITION] - here[:, pose.POSITION],
            pose.multiply(poses[:, pose.QUATERNION], turn),
        )
        return np.where((nearest < len(before))[:, None], onward, task.goal)

    return next_poses


def mean_tangent(trajectories: list[Array], task: Task) -> NextPose:
    """Return what moves along the mean demonstration's direction at its nearest place and turns as that a step further.

    Nearest is by position. Nothing leads back to the mean: from beside it the way runs beside it. Where its end is
    nearest, it has no direction left, and the goal is next. Trajectories are those of :func:`nearest_velocity`.
    """
    from scipy.spatial import KDTree

    mean = ReferencePath.along(mean_poses(trajectories))
    places, last = mean.places, len(mean.places.points) - 1
    tree = KDTree(places.points)

    def next_poses(poses: Array) -> Array:
        position = poses[:, pose.POSITION]
        nearest = tree.query(position)[1]
        direction = places.points[np.minimum(nearest + 1, last)] - places.points[nearest]
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        # Of a turn in place the path has no length.
        ahead = np.minimum(nearest + round(task.step_m / max(places.spacing, 1e-6)), last)
        onward = pose.make(position + task.step_m * direction, mean.quaternions[ahead])
        return np.where((nearest < last)[:, None], onward, task.goal)

    return next_poses


@dataclass(frozen=True)
class Greedy:
    """The controller that always takes the legal action nearest to the intent model's prediction.

    Nearest is by the larger of the two distances in units of their tolerances, as the reward compares.
    The prediction is rescaled to the agent's step; a twist follows it exactly, up to the largest turn. It has learned
    nothing and asks nobody.

    Attributes:
        model: the intent model.
        task: gives actions and tolerances.
        instead: what predicts in K's place, in the model's start frame and with its way of scaling to a step; None
            for the model itself.
        continuous: whether it may take any twist.
    """

    model: IntentModel
    task: Task
    instead: NextPose | None = None
    continuous: bool = False

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions from poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        frame = self.model.start_frame
        if self.instead is None:
            wished = self.model.intended(poses, starts)
        else:
            wished = frame.from_frame(self.instead(frame.to_frame(poses, starts)), starts, poses)
        wished = self.model.to_step(poses, wished, self.task.step_m, starts)
        return _nearest(poses, wished, self.task, self.continuous)


def straight_path(start: Array, end: Array, task: Task) -> Array:
    """Return the poses (T, 7) from a start (7,) straight to an end (7,), turning evenly along the geodesic.

    Its equal steps are as few as keep each within the task's step, and each turn within what a
    demonstration's samples may turn (:func:`koopdqn.intent.fit.agent_steps`). From a pose to itself
    there is no step: T = 1.
    """
    distance, angle = float(pose.position_distance(start, end)), float(pose.rotation_distance(start, end))
    largest_turn = TURNS_PER_STEP * task.rotation_tolerance_rad
    # 1e-9: a distance of exactly n steps must not become n + 1 by rounding.
    count = max(math.ceil(distance / task.step_m - 1e-9), math.ceil(angle / largest_turn - 1e-9))
    shares = np.linspace(0.0, 1.0, count + 1)
    return between(np.tile(start, (count + 1, 1)), np.tile(end, (count + 1, 1)), shares)


def replay_path(start: Array, trajectories: list[Array], task: Task) -> Array:
    """Return the poses (T, 7) of replaying, from a start (7,), the demonstration that begins nearest in position.

    The way leads straight to its first pose, then through its poses (N, 7) as recorded, neither shifted nor scaled.
    """
    nearest = min(trajectories, key=lambda trajectory: float(pose.position_distance(trajectory[0], start)))
    return np.concatenate([straight_path(start, nearest[0], task), nearest[1:]])


def baseline_episodes(
    workcell: Workcell,
    reward: IntentReward,
    trajectories: list[Array],
    starts: Array,
    joints: Array,
    step_limit: int,
    moved: Array | None,
) -> Iterator[tuple[str, list[Episode]]]:
    """Yield the episodes of every method of :class:`koopdqn.evaluation.schema.Baselines`, by its name.

    They begin at starts (N, 7) with joints (N, 6) [rad] and fail after a step limit. Trajectories are demonstrated
    poses (N, 7) at the agent's step; goals may be moved, by ``moved`` (N, 3) [m].
    """
    task, frame = workcell.task, reward.model.start_frame
    placed = frame.each(trajectories)

    def controlled(controller: Controller) -> list[Episode]:
        return roll_out(controller, task, workcell.reachability, starts, joints, step_limit, moved=moved)

    def followed(path: Callable[[Array], Array]) -> list[Episode]:
        return follow([path(start) for start in starts], task, workcell.reachability, joints, moved)

    def best_by_reward(poses: Array, begun: Array) -> np.ndarray:
        evaluation = reward.evaluate_actions(poses, np.zeros(len(poses), dtype=np.int64), begun)
        return reward.taken(evaluation, evaluation.reward)

    def floor(poses: Array, begun: Array) -> np.ndarray:
        return _nearest(poses, demonstrator_next_poses(task, poses, begun), task, reward.continuous)

    def greedy(instead: NextPose | None = None) -> Greedy:
        return Greedy(reward.model.unbent, task, instead, reward.continuous)

    def mean_path(start: Array) -> Array:
        # People who follow their start begin there; the others go to where the mean begins.
        path = frame.laid(mean, start)
        return np.concatenate([straight_path(start, path[0], task), path[1:]])

    yield "straight_line", followed(lambda start: straight_path(start, task.goal, task))
    # Of equals the first.
    yield "constant_action", max((controlled(_always(action)) for action in range(COUNT)), key=_successes)
    yield "greedy", controlled(greedy())
    yield "argmax_reward", controlled(best_by_reward)
    yield "nearest_velocity", controlled(greedy(nearest_velocity(placed, task)))
    yield "mean_tangent", controlled(greedy(mean_tangent(placed, task)))
    yield "mean_pursuit", controlled(greedy(mean_expert(mean_poses(placed), task).next_pose))
    yield "nearest_demonstration", followed(lambda start: replay_path(start, trajectories, task))
    mean = mean_poses(placed)
    yield "mean_demonstration", followed(mean_path)
    yield "floor", controlled(floor)


def _nearest(poses: Array, wished: Array, task: Task, continuous: bool) -> np.ndarray:
    return twists_between(poses, wished, task) if continuous else nearest_actions(poses, wished, task)


def _always(action: int) -> Controller:
    return lambda poses, starts: np.full(len(poses), action)


def _successes(episodes: list[Episode]) -> int:
    return sum(episode.outcome == SUCCESS for episode in episodes)
