"""Preprocessing of recorded demonstrations: trim idle ends, smooth noise, align goals, measure turns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstration
from koopdqn.errors import BadInputError
from koopdqn.paths import arc_lengths, mean_poses, to_count
from koopdqn.pose import Array
from koopdqn.tasks.demonstrated import RotationType

# A demonstration is bent over ten times the distance its end moves, so that its direction changes by some ten degrees
# at most; a short one is bent over its later half.
_BENT = 10.0
# What never goes farther from its start [m] turns in place.
_IN_PLACE_M = 0.01
# How finely turns are compared: shares of the way, and turns from start to goal.
_SHARES, _ANGLES = 100, 200
# So many demonstrations left out in turn tell what a set is like.
_MOST_LEFT_OUT = 50


def goal_of(items: Sequence[Demonstration]) -> Array:
    """Return the mean pose (7,) of demonstrations' ends, the orientation by Markley et al. (2007) from Σ q qᵀ."""
    ends = np.array([item.poses[-1] for item in items])
    quaternions = ends[:, pose.QUATERNION]
    _, vectors = np.linalg.eigh(quaternions.T @ quaternions)
    mean = vectors[:, -1]
    # With the sign of the first end; an eigenvector's is arbitrary.
    return pose.make(ends[:, pose.POSITION].mean(axis=0), mean * (1.0 if mean @ quaternions[0] >= 0 else -1.0))


def way_of(items: Sequence[Demonstration]) -> float:
    """Return the median of how far [m] demonstrations go from their start: for most of them that is their end."""
    return float(np.median([pose.position_distance(item.poses, item.poses[0]).max() for item in items]))


def check_position(items: Sequence[Demonstration], goal: Array, most: float) -> float:
    """Return the largest distance [m] of an end from the goal (7,).

    Raises:
        BadInputError: it is more than ``most`` times how far demonstrations go, or they do nothing but turn.
    """
    way = way_of(items)
    farthest = max(float(pose.position_distance(item.poses, item.poses[0]).max()) for item in items)
    if farthest < _IN_PLACE_M:
        raise BadInputError(
            "demonstrations must go from a start to a goal at another place, found them to turn only in place, never"
            f" more than {farthest * 1e3:.1f} mm from their start"
        )
    apart = [float(pose.position_distance(item.poses[-1], goal)) for item in items]
    worst = int(np.argmax(apart))
    if apart[worst] > most * way:
        raise BadInputError(
            f"demonstration {worst} must end within task.end_spread = {most:g} times the median way of {way:.3f} m of"
            f" the mean of all ends, found {apart[worst]:.3f} m: demonstrations of one task share their goal"
        )
    return apart[worst]


def check_orientation(items: Sequence[Demonstration], goal: Array, most: float) -> None:
    """Raise BadInputError unless every end is turned from the goal (7,) by at most ``most`` [rad]."""
    turned = [float(pose.rotation_distance(item.poses[-1], goal)) for item in items]
    worst = int(np.argmax(turned))
    if turned[worst] > most:
        raise BadInputError(
            f"demonstration {worst} must end within task.end_spread_rad = {most:g} rad of the mean orientation of all"
            f" ends, found {turned[worst]:.3f} rad; task.turning=free leaves orientation out"
        )


def align_goal(item: Demonstration, goal: Array) -> Demonstration:
    """Return a demonstration bent to end at the goal (7,), without its joint angles.

    Poses are moved and turned by a share of the end's offset: a smooth step from 0 to 1 over the last part of the path,
    which is ten times as long as the offset, or half the path if that is shorter.
    """
    offset = goal[pose.POSITION] - item.poses[-1, pose.POSITION]
    arc = arc_lengths(item.poses[:, pose.POSITION])
    length = max(min(_BENT * float(np.linalg.norm(offset)), 0.5 * arc[-1]), 1e-9)
    share = np.clip((arc - (arc[-1] - length)) / length, 0.0, 1.0)
    weight = share**2 * (3.0 - 2.0 * share)
    position = item.poses[:, pose.POSITION] + weight[:, None] * offset
    # A turn has no length along the path, so it is spread over the later half.
    half = np.clip(2.0 * arc / max(arc[-1], 1e-9) - 1.0, 0.0, 1.0)
    turn = pose.to_rotation_vector(
        pose.multiply(goal[pose.QUATERNION], pose.conjugate(item.poses[-1, pose.QUATERNION]))
    )
    bend = pose.from_rotation_vector((half**2 * (3.0 - 2.0 * half))[:, None] * turn)
    poses = pose.make(position, pose.multiply(bend, item.poses[:, pose.QUATERNION]))
    # Exactly at the goal despite rounding.
    sign = 1.0 if poses[-1, pose.QUATERNION] @ goal[pose.QUATERNION] >= 0 else -1.0
    poses[-1] = pose.make(goal[pose.POSITION], sign * goal[pose.QUATERNION])
    return Demonstration(item.times, poses)


