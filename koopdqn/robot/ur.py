"""Closed-form kinematics of the Universal Robots family.

All arms of the family share one geometry: joints 2, 3 and 4 are parallel, and the wrist offsets
d4, d5, d6 are at right angles, so that six numbers of the Denavit–Hartenberg table (d1, a2, a3,
d4, d5, d6) tell them apart. The inverse has up to eight branches: two for the shoulder, two for
the wrist, two for the elbow. The frames and signs are those of Hawkins, "Analytic Inverse
Kinematics for the Universal Robots UR-5/UR-10 Arms" (2013), and of the maker's own DH table.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from pydantic import model_validator

from koopdqn.pose import Array, normalized
from koopdqn.resources import asset_path
from koopdqn.robot.arm import TURN, InverseResult, check_limits, unwrapped, unwrapped_batch
from koopdqn.settings import Line, Name, Names, Positive, Settings, Vector6

Scalars = tuple[float, ...]
"""Joint angles (6,) [rad], or a pose (7,): x, y, z [m] and the unit quaternion w, x, y, z. Faster than arrays here."""


def pose_scalars(pose: ArrayLike) -> Scalars:
    """Return the seven numbers of a pose, its quaternion scaled to unit length."""
    x, y, z, qw, qx, qy, qz = _scalars(pose, 7, "a pose", "")
    length = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    if length <= 1e-12:
        raise ValueError(f"a pose must have a quaternion longer than 1e-12, found {[qw, qx, qy, qz]}")
    return x, y, z, qw / length, qx / length, qy / length, qz / length


def _scalars(values: ArrayLike, count: int, name: str, unit: str) -> Scalars:
    array = np.asarray(values, dtype=float)
    if array.shape != (count,):
        raise ValueError(f"{name} must have shape ({count},), found {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, found {array.tolist()}{unit}")
    return tuple(array.tolist())


_REACH_SLACK: Final = 1e-9
"""How far rounding may push the argument of an arc cosine beyond ±1."""
_SINGULAR_SINE: Final = 1e-7
"""|sin q5| below which the axes of joints 4 and 6 count as parallel, and q6 is the seed's."""

# No arm of that family comes near it; longer ones, squared, leave the numbers.
_LONGEST_M = 10.0


