"""Poses: the vocabulary every other part speaks.

A pose is an array whose last axis holds 7 numbers: position x, y, z in metres and a unit
quaternion w, x, y, z. Every function is vectorised over leading axes, written ``...``.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from koopdqn.errors import BadInputError

Array = NDArray[np.float64]

POSITION: Final = slice(0, 3)
QUATERNION: Final = slice(3, 7)
IDENTITY: Final[tuple[float, ...]] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

_LENGTH_TOLERANCE: Final = 1e-3
_SMALL_ANGLE = 1e-8
_EPSILON = float(np.finfo(float).eps)
# Row i of left.w, left.x, left.y, left.z times these entries of the right quaternion, so signed, adds up to w, x, y, z.
_PRODUCT_ENTRIES: Final = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_PRODUCT_SIGNS: Final = np.array([[1.0, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]])
# Numbers of two arrays up to which the other way to multiply them is faster.
_FEW = 800
_NEXT: Final = np.array([1, 2, 0])
_LAST: Final = np.array([2, 0, 1])
_CONJUGATE: Final = np.array([1.0, -1.0, -1.0, -1.0])


def make(position: ArrayLike, quaternion: ArrayLike) -> Array:
    """Return poses (..., 7) from positions (..., 3) [m] and quaternions (..., 4), which are normalised."""
    position = np.asarray(position, dtype=float)
    quaternion = normalized(quaternion)
    shape = np.broadcast_shapes(position.shape[:-1], quaternion.shape[:-1])
    pose = np.empty((*shape, 7))
    pose[..., POSITION] = position
    pose[..., QUATERNION] = quaternion
    return pose


def checked(poses: ArrayLike, what: str) -> Array:
    """Return poses (N, 7) that come from outside as an array; ``what`` names them in the message.

    Raises:
        BadInputError: they are no numbers, of another shape or not finite, or a quaternion has not unit length.
    """
    try:
        given = np.asarray(poses, dtype=float)
    except (TypeError, ValueError) as error:
        found = " ".join(repr(poses).split())[:80]
        raise BadInputError(f"{what} must be numbers of shape (N, 7), found {found}") from error
    if given.ndim != 2 or given.shape[1] != 7:
        raise BadInputError(f"{what} must have shape (N, 7), found {given.shape}")
    if not np.isfinite(given).all():
        raise BadInputError(f"{what} must be finite, found NaN or infinity")
    length = norm(given[:, QUATERNION])
    off = np.abs(length - 1.0) > _LENGTH_TOLERANCE
    if off.any():
        raise BadInputError(
            f"{what} must hold quaternions of length 1 within {_LENGTH_TOLERANCE}, found {length[off][0]:g}"
        )
    return given


def normalized(quaternion: ArrayLike) -> Array:
    """Return quaternions (..., 4) scaled to unit length.

    Raises:
        ValueError: a quaternion has no length, or is not finite.
    """
    quaternion = np.asarray(quaternion, dtype=float)
    length = norm(quaternion, keepdims=True)
    if not ((length >= 1e-12) & (length < np.inf)).all():
        raise ValueError("a quaternion must be finite and longer than 1e-12")
    return np.asarray(quaternion / length, dtype=float)


def norm(vectors: Array, keepdims: bool = False) -> Array:
    """Return the lengths (...) of vectors (..., d), or (..., 1): NumPy's own to the last bit, with less around it."""
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=-1, keepdims=keepdims)))


def canonical(quaternion: ArrayLike) -> Array:
    """Return, of the two quaternions (..., 4) of each rotation, the one with w ≥ 0."""
    quaternion = np.asarray(quaternion, dtype=float)
    return np.asarray(np.where(quaternion[..., :1] < 0, -quaternion, quaternion), dtype=float)


def signed_as(quaternion: Array, near: Array) -> Array:
    """Return, of the two quaternions (..., 4) of each rotation, the one nearer to ``near`` (..., 4)."""
    return quaternion * np.where((quaternion * near).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)


def conjugate(quaternion: ArrayLike) -> Array:
    """Return the inverse of unit quaternions (..., 4)."""
    return np.asarray(np.multiply(quaternion, _CONJUGATE), dtype=float)