STILL_M = 0.001
"""The arm is idle within this distance [m] of its first or last pose; sensor noise widens it."""
STILL_RAD = 0.01
"""The same for rotation [rad]."""
# The median length of a vector of three standard normal components.
_MEDIAN_SIZE = 1.5382
# Width of the noise band of an idle arm in standard deviations (four median lengths of the noise), and the most that
# noise may widen the limits: in a sparse recording motion looks like noise.
_SIGMAS = 4.0 * _MEDIAN_SIZE
_WIDEST = 3.0
_FEWEST = 5


@dataclass(frozen=True)
class Trimmed:
    """A demonstration without its idle ends.

    Attributes:
        item: the rest; its first and last pose are the idle ones.
        before: idle time removed at the start [s].
        after: idle time removed at the end [s].
    """

    item: Demonstration
    before: float
    after: float


def trim_idle(item: Demonstration) -> Trimmed:
    """Return a demonstration without its idle ends.

    The arm is idle while every pose is within :data:`STILL_M` and :data:`STILL_RAD` of the first (or last) one; sensor
    noise of more than a sixth of these limits widens them, up to threefold. One idle sample is kept at each end, next
    to the motion, with the mean pose of the idle samples within the noise.

    Raises:
        BadInputError: nothing moves.
    """
    limits, noise = np.array([STILL_M, STILL_RAD]), _SIGMAS * np.array(noise_of(item))
    distance, turn = np.clip(noise, limits, _WIDEST * limits).tolist()
    first = _still(item.poses, distance, turn) - 1
    last = len(item) - _still(item.poses[::-1], distance, turn)
    if first >= last:
        raise BadInputError(
            f"the arm must move by more than {distance * 1e3:.3g} mm or {np.degrees(turn):.2g}°,"
            " found it standing still"
        )
    poses = item.poses[first : last + 1].copy()
    poses[0], poses[-1] = _rest(item.poses[: first + 1], *noise), _rest(item.poses[last:][::-1], *noise)
    joints = None if item.joints is None else item.joints[first : last + 1]
    before, after = item.times[first] - item.times[0], item.times[-1] - item.times[last]
    return Trimmed(Demonstration(item.times[first : last + 1], poses, joints), float(before), float(after))


def trim_idle_each(items: Sequence[Demonstration]) -> list[Trimmed]:
    """Return demonstrations without their idle ends.

    Raises:
        BadInputError: nothing moves in one; the message names it.
    """
    found = []
    for index, item in enumerate(items):
        try:
            found.append(trim_idle(item))
        except BadInputError as error:
            raise BadInputError(f"demonstration {index}: {error}") from error
    return found


def noise_of(item: Demonstration) -> tuple[float, float]:
    """Return the standard deviations of the sensor noise of positions [m] and of orientations [rad].

    They are estimated by the median size of second differences, on which motion has little effect: for white noise of
    standard deviation σ, each of three components of these has √6·σ, and their size the median 1.538·√6·σ.
    """
    if len(item) < _FEWEST:
        return 0.0, 0.0
    position = np.diff(item.poses[:, pose.POSITION], n=2, axis=0)
    # The quaternion's vector part is half of a small rotation.
    turn = 2.0 * np.diff(item.poses[:, pose.QUATERNION], n=2, axis=0)
    sizes = [float(np.median(np.linalg.norm(values, axis=1))) for values in (position, turn)]
    return sizes[0] / (_MEDIAN_SIZE * np.sqrt(6.0)), sizes[1] / (_MEDIAN_SIZE * np.sqrt(6.0))


def _still(poses: Array, distance: float, turn: float) -> int:
    """Return the number of first poses (N, 7) within distance [m] and turn [rad] of the first one."""
    moved = (pose.position_distance(poses, poses[0]) > distance) | (pose.rotation_distance(poses, poses[0]) > turn)
    return int(moved.argmax()) if moved.any() else len(poses)


def _rest(poses: Array, distance: float, turn: float) -> Array:
    """Return the mean (7,) of the poses (N, 7) within distance [m] and turn [rad] of the first one."""
    near = (pose.position_distance(poses, poses[0]) <= distance) & (pose.rotation_distance(poses, poses[0]) <= turn)
    near[0] = True
    mean = poses[near].mean(axis=0)
    return pose.make(mean[pose.POSITION], mean[pose.QUATERNION])


MOST_SAMPLES = 1000
"""A longer recording is first averaged over runs of samples, down to about so many."""
_FEWEST_SAMPLES = 10
# A component that varies less than this counts as constant [m, 1].
_CONSTANT = 1e-6
# Range of log λ: from no smoothing to waves of some hundred samples.
_LOG_PENALTIES = (-12.0, 18.0)


def smooth(item: Demonstration) -> Demonstration:
    """Return a demonstration whose sensor noise is smoothed out.

    Each component of position and quaternion is the minimiser of ‖y − z‖² + λ‖Δ²z‖² (Whittaker 1923), λ by generalised
    cross-validation (Craven & Wahba 1979). A recording without noise, or of fewer than 10 samples, is not changed.
    Joint angles, which no longer fit, are removed.
    """
    times, poses = _thinned(item.times, item.poses)
    if len(times) < _FEWEST_SAMPLES:
        return item
    values = np.stack([_smooth_component(poses[:, i]) for i in range(poses.shape[1])], axis=1)
    return Demonstration(times, pose.make(values[:, pose.POSITION], values[:, pose.QUATERNION]))


