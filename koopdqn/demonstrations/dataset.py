"""Demonstrated trajectories as immutable, validated data, and where they are placed."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, product
from typing import TYPE_CHECKING

import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.paths import to_step
from koopdqn.pose import Array
from koopdqn.settings import FARTHEST_M

if TYPE_CHECKING:
    from koopdqn.tasks.workcell import Reachability

_QUATERNION_TOLERANCE = 1e-3
_FEWEST_JOINTS = 6


def _frozen(values: Array) -> Array:
    # A copy, so that the caller's array stays writable.
    copy = np.array(values, dtype=float)
    copy.setflags(write=False)
    return copy


@dataclass(frozen=True)
class Demonstration:
    """One trajectory.

    Attributes:
        times: (N,) [s], increasing.
        poses: flange poses (N, 7), quaternions continuous in sign.
        joints: joint angles (N, n) [rad] of six joints or more, or None where they are not known.

    Raises:
        BadInputError: shapes disagree, a value is not finite, times do not increase, a position is more than
            10 m from the base, or a quaternion has not unit length.
    """

    times: Array
    poses: Array
    joints: Array | None = None

    def __post_init__(self) -> None:
        """Check the arrays, and replace them by read-only copies."""
        poses = np.array(self.poses, dtype=float)
        if poses.ndim != 2 or poses.shape[1] != 7 or len(poses) < 2:
            raise BadInputError(f"poses must have shape (N, 7) with N >= 2, found {poses.shape}")
        if np.shape(self.times) != (len(poses),):
            raise BadInputError(f"times must have shape ({len(poses)},), found {np.shape(self.times)}")
        if not np.isfinite(poses).all() or not np.isfinite(self.times).all():
            raise BadInputError("poses and times must be finite, found NaN or infinity")
        if np.any(np.diff(self.times) <= 0):
            raise BadInputError(f"times must increase, found {int(np.sum(np.diff(self.times) <= 0))} that do not")
        farthest = np.abs(poses[:, pose.POSITION]).max()
        if farthest > FARTHEST_M:
            raise BadInputError(
                f"positions must be in metres and within {FARTHEST_M:g} m of the base, found {farthest:g}"
            )
        length = np.linalg.norm(poses[:, pose.QUATERNION], axis=1)
        if np.any(np.abs(length - 1) > _QUATERNION_TOLERANCE):
            worst = length[np.abs(length - 1).argmax()]
            raise BadInputError(f"quaternions must have length 1 within {_QUATERNION_TOLERANCE}, found {worst:g}")
        # Dividing again would change last bits; normalised quaternions are read back as they were written.
        length = np.where(np.abs(length - 1) < 1e-14, 1.0, length)
        poses[:, pose.QUATERNION] = continuous(poses[:, pose.QUATERNION] / length[:, None])
        poses.setflags(write=False)
        object.__setattr__(self, "poses", poses)
        object.__setattr__(self, "times", _frozen(self.times))
        if self.joints is not None:
            shape = np.shape(self.joints)
            if len(shape) != 2 or shape[0] != len(poses) or shape[1] < _FEWEST_JOINTS:
                raise BadInputError(f"joints must have shape ({len(poses)}, {_FEWEST_JOINTS} or more), found {shape}")
            if not np.isfinite(self.joints).all():
                raise BadInputError("joints must be finite, found NaN or infinity")
            object.__setattr__(self, "joints", _frozen(self.joints))

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.poses)


def continuous(quaternions: Array) -> Array:
    """Return quaternions (N, 4) of continuous sign: each with the sign nearer to its predecessor."""
    flips = (quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0
    if not flips.any():
        return np.array(quaternions, dtype=float)
    signs = np.concatenate([[1.0], np.cumprod(np.where(flips, -1.0, 1.0))])
    return np.asarray(quaternions * signs[:, None], dtype=float)


@dataclass(frozen=True)
class Demonstrations:
    """Demonstrations of one task with one arm.

    Attributes:
        task: the task's name.
        arm: the arm's name.
        items: the trajectories, at least one.
        held_out: number of the last ones that are kept for evaluation only.
        placement: how they were moved after recording; None if they were not.

    Raises:
        BadInputError: there is no trajectory, or none to learn from.
    """

    task: str
    arm: str
    items: Sequence[Demonstration]
    held_out: int = 0
    placement: "Placement | None" = None
    _resampled: dict[tuple[float, float], list[Array]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        """Check the number of trajectories."""
        if not self.items:
            raise BadInputError("there must be at least one demonstration, found none")
        if not 0 <= self.held_out < len(self.items):
            raise BadInputError(
                f"held-out demonstrations must be fewer than the {len(self.items)} there are, found {self.held_out}"
            )

    def __len__(self) -> int:
        """Return the number of demonstrations."""
        return len(self.items)

    def resampled(self, step: float, turn: float) -> list[Array]:
        """Return the poses (N, 7) of each, resampled as :func:`koopdqn.paths.to_step` does; not to be written to."""
        # Fit, its picture and the training all ask for the same.
        if (step, turn) not in self._resampled:
            rows = to_step([item.poses for item in self.items], step, turn)
            for each in rows:
                each.setflags(write=False)
            self._resampled[step, turn] = rows
        return list(self._resampled[step, turn])

    def digest(self) -> str:
        """Return the SHA-256 of the content, independent of the file."""
        sha = hashlib.sha256(f"{self.task}\n{self.arm}\n{len(self.items)}\n".encode())
        for item in self.items:
            for values in (item.times, item.poses, item.joints):
                shape = () if values is None else values.shape
                sha.update(f"{shape}\n".encode())
                if values is not None:
                    sha.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
        return sha.hexdigest()


@dataclass(frozen=True)
class Placement:
    """A rigid motion: a turn about the base's vertical axis, then a translation.

    Attributes:
        offset: (3,) [m].
        turn: [rad].
    """

    offset: Array
    turn: float

    def moved(self, demonstrations: Demonstrations) -> Demonstrations:
        """Return the moved demonstrations, without joint angles, which no longer fit."""
        items = [Demonstration(item.times, self.poses(item.poses)) for item in demonstrations.items]
        return replace(demonstrations, items=items, placement=self)

    def undone(self, demonstrations: Demonstrations) -> Demonstrations:
        """Return moved demonstrations at their recorded place."""
        items = [Demonstration(item.times, self.restored(item.poses)) for item in demonstrations.items]
        return replace(demonstrations, items=items, placement=None)

    def poses(self, poses: Array) -> Array:
        """Return the moved poses (..., 7)."""
        return pose.compose(self._pose, poses)

    def restored(self, poses: Array) -> Array:
        """Return moved poses (..., 7) where they came from."""
        return pose.compose(pose.inverse(self._pose), poses)

    def __str__(self) -> str:
        """Return the motion in words."""
        x, y, z = np.round(self.offset, 4).tolist()
        return f"turned by {np.degrees(self.turn):.1f}° about the base's vertical, then moved by [{x}, {y}, {z}] m"

    @property
    def _pose(self) -> Array:
        return pose.make(self.offset, pose.from_rotation_vector([0.0, 0.0, self.turn]))


# Trajectories are first tried at every so-many-th pose: joint bounds over several steps are stricter.
_EVERY = 6
# Placements tried: turns about the vertical [rad], and offsets outward and upward [m].
_TURNS = np.radians([0, 30, -30, 60, -60, 90, -90, 120, -120, 150, -150, 180])
_OUTWARD = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3)
_UPWARD = (0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3, 0.4)
# The turn that counts as 0.1 m when sorting placements by size.
_TURN_LIKE_TEN_CENTIMETRES = np.radians(30)


def find_placement(reachability: "Reachability", trajectories: Sequence[Array]) -> Placement:
    """Return the smallest placement tried in which the arm can follow all trajectories (N, 7).

    It moves nothing where the arm can already. Of others those are preferred in which joints are slow enough to be
    followed at every sixth pose too. The set is turned about its own middle, and moved outward or inward and up or
    down; a turn about the base's axis would change nothing but the first joint. Where that does not do, as with what a
    camera saw, the same is tried with its middle where the flange rests.

    Raises:
        BadInputError: there is none.
    """
    from koopdqn.tasks.workcell import JUMP

    middle = np.concatenate(trajectories)[:, pose.POSITION].mean(axis=0)
    rest = reachability.arm.forward(reachability.arm.home)[pose.POSITION]
    tried, fast = 0, []

    def followed(placement: Placement) -> bool:
        return all(not blocked_at(reachability, placement.poses(rows)) for rows in trajectories)

    still = Placement(np.zeros(3), 0.0)
    if followed(still):
        return still
    for placement in chain(_candidates(middle, middle), _candidates(middle, rest)):
        tried += 1
        # Coarsely first, which is faster.
        ends = {reachability.follow_as_far(placement.poses(rows)[::_EVERY])[1].reason for rows in trajectories}
        if ends == {""} and followed(placement):
            return placement
        if ends <= {"", JUMP}:
            fast.append(placement)
    for placement in fast:
        if followed(placement):
            return placement
    raise BadInputError(
        f"demos.place=auto: must find a place where the arm can follow all {len(trajectories)} demonstrations, found"
        f" none among {tried} turns and moves"
    )


def blocked_at(reachability: "Reachability", trajectory: Array) -> str:
    """Return where and why the arm cannot follow a trajectory (N, 7); empty if it can."""
    joints, motion = reachability.follow_as_far(trajectory)
    if motion.joints is not None:
        return ""
    share, place = len(joints) / max(len(trajectory) - 1, 1), np.round(trajectory[len(joints), pose.POSITION], 3)
    return f"{share:.0%} of its way, at {place.tolist()} m: {motion.reason.replace('_', ' ')}: {motion.detail}"


def _candidates(middle: Array, place: Array) -> Iterator[Placement]:
    """Yield placements of a set that bring its middle (3,) [m] to around a place (3,) [m], the smallest first."""
    flat = np.array([place[0], place[1], 0.0])
    outward = flat / max(float(np.linalg.norm(flat)), 1e-9)
    moves = sorted(
        product(_TURNS, _OUTWARD, _UPWARD),
        key=lambda move: abs(move[0]) / _TURN_LIKE_TEN_CENTIMETRES + (abs(move[1]) + abs(move[2])) / 0.1,
    )
    for turn, out, up in moves:
        turned = pose.rotate(pose.from_rotation_vector([0.0, 0.0, turn]), middle)
        yield Placement(place + out * outward + [0.0, 0.0, up] - turned, float(turn))