class URArm(Settings):
    """An arm of the UR family, given by its DH numbers [m] and its limits; an :class:`koopdqn.robot.arm.Arm`.

    The base frame is the maker's "Base" (the DH frame: ROS ``base_link`` turned by π about z), the
    flange frame is DH frame 6 (``tool0``), z outward. Attributes are as in ``Arm``.

    Attributes:
        d1: height [m] of the shoulder axis above the base.
        a2: length [m] of the upper arm along its x axis, negative.
        a3: length [m] of the forearm along its x axis, negative.
        d4: offset [m] of the wrist from the plane of the shoulder.
        d5: offset [m] between the axes of joints 4 and 6.
        d6: offset [m] of the flange from the axis of joint 5.

    Raises:
        ValueError: on construction, a2 or a3 is zero, a length is over 10 m, the joints have not six different names,
            a range of angles is empty or does not hold home, or a speed or torque limit is not positive.
    """

    name: Line
    asset: Name
    joint_names: Names
    flange_site: Name
    d1: float
    a2: float
    a3: float
    d4: float
    d5: float
    d6: float
    joint_lower: Vector6
    joint_upper: Vector6
    velocity_limits: Vector6
    torque_limits: Vector6
    home: Vector6
    step_seconds: Positive
    # Runs of before this key existed were on the tasks as they are.
    task_scale: Positive = 1.0

    @model_validator(mode="after")
    def _check(self) -> "URArm":
        for key, length in (("a2", self.a2), ("a3", self.a3)):
            if length >= 0.0:
                raise ValueError(f"{key}: must be below 0 m, as in the maker's table, found {length}")
        for key in ("d1", "a2", "a3", "d4", "d5", "d6"):
            if abs(getattr(self, key)) > _LONGEST_M:
                raise ValueError(f"{key}: must be within {_LONGEST_M:g} m, found {getattr(self, key)}")
        if len(set(self.joint_names)) != 6 or len(self.joint_names) != 6:
            raise ValueError(f"joint_names: must be 6 different names, found {list(self.joint_names)}")
        check_limits(self)
        return self

    @property
    def mjcf(self) -> Path:
        """Path of the arm's MJCF file; BadInputError if it is not installed."""
        return asset_path(self.asset)

    @property
    def link_positions(self) -> dict[str, tuple[float, float, float]]:
        """Positions [m] of the MJCF file's bodies by the Denavit–Hartenberg table."""
        return {
            "shoulder_link": (0.0, 0.0, self.d1),
            "forearm_link": (self.a2, 0.0, 0.0),
            "wrist_1_link": (self.a3, 0.0, self.d4),
            "wrist_2_link": (0.0, -self.d5, 0.0),
            "wrist_3_link": (0.0, self.d6, 0.0),
        }

    def forward(self, joints: ArrayLike) -> Array:
        """Return the flange poses (..., 7) in Base of joint angles (..., 6) [rad].

        Raises:
            ValueError: the last axis does not hold six angles.
        """
        joints = np.asarray(joints, dtype=float)
        if joints.ndim == 0 or joints.shape[-1] != 6:
            raise ValueError(f"joints must have shape (..., 6), found {joints.shape}")
        return np.stack(self._flange(np.moveaxis(joints, -1, 0), np.cos, np.sin), axis=-1)

    def inverse(self, pose: ArrayLike, seed: ArrayLike) -> InverseResult:
        """Return the joint angles that bring the flange to ``pose`` (7,) in Base, nearest ``seed`` (6,) [rad].

        Of all branches and whole turns within the joint limits it takes the one whose largest joint
        step from the seed is smallest, then the one with the smallest norm. Where the next value of
        a joint would pass its limit, the solution comes back a whole turn away: callers that
        follow a path check the step.

        Where |sin q5| < 1e-7 the pose no longer determines q6 apart from q2, q3, q4: q6 is then
        as near the seed's as the elbow's reach allows, and the residual may reach 1e-7 rad.
        Elsewhere the residuals are rounding alone, under 1e-9.

        A pose that cannot be reached gives ``success`` False and a reason, never an exception.

        Raises:
            ValueError: the pose or the seed has a wrong shape, is not finite, or the quaternion has no length.
        """
        target, near = pose_scalars(pose), _joint_scalars(seed)
        misses: list[float] = []
        best: list[float] | None = None
        best_step = best_norm = math.inf
        lower, upper = self.joint_lower, self.joint_upper
        for branch in self._branches(target, near, misses):
            step = norm = 0.0
            joints: list[float] = []
            for angle, start, low, high in zip(branch, near, lower, upper, strict=True):
                nearest = unwrapped(angle, start, low, high)
                if nearest is None:
                    break
                joints.append(nearest)
                difference = abs(nearest - start)
                if difference > step:
                    if difference > best_step:
                        break
                    step = difference
                norm += difference * difference
            else:
                if step < best_step or norm < best_norm:
                    best, best_step, best_norm = joints, step, norm
        answer = np.array(best or near)
        answer.setflags(write=False)
        reason = self._why_not(target, near, misses) if best is None else ""
        return InverseResult(answer, best is not None, reason)

    def inverse_batch(self, poses: ArrayLike, seeds: ArrayLike) -> Array:
        """Return for each of N poses (N, 7) in Base the joint angles that :meth:`inverse` finds from its seed (N, 6).

        Rows (N, 6) [rad]; NaN where :meth:`inverse` has no success, which then says why.

        Raises:
            ValueError: poses or seeds have a wrong shape, are not finite, or a quaternion has no length.
        """
        poses, seeds = np.asarray(poses, dtype=float), np.asarray(seeds, dtype=float)
        if poses.ndim != 2 or poses.shape[1] != 7 or seeds.shape != (len(poses), 6):
            raise ValueError(f"poses and seeds must have shapes (N, 7) and (N, 6), found {poses.shape}, {seeds.shape}")
        if not (np.isfinite(poses).all() and np.isfinite(seeds).all()):
            raise ValueError("poses and seeds must be finite, found NaN or infinity")
        near = seeds.T[:, None]
        # What is out of reach has no arc cosine, and a wrist on the base axis no bearing.
        with np.errstate(invalid="ignore", divide="ignore"):
            branches, singular = self._branches_of(poses[:, :3], normalized(poses[:, 3:]))
            branches, within = unwrapped_batch(branches, near, self.joint_lower, self.joint_upper)
            differences = np.abs(branches - near)
            steps = np.where(within.all(axis=0), differences.max(axis=0), np.inf)
            norms = np.where(steps == steps.min(axis=0), (differences**2).sum(axis=0), np.inf)
        best, rows = norms.argmin(axis=0), np.arange(len(poses))
        joints = np.where(np.isfinite(steps[best, rows]), branches[:, best, rows], np.nan).T
        # Rare, and another computation: there q6 follows the seed.
        for row in np.flatnonzero(singular):
            found = self.inverse(poses[row], seeds[row])
            joints[row] = found.joints if found.success else np.nan
        return joints

    def solutions(self, pose: ArrayLike, seed: ArrayLike | None = None) -> Array:
        """Return all solutions (k, 6) [rad], k ≤ 8, that bring the flange to ``pose`` (7,) in Base within the limits.

        There is one row a branch, unwrapped to lie nearest ``seed`` (home if None), nearest row
        first by largest joint step. Where q5 is singular, q6 follows the seed, as in :meth:`inverse`.

        Raises:
            ValueError: the pose or the seed has a wrong shape, is not finite, or the quaternion has no length.
        """
        near = self.home if seed is None else _joint_scalars(seed)
        found: list[list[float]] = []
        for branch in self._branches(pose_scalars(pose), near, []):
            candidates = map(unwrapped, branch, near, self.joint_lower, self.joint_upper)
            joints = [angle for angle in candidates if angle is not None]
            if len(joints) == 6:
                found.append(joints)
        found.sort(key=lambda joints: max(abs(angle - start) for angle, start in zip(joints, near, strict=True)))
        return np.array(found).reshape(-1, 6)

    def _flange(self, joints: Iterable[Any], cos: Callable[[Any], Any], sin: Callable[[Any], Any]) -> tuple[Any, ...]:
        """Return x, y, z [m] and the quaternion w, x, y, z of the flange, for numbers and for arrays alike."""
        q1, q2, q3, q4, q5, q6 = joints
        q23 = q2 + q3
        q234 = q23 + q4
        c1, s1, c234, s234, c5, s5 = cos(q1), sin(q1), cos(q234), sin(q234), cos(q5), sin(q5)
        # In frame 1: x forward in the arm's plane, y up, z out of the plane.
        x1 = self.a2 * cos(q2) + self.a3 * cos(q23) + self.d5 * s234 - self.d6 * s5 * c234
        y1 = self.a2 * sin(q2) + self.a3 * sin(q23) - self.d5 * c234 - self.d6 * s5 * s234
        z1 = self.d4 + self.d6 * c5
        # Rz(q1) Rx(π/2) Rz(q234) as a quaternion, then R₋y(q5), then Rz(q6).
        total, difference, half = 0.5 * (q1 + q234), 0.5 * (q1 - q234), math.sqrt(0.5)
        w, x, y, z = half * cos(total), half * cos(difference), half * sin(difference), half * sin(total)
        c, s = cos(0.5 * q5), sin(0.5 * q5)
        w, x, y, z = w * c + y * s, x * c + z * s, y * c - w * s, z * c - x * s
        c, s = cos(0.5 * q6), sin(0.5 * q6)
        w, x, y, z = w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s
        return c1 * x1 + s1 * z1, s1 * x1 - c1 * z1, self.d1 + y1, w, x, y, z

    def _branches(self, target: Scalars, near: Scalars, misses: list[float]) -> Iterator[Scalars]:
        """Yield every branch of the inverse, angles not yet unwrapped; where q5 is singular, q6 follows ``near``.

        Each branch whose wrist the elbow cannot reach adds the wrist's distance from the shoulder [m] to ``misses``.
        """
        _, _, _, w, x, y, z = target
        r11, r12, r13 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
        r21, r22, r23 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
        r31, r32 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x)
        a2, a3, d4, d5 = self.a2, self.a3, self.d4, self.d5
        cx, cy, cz = _wrist_centre(target, self.d6)
        height = cz - self.d1
        radius = math.hypot(cx, cy)
        if abs(d4) > radius * (1.0 + _REACH_SLACK):
            return
        bearing, opening = math.atan2(cy, cx) + 0.5 * math.pi, math.acos(max(-1.0, min(1.0, d4 / radius)))
        for q1 in (bearing + opening, bearing - opening) if opening else (bearing,):
            c1, s1 = math.cos(q1), math.sin(q1)
            # The axis of joint 4 as the flange sees it: (sin q5 cos q6, -sin q5 sin q6, cos q5).
            ax, ay, az = s1 * r11 - c1 * r21, s1 * r12 - c1 * r22, s1 * r13 - c1 * r23
            forward_x, forward_y = c1 * r11 + s1 * r21, c1 * r12 + s1 * r22
            forward = c1 * cx + s1 * cy
            sine = math.hypot(ax, ay)
            wrists: tuple[tuple[float, float], ...]
            if sine < _SINGULAR_SINE:
                q6 = near[5]
                q234 = math.atan2(
                    -forward_x * math.sin(q6) - forward_y * math.cos(q6), r31 * math.sin(q6) + r32 * math.cos(q6)
                )
                turn = self._into_reach(q234, forward, height)
                q6 -= turn if az > 0.0 else -turn
                # Projecting on the held q6 keeps the sign of q5, and so carries a path smoothly through zero.
                wrists = ((math.atan2(ax * math.cos(q6) - ay * math.sin(q6), az), q6),)
            else:
                q5, q6 = math.atan2(sine, az), math.atan2(-ay, ax)
                wrists = ((q5, q6), (-q5, q6 + math.pi))
            for q5, q6 in wrists:
                c6, s6 = math.cos(q6), math.sin(q6)
                s234, c234 = -(forward_x * s6 + forward_y * c6), r31 * s6 + r32 * c6
                q234 = math.atan2(s234, c234)
                wx, wy = forward - d5 * s234, height + d5 * c234
                cosine = (wx * wx + wy * wy - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
                if abs(cosine) > 1.0 + _REACH_SLACK:
                    misses.append(math.hypot(wx, wy))
                    continue
                elbow = math.acos(max(-1.0, min(1.0, cosine)))
                for q3 in (elbow, -elbow) if 0.0 < elbow < math.pi else (elbow,):
                    q2 = math.atan2(wy, wx) - math.atan2(a3 * math.sin(q3), a2 + a3 * math.cos(q3))
                    yield q1, q2, q3, q234 - q2 - q3, q5, q6

    def _branches_of(self, positions: Array, quaternions: Array) -> tuple[Array, np.ndarray]:
        """Return the branches (6, 8, N) [rad] of :meth:`_branches` for N poses, and where q5 is singular (N,).

        They come in the same order, are not unwrapped, are NaN where out of reach, and mean nothing where q5 is
        singular. Of the second wrist q6 and q234 are half a turn on, and of the second elbow the sine is negative, so
        that each pair needs its trigonometry once.
        """
        (px, py, pz), (w, x, y, z) = positions.T, quaternions.T
        r11, r12, r13 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
        r21, r22, r23 = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
        r31, r32, r33 = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)
        a2, a3, d4, d5 = self.a2, self.a3, self.d4, self.d5
        cx, cy, height = px - self.d6 * r13, py - self.d6 * r23, pz - self.d6 * r33 - self.d1
        bearing, opening = np.arctan2(cy, cx) + 0.5 * math.pi, np.arccos(_within_one(d4 / np.hypot(cx, cy)))
        q1 = np.stack([bearing + opening, bearing - opening])
        c1, s1 = np.cos(q1), np.sin(q1)
        ax, ay, az = s1 * r11 - c1 * r21, s1 * r12 - c1 * r22, s1 * r13 - c1 * r23
        sine = np.hypot(ax, ay)
        c6, s6 = ax / np.maximum(sine, _SINGULAR_SINE), -ay / np.maximum(sine, _SINGULAR_SINE)
        s234, c234 = -((c1 * r11 + s1 * r21) * s6 + (c1 * r12 + s1 * r22) * c6), r31 * s6 + r32 * c6
        # Shoulders, wrists and elbows are axes of their own, poses the last.
        sign = np.array([1.0, -1.0])[:, None]
        wx = (c1 * cx + s1 * cy)[:, None] - d5 * sign * s234[:, None]
        wy = height + d5 * sign * c234[:, None]
        cosine = _within_one((wx * wx + wy * wy - a2 * a2 - a3 * a3) / (2.0 * a2 * a3))
        elbow, shoulder = np.arccos(cosine), np.arctan2(wy, wx)
        bend = np.arctan2(a3 * np.sqrt((1.0 - cosine) * (1.0 + cosine)), a2 + a3 * cosine)
        branches = np.empty((6, 2, 2, 2, len(px)))
        branches[0] = q1[:, None, None]
        branches[1] = shoulder[:, :, None] - sign * bend[:, :, None]
        branches[2] = sign * elbow[:, :, None]
        half_turn = np.array([0.0, math.pi])[:, None, None]
        branches[4] = sign[:, None] * np.arctan2(sine, az)[:, None, None]
        branches[5] = np.arctan2(-ay, ax)[:, None, None] + half_turn
        q234 = np.arctan2(s234, c234)[:, None, None] + half_turn
        branches[3] = q234 - branches[1] - branches[2]
        return branches.reshape(6, 8, -1), (sine < _SINGULAR_SINE).any(axis=0)

    def _into_reach(self, q234: float, forward: float, height: float) -> float:
        """Return the smallest turn [rad] of q234 that brings the wrist within the elbow's reach; 0 if none does.

        Where q5 is singular, joint 6 can make up for such a turn. The wrist moves on a circle of
        radius d5 about the wrist centre, at ``forward`` and ``height`` [m] in the arm's plane.
        """
        span = math.hypot(forward, height)
        if span * self.d5 == 0.0:
            return 0.0
        angle = math.remainder(q234 + math.atan2(forward, height), TURN)
        middle, scale = span * span + self.d5 * self.d5, 2.0 * self.d5 * span
        bounds = [
            math.acos(max(-1.0, min(1.0, (distance * distance - middle) / scale)))
            for distance in (abs(self.a2) + abs(self.a3), abs(self.a2) - abs(self.a3))
        ]
        return math.copysign(max(min(bounds), min(max(bounds), abs(angle))), angle) - angle

    def _why_not(self, target: Scalars, near: Scalars, misses: list[float]) -> str:
        """Return why no branch will do: the limit that stops the nearest one, or what is out of reach."""
        broken: list[tuple[float, str]] = []
        for branch in self._branches(target, near, []):
            worst = 0.0, ""
            for name, angle, start, low, high in zip(
                self.joint_names, branch, near, self.joint_lower, self.joint_upper, strict=True
            ):
                if unwrapped(angle, start, low, high) is None:
                    angle = math.remainder(angle, TURN)
                    excess = min(abs(math.remainder(angle - low, TURN)), abs(math.remainder(angle - high, TURN)))
                    worst = max(
                        worst, (excess, f"{name} would be at {angle:.4f} rad, allowed {low:.4f}…{high:.4f} rad")
                    )
            broken.append(worst)
        if broken:
            return f"joint limit: {min(broken)[1]}"
        longest, shortest = abs(self.a2) + abs(self.a3), abs(abs(self.a2) - abs(self.a3))
        if misses:
            miss = min(misses, key=lambda distance: max(distance - longest, shortest - distance))
            return (
                f"out of reach: the wrist would be {miss:.4f} m from the shoulder, "
                f"allowed {shortest:.4f}…{longest:.4f} m"
            )
        x, y, _ = _wrist_centre(target, self.d6)
        return (
            f"out of reach: the wrist centre would be {math.hypot(x, y):.4f} m from the base axis, "
            f"at least {abs(self.d4):.4f} m (d4) needed"
        )


def _within_one(cosines: Array) -> Array:
    """Return cosines rid of what rounding pushed beyond ±1; NaN where they are farther beyond."""
    return np.where(np.abs(cosines) <= 1.0 + _REACH_SLACK, np.clip(cosines, -1.0, 1.0), np.nan)


def _wrist_centre(target: Scalars, d6: float) -> tuple[float, float, float]:
    """Return the point d6 behind the flange [m], where the axes of joints 5 and 6 meet."""
    px, py, pz, w, x, y, z = target
    return (
        px - d6 * 2.0 * (x * z + w * y),
        py - d6 * 2.0 * (y * z - w * x),
        pz - d6 * (1.0 - 2.0 * (x * x + y * y)),
    )


def _joint_scalars(joints: ArrayLike) -> Scalars:
    return _scalars(joints, 6, "joints", " rad")
