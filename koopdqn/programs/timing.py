"""A path of the agent's steps made smooth, and timed under limits of joint speed, acceleration, jerk and tool speed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.preprocess import difference_bands
from koopdqn.errors import WorkFailedError
from koopdqn.pose import Array

# Weight of third differences against distances: left alone it smooths waves of up to some forty steps away.
_PENALTY: Final = 1e6
# Both ends are held by this weight and then set exactly.
_HELD: Final = 1e9
_SMOOTHING_ROUNDS: Final = 400
# What a pose may use of its tolerance before its weight grows, and the least that its weight then grows by.
_USED, _GROWTH = 0.9, 1.05


def smoothed(poses: Array, tolerance: float, rotation_tolerance: float) -> Array:
    """Return poses (N, 7) smoothed, each within ``tolerance`` [m] and ``rotation_tolerance`` [rad] of its own.

    Positions and rotation vectors z minimise Σ w‖z − y‖² + λ‖Δ³z‖² (Whittaker 1923); the weight w of a pose grows
    until it is within tolerance. The first and the last pose stay.

    Raises:
        WorkFailedError: the tolerance is too small to be reached.
    """
    if len(poses) < 4:
        return poses.copy()
    position = _within(poses[:, pose.POSITION], tolerance, "m")
    # Rotation vectors are smooth as long as no pose is half a turn from the middle one.
    middle = poses[len(poses) // 2, pose.QUATERNION]
    turns = pose.to_rotation_vector(pose.multiply(pose.conjugate(middle), poses[:, pose.QUATERNION]))
    turns = _within(turns, rotation_tolerance, "rad")
    quaternion = pose.multiply(middle, pose.from_rotation_vector(turns))
    sign = np.sign((quaternion * poses[:, pose.QUATERNION]).sum(axis=1, keepdims=True))
    made = pose.make(position, sign * quaternion)
    made[[0, -1]] = poses[[0, -1]]
    return made


def _within(values: Array, tolerance: float, unit: str) -> Array:
    """Return rows (N, 3) smoothed, each within the tolerance of its own."""
    from scipy.linalg import solveh_banded

    count = len(values)
    bands = _PENALTY * difference_bands(count, 3)
    weights = np.ones(count)
    weights[[0, -1]] = _HELD
    for _ in range(_SMOOTHING_ROUNDS):
        bands_now = bands.copy()
        bands_now[3] += weights
        # Relative to the first row, so that nothing is lost to the size of the held weights.
        made = values[0] + solveh_banded(bands_now, weights[:, None] * (values - values[0]))
        made[[0, -1]] = values[[0, -1]]
        used = pose.norm(made - values) / tolerance
        if used.max() <= 1.0:
            return np.asarray(made)
        # A tight bend must not be left to one pose alone, so that those near their tolerance are held too.
        weights *= np.where(used > _USED, np.maximum((used / _USED) ** 2, _GROWTH), 1.0)
        weights = np.minimum(weights, _HELD)
    raise WorkFailedError(
        f"the path must be smoothed within {tolerance:g} {unit} of the learned one, found {used.max() * tolerance:g}"
        f" {unit} after {_SMOOTHING_ROUNDS} rounds: allow more with program.tolerance_m or program.tolerance_rad"
    )


# Points of the grid between two rows of the path.
_FINE: Final = 10
# The share of a limit that a path's own bend may use; starting and stopping use the rest.
_BEND: Final = 0.5
_ROUNDS: Final = 200
# What is aimed at, so that numbers rounded when they are written keep the limits too.
_MARGIN: Final = 0.995
_TINY: Final = 1e-12
# More would be hours of motion.
_MOST_SAMPLES: Final = 1_000_000
# Where the flange moves by less than this share of its fastest, the path turns in place.
_TURNING: Final = 0.02

Forward = Callable[[Array], Array]
"""Flange poses (N, 7) of joint angles (N, 6) [rad]."""


@dataclass(frozen=True)
class Limits:
    """What no sample of a motion may exceed.

    Attributes:
        speed: (6,) of the joints [rad/s].
        acceleration: (6,) of the joints [rad/s²].
        jerk: (6,) of the joints [rad/s³].
        tool_speed: of the flange [m/s].
    """

    speed: Array
    acceleration: Array
    jerk: Array
    tool_speed: float

    @property
    def span(self) -> float:
        """How long a joint takes at most to reach its acceleration, or the half of its speed before that [s]."""
        return float(np.minimum(self.acceleration / self.jerk, np.sqrt(self.speed / self.jerk)).max())


@dataclass(frozen=True)
class Motion:
    """Joint angles at even times, at rest before the first and after the last.

    Attributes:
        period: between two samples [s].
        joints: (N, 6) [rad].
        poses: (N, 7) of the flange.
        rows: (N,) how far along the path's rows each sample is.
    """

    period: float
    joints: Array
    poses: Array
    rows: Array

    @property
    def times(self) -> Array:
        """Times (N,) of the samples [s], from 0."""
        return np.asarray(self.period * np.arange(len(self.joints)), dtype=float)

    @property
    def velocities(self) -> Array:
        """Joint speeds (N, 6) [rad/s], by central differences, and at rest in the first and the last sample."""
        rested = _rested(self.joints, 1)
        return _at_rest((rested[2:] - rested[:-2]) / (2.0 * self.period))

    @property
    def accelerations(self) -> Array:
        """Joint accelerations (N, 6) [rad/s²], by central differences, and 0 in the first and the last sample."""
        return _at_rest(np.diff(_rested(self.joints, 1), n=2, axis=0) / self.period**2)

    def used(self, limits: Limits) -> dict[str, Array]:
        """Return the share of each limit that the motion uses between samples, the rest before and after included.

        Differences of the samples over the period, their largest joint; (N + 2 + k,) for k = 1, 2, 3 differences
        fewer.
        """
        rested = _rested(self.joints, 3)
        shares = {}
        for order, (name, most) in enumerate(
            (("speed", limits.speed), ("acceleration", limits.acceleration), ("jerk", limits.jerk)), start=1
        ):
            values = np.abs(np.diff(rested, n=order, axis=0)) / self.period**order
            shares[name] = (values / most).max(axis=1)
        moved = pose.position_distance(self.poses[1:], self.poses[:-1]) / self.period
        shares["tool_speed"] = np.pad(moved / limits.tool_speed, 3)
        return shares


def timed(joints: Array, forward: Forward, limits: Limits, period: float) -> Motion:
    """Return the motion along rows of joint angles (M, 6) [rad], from rest to rest, as fast as the limits allow.

    The path is the quintic spline through the rows. Its parameter gets the largest speed that each limit allows there,
    is sped up and slowed down within the accelerations, and averaged over time, which bounds the jerk. Every sample is
    then checked; where one exceeds a limit, the ceiling there is lowered and all is done again.

    Raises:
        WorkFailedError: the limits cannot be kept.
    """
    path = _Path(joints, forward, limits)
    span = limits.span
    slower = np.ones(len(path.grid))
    worst = np.inf
    for _ in range(_ROUNDS):
        rows = _averaged(*path.along_time(slower), span, period)
        made = Motion(period, path.at(rows), forward(path.at(rows)), rows)
        used = made.used(limits)
        # Slowing down by a factor lowers speed by it, acceleration by its square, jerk by its cube.
        excess = np.zeros(len(rows))
        for name, power in (("speed", 1), ("tool_speed", 1), ("acceleration", 2), ("jerk", 3)):
            share = (used[name] / _MARGIN) ** (1.0 / power)
            # Difference k of order n is about the samples k − 3 … k − 3 + n.
            for shift in range(power + 1):
                at = np.clip(np.arange(len(share)) - 3 + shift, 0, len(rows) - 1)
                np.maximum.at(excess, at, share)
        worst = float(excess.max())
        if worst <= 1.0:
            return made
        slower *= _spread(path.grid, rows, np.maximum(excess, 1.0), int(np.ceil(span / period)))
    raise WorkFailedError(
        f"the motion must keep every limit at every sample, found one exceeded {worst:.3g} times after {_ROUNDS} rounds"
    )


def steady(joints: Array, forward: Forward, limits: Limits) -> tuple[float, float]:
    """Return the speed [m/s] and acceleration [m/s²] of the flange that keep the limits anywhere on rows (M, 6).

    The speed is held all along, as it is by ``movep``.

    Raises:
        WorkFailedError: the path turns in place, or back, somewhere.
    """
    from scipy.interpolate import PchipInterpolator

    path = _Path(joints, forward, limits)
    if path.tool.min() < _TURNING * path.tool.max():
        row = int(path.grid[path.tool.argmin()])
        raise WorkFailedError(
            f"movep needs a path that stops nowhere, found it turning in place, or back, after {row} of"
            f" {len(joints) - 1} steps: program.urscript=servoj writes it"
        )
    # At one speed rows pass evenly that lie evenly along the flange's way, as near together as the nearest of these.
    way = np.append(0.0, np.cumsum(0.5 * (path.tool[1:] + path.tool[:-1]) * np.diff(path.grid)))
    even = np.linspace(0.0, way[-1], 1 + int(np.ceil(way[-1] / path.tool.min())))
    path = _Path(path.at(PchipInterpolator(way, path.grid)(even)), forward, limits)
    return float((path.ceiling * path.tool).min()), float((path.acceleration * path.tool).min())


class _Path:
    """The quintic spline through rows of joint angles and what the limits allow at points of it."""

    def __init__(self, joints: Array, forward: Forward, limits: Limits) -> None:
        from scipy.interpolate import make_interp_spline

        count = len(joints)
        rows = np.arange(count)
        self.at = make_interp_spline(rows, joints, k=min(5, count - 1))
        self.grid = np.linspace(0.0, count - 1.0, _FINE * (count - 1) + 1)
        first, second, third = (np.abs(self.at(self.grid, order)) for order in (1, 2, 3))
        flange = forward(self.at(self.grid))[:, pose.POSITION]
        self.tool = pose.norm(np.gradient(flange, self.grid, axis=0))
        self.ceiling = np.minimum.reduce(
            [
                (limits.speed / np.maximum(first, _TINY)).min(axis=1),
                limits.tool_speed / np.maximum(self.tool, _TINY),
                np.sqrt(_BEND * limits.acceleration / np.maximum(second, _TINY)).min(axis=1),
                np.cbrt(_BEND * limits.jerk / np.maximum(third, _TINY)).min(axis=1),
            ]
        )
        reached = np.minimum(limits.acceleration, limits.jerk * limits.span)
        self.acceleration = ((1.0 - _BEND) * reached / np.maximum(first, _TINY)).min(axis=1)

    def along_time(self, slower: Array) -> tuple[Array, Array]:
        """Return times (G,) [s] at the grid's points (G,), where the limits are lowered by ``slower`` (G,) ≥ 1."""
        step = self.grid[1] - self.grid[0]
        squared = (self.ceiling / slower) ** 2
        gain = 2.0 * step * self.acceleration / slower**2
        squared[[0, -1]] = 0.0
        for i in range(1, len(squared)):
            squared[i] = min(squared[i], squared[i - 1] + min(gain[i - 1], gain[i]))
        for i in range(len(squared) - 2, -1, -1):
            squared[i] = min(squared[i], squared[i + 1] + min(gain[i + 1], gain[i]))
        speed = np.sqrt(squared)
        return np.concatenate([[0.0], np.cumsum(2.0 * step / (speed[1:] + speed[:-1]))]), self.grid