def multiply(left: ArrayLike, right: ArrayLike) -> Array:
    """Return the Hamilton product (..., 4): first the rotation ``right``, then ``left``."""
    left, right = np.asarray(left, dtype=float), np.asarray(right, dtype=float)
    if left.size + right.size <= _FEW:
        # Poses often come one by one, and then the calls cost more than the arithmetic.
        terms = right.take(_PRODUCT_ENTRIES, axis=-1)
        terms *= _PRODUCT_SIGNS
        terms = left[..., None] * terms
        few: Array = terms[..., 0, :] + terms[..., 1, :]
        few += terms[..., 2, :]
        few += terms[..., 3, :]
        return few
    lw, lx, ly, lz = (left[..., i] for i in range(4))
    rw, rx, ry, rz = (right[..., i] for i in range(4))
    product = np.empty(np.broadcast_shapes(left.shape, right.shape))
    product[..., 0] = lw * rw - lx * rx - ly * ry - lz * rz
    product[..., 1] = lw * rx + lx * rw + ly * rz - lz * ry
    product[..., 2] = lw * ry - lx * rz + ly * rw + lz * rx
    product[..., 3] = lw * rz + lx * ry - ly * rx + lz * rw
    return product


def rotate(quaternion: ArrayLike, vector: ArrayLike) -> Array:
    """Return vectors (..., 3) turned by unit quaternions (..., 4)."""
    quaternion, vector = np.asarray(quaternion, dtype=float), np.asarray(vector, dtype=float)
    w, u = quaternion[..., :1], quaternion[..., 1:]
    twice = 2.0 * cross(u, vector)
    return np.asarray(vector + w * twice + cross(u, twice), dtype=float)


def cross(a: Array, b: Array) -> Array:
    """Return the cross products (..., 3) of vectors (..., 3), NumPy's own in half the time where they are few."""
    if a.size + b.size <= _FEW:
        return a.take(_NEXT, axis=-1) * b.take(_LAST, axis=-1) - a.take(_LAST, axis=-1) * b.take(_NEXT, axis=-1)
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        product[..., i] = a[..., j] * b[..., k] - a[..., k] * b[..., j]
    return product


def to_rotation_vector(quaternion: ArrayLike) -> Array:
    """Return rotation vectors (..., 3) [rad] of length 0…π, the logarithm of unit quaternions (..., 4)."""
    quaternion = canonical(quaternion)
    axis = quaternion[..., 1:]
    sine = norm(axis, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quaternion[..., :1])
    small = sine < _SMALL_ANGLE
    return axis * np.where(small, 2.0, angle / np.where(small, 1.0, sine))


def from_rotation_vector(vector: ArrayLike) -> Array:
    """Return unit quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    vector = np.asarray(vector, dtype=float)
    half = 0.5 * norm(vector, keepdims=True)
    # np.sinc without what it looks up in every call: sin(x)/x, smooth at zero.
    angle = np.pi * (half / np.pi)
    angle = np.where(angle, angle, _EPSILON)
    return np.concatenate([np.cos(half), 0.5 * vector * (np.sin(angle) / angle)], axis=-1)


def to_matrix(quaternion: ArrayLike) -> Array:
    """Return rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    quaternion = np.asarray(quaternion, dtype=float)
    return np.swapaxes(rotate(quaternion[..., None, :], np.eye(3)), -1, -2)


def from_matrix(matrix: ArrayLike) -> Array:
    """Return unit quaternions (..., 4), w ≥ 0, of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    matrix = np.asarray(matrix, dtype=float)
    flat = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return canonical(flat.reshape(*matrix.shape[:-2], 4))


def to_roll_pitch_yaw(quaternion: ArrayLike) -> Array:
    """Return roll, pitch, yaw (..., 3) [rad] about the fixed axes x, y, z, pitch within ±π/2.

    At pitch ±π/2 yaw is taken as zero, as roll and yaw are not apart there.
    """
    w, x, y, z = np.moveaxis(np.asarray(quaternion, dtype=float), -1, 0)
    sine = np.clip(2.0 * (w * y - z * x), -1.0, 1.0)
    pitch = np.arcsin(sine)
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    locked = np.abs(sine) > 1.0 - 1e-12
    roll = np.where(locked, 2.0 * np.arctan2(x, w), roll)
    return np.stack([roll, pitch, np.where(locked, 0.0, yaw)], axis=-1)


def from_roll_pitch_yaw(angles: ArrayLike) -> Array:
    """Return unit quaternions (..., 4) of roll, pitch, yaw (..., 3) [rad] about the fixed axes x, y, z."""
    angles = np.asarray(angles, dtype=float)
    axes = np.eye(3)
    roll, pitch, yaw = (from_rotation_vector(angles[..., i : i + 1] * axes[i]) for i in range(3))
    return multiply(yaw, multiply(pitch, roll))


def position_distance(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the Euclidean distance (...) [m] between poses (..., 7): Eq. 15 of the paper."""
    difference = np.asarray(a, dtype=float)[..., POSITION] - np.asarray(b, dtype=float)[..., POSITION]
    return norm(difference)