def _smooth_component(values: Array) -> Array:
    from scipy.linalg import solveh_banded
    from scipy.optimize import minimize_scalar

    if np.ptp(values) < _CONSTANT:
        return values
    count = len(values)
    second = difference_bands(count, 2)
    # The eigenvalues of Δ²ᵀΔ² are nearly those with mirrored ends, which are known (Garcia 2010).
    roughness = (2.0 - 2.0 * np.cos(np.pi * np.arange(count) / count)) ** 2

    def penalised(log_penalty: float) -> Array:
        bands = np.exp(log_penalty) * second
        bands[2] += 1.0
        return np.asarray(solveh_banded(bands, values))

    def score(log_penalty: float) -> float:
        penalty = np.exp(log_penalty)
        lost = float((penalty * roughness / (1.0 + penalty * roughness)).sum())
        return float(((values - penalised(log_penalty)) ** 2).sum()) / lost**2

    return penalised(float(minimize_scalar(score, bounds=_LOG_PENALTIES, method="bounded").x))


def difference_bands(count: int, order: int) -> Array:
    """Return the upper diagonals (order + 1, count) of ΔᵀΔ, Δ the differences of that order of ``count`` values.

    They are in the form that ``scipy.linalg.solveh_banded`` takes.
    """
    kernel = np.diff(np.eye(order + 1), n=order, axis=0)[0]
    bands = np.zeros((order + 1, count))
    for offset in range(order + 1):
        for shift, product in enumerate(kernel[: order + 1 - offset] * kernel[offset:]):
            bands[order - offset, offset + shift : count - order + offset + shift] += product
    return bands


def _thinned(times: Array, poses: Array) -> tuple[Array, Array]:
    """Return times (M,) and poses (M, 7) averaged over equal runs of samples, without the first and the last."""
    run = -(-len(times) // MOST_SAMPLES)
    if run == 1:
        return times, poses
    begins = np.arange(1, len(times) - 1, run)
    counts = np.diff([*begins, len(times) - 1])
    inner = [np.add.reduceat(values[:-1], begins, axis=0) for values in (times[:, None], poses)]
    mean_times, mean_poses = (values / counts[:, None] for values in inner)
    return (
        np.concatenate([times[:1], mean_times[:, 0], times[-1:]]),
        np.concatenate([poses[:1], mean_poses, poses[-1:]]),
    )


def rotation_type_of(
    trajectories: Sequence[Array], goal: Array, held_limit: float, *, continuous: bool
) -> RotationType:
    """Return the rotation type of pose trajectories (N, 7) to the goal (7,).

    Held: no pose is turned from the goal by more than ``held_limit`` [rad]. Full: where actions are ``continuous`` and
    the mean turn of the others is nearer to the trajectory left out than what it shows of its own straight turn to the
    goal, which starts that are turned differently keep. Otherwise geodesic: people turn off the geodesic too, but
    Table 1 can follow only the part of the turn toward the goal.
    """
    if largest_turn_from(trajectories, goal) <= held_limit:
        return "held"
    return "full" if continuous and _nearer_in_full(trajectories, goal) else "geodesic"


def _nearer_in_full(trajectories: Sequence[Array], goal: Array) -> bool:
    rows = [to_count(each, _SHARES) for each in trajectories[:_MOST_LEFT_OUT]]
    full = straight = 0.0
    for index, left_out in enumerate(rows):
        mean = mean_poses(rows[:index] + rows[index + 1 :] or rows, _SHARES)
        full += float(pose.rotation_distance(mean, left_out).sum())
        straight += float(pose.rotation_distance(on_straight_turn(mean, left_out[0], goal), left_out).sum())
    return full < straight


def on_straight_turn(wished: Array, start: Array, goal: Array) -> Array:
    """Return poses (N, 7) turned as the straight turn from a start (7,) to a goal (7,) comes nearest to wished ones."""
    angles = np.linspace(0.0, float(pose.rotation_distance(start, goal)), _ANGLES)
    turns = pose.turned_toward(np.tile(start[pose.QUATERNION], (_ANGLES, 1)), goal[pose.QUATERNION], angles)
    # Of unit quaternions the inner product is largest where the angle between them is least.
    nearest = np.abs(wished[:, pose.QUATERNION] @ turns.T).argmax(axis=1)
    return pose.make(wished[:, pose.POSITION], turns[nearest])


def largest_turn_from(trajectories: Sequence[Array], goal: Array) -> float:
    """Return the largest rotation distance [rad] of trajectories (N, 7) from the goal (7,)."""
    return max(float(pose.rotation_distance(trajectory, goal).max()) for trajectory in trajectories)