def _averaged(times: Array, grid: Array, span: float, period: float) -> Array:
    """Return where on the grid the motion is at every period, averaged over ``span`` [s] and half of it.

    An average of places moves along the same path, from rest to rest; its jerk is bounded by its span.
    """
    fine = 4
    step = period / fine
    widths = [max(1, round(share * span / step)) for share in (1.0, 0.5)]
    room = sum(widths)
    if times[-1] > _MOST_SAMPLES * period:
        raise WorkFailedError(
            f"the motion must last at most {_MOST_SAMPLES} periods of {period:g} s, found {times[-1]:.3g} s:"
            " program.speed_share, program.tool_speed_m_s, program.acceleration_rad_s2 or"
            " program.jerk_rad_s3 is too low"
        )
    count = int(np.ceil(times[-1] / step)) + 2 * room
    moments = step * (np.arange(count) - room / 2)
    place = np.interp(moments, times, grid)
    for width in widths:
        # Cumulative sums of what is left to go lose nothing in the rest at either end.
        padded = np.concatenate([np.full(width, place[0]), place])
        sums = np.cumsum(padded - place[0])
        place = place[0] + (sums[width:] - sums[:-width]) / width
    sampled = place[::fine]
    moving = np.flatnonzero((sampled > grid[0] + 1e-9) & (sampled < grid[-1] - 1e-9))
    if not len(moving):
        return grid[[0, -1]]
    kept: Array = np.clip(sampled[moving[0] - 1 : moving[-1] + 2], grid[0], grid[-1])
    kept[0], kept[-1] = grid[0], grid[-1]
    return kept


def _spread(grid: Array, rows: Array, factors: Array, reach: int) -> Array:
    """Return factors (G,) on the grid of factors (N,) at samples, the largest of ``reach`` samples either side."""
    from scipy.ndimage import maximum_filter1d

    return np.asarray(np.interp(grid, rows, maximum_filter1d(factors, 2 * reach + 1)))


def _at_rest(values: Array) -> Array:
    """Return values (N, 6) with zeros at both ends, which controllers ask of where a motion ends."""
    values[[0, -1]] = 0.0
    return values


def _rested(joints: Array, count: int) -> Array:
    """Return joint angles with ``count`` samples of rest before and after."""
    return np.concatenate([np.repeat(joints[:1], count, axis=0), joints, np.repeat(joints[-1:], count, axis=0)])