def rotation_distance(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the rotation angle (...) [rad], 0…π, between poses (..., 7): Eq. 16, ‖log(R R'ᵀ)‖.

    The norm is that of the rotation vector. It is taken from the half-angle's sine and cosine,
    which keeps full precision at small angles, where arccos of the dot product loses it.
    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    return angle_of(multiply(a[..., QUATERNION], conjugate(b[..., QUATERNION])))


def difference(poses: Array, others: Array) -> Array:
    """Return x, y, z [m] and the rotation vector [rad] (N, 6) from other poses (N, 7) to poses (N, 7)."""
    turn = multiply(conjugate(others[:, QUATERNION]), poses[:, QUATERNION])
    return np.concatenate([poses[:, POSITION] - others[:, POSITION], to_rotation_vector(turn)], axis=1)


def angle_of(quaternion: Array) -> Array:
    """Return the rotation angles (...) [rad], 0…π, of unit quaternions (..., 4)."""
    return np.asarray(2.0 * np.arctan2(norm(quaternion[..., 1:]), np.abs(quaternion[..., 0])))


def turned_toward(quaternion: ArrayLike, goal: ArrayLike, angle: ArrayLike) -> Array:
    """Return quaternions (..., 4) turned by ``angle`` (...) [rad] along the geodesic to ``goal``, clamped there.

    A negative angle turns away from it. This is unit quaternion interpolation (§3.4). Half a turn away the geodesic is
    not unique; the sense of the quaternion as given then decides.
    """
    return Geodesic.between(quaternion, goal).turned(angle)


@dataclass(frozen=True)
class Geodesic:
    """The shortest turns from quaternions to others.

    Attributes:
        quaternion: (..., 4) where they begin.
        goal: (..., 4) where they end.
        relative: (..., 3) the rotation vectors of the whole turns [rad].
        total: (..., 1) their angles [rad].
    """

    quaternion: Array
    goal: Array
    relative: Array
    total: Array

    @classmethod
    def between(cls, quaternion: ArrayLike, goal: ArrayLike) -> "Geodesic":
        """Return the turns from quaternions (..., 4) to others (..., 4)."""
        quaternion, goal = np.asarray(quaternion, dtype=float), np.asarray(goal, dtype=float)
        relative = to_rotation_vector(multiply(goal, conjugate(quaternion)))
        return cls(quaternion, goal, relative, norm(relative, keepdims=True))

    def turned(self, angle: ArrayLike) -> Array:
        """Return the quaternions (..., 4) after ``angle`` (...) [rad] of the turns, at most at their ends."""
        angle = np.asarray(angle, dtype=float)[..., None]
        share = np.minimum(angle / np.where(self.total > 0, self.total, 1.0), 1.0)
        result = normalized(multiply(from_rotation_vector(share * self.relative), self.quaternion))
        return np.where(angle >= self.total, self.goal, result)


def moved_toward(position: ArrayLike, goal: ArrayLike, distance: ArrayLike) -> Array:
    """Return positions (..., 3) moved by ``distance`` (...) [m] straight to ``goal``, clamped there."""
    position, goal = np.asarray(position, dtype=float), np.asarray(goal, dtype=float)
    total = norm(goal - position, keepdims=True)
    distance = np.asarray(distance, dtype=float)[..., None]
    share = np.clip(distance / np.where(total > 0, total, 1.0), 0.0, 1.0)
    return np.where(distance >= total, goal, position + share * (goal - position))


def compose(parent: ArrayLike, child: ArrayLike) -> Array:
    """Return poses (..., 7) of ``child``, given in the frame ``parent``, in the frame of ``parent``'s own parent."""
    parent, child = np.asarray(parent, dtype=float), np.asarray(child, dtype=float)
    position = parent[..., POSITION] + rotate(parent[..., QUATERNION], child[..., POSITION])
    return make(position, multiply(parent[..., QUATERNION], child[..., QUATERNION]))


def inverse(pose: ArrayLike) -> Array:
    """Return the inverse transforms (..., 7) of poses."""
    pose = np.asarray(pose, dtype=float)
    back = conjugate(pose[..., QUATERNION])
    return make(-rotate(back, pose[..., POSITION]), back)
