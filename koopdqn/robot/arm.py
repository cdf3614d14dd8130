"""What an arm is for the rest of the program: its names, its limits and its kinematics."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from numpy.typing import ArrayLike

from koopdqn.pose import Array


@dataclass(frozen=True, slots=True)
class InverseResult:
    """The answer of an inverse kinematics call; check ``success`` before using ``joints``.

    Attributes:
        joints: joint angles (6,) [rad], read-only: the solution, or the seed as given if there is none.
        position_residual: distance [m] of the flange at ``joints``, by forward kinematics, from the pose asked for.
        rotation_residual: rotation angle [rad] between the same two.
        success: whether ``joints`` reach the pose within the joint limits.
        reason: empty on success, otherwise a sentence that names the quantity, the rule and the value.
    """

    joints: Array
    position_residual: float
    rotation_residual: float
    success: bool
    reason: str


@runtime_checkable
class Arm(Protocol):
    """A six-joint arm. Poses are of the flange in the arm's base frame, as in :mod:`koopdqn.pose`."""

    @property
    def name(self) -> str:
        """Name of the arm, for people."""

    @property
    def asset(self) -> str:
        """Path of the arm's MJCF file below ``assets/``."""

    @property
    def joint_names(self) -> Sequence[str]:
        """Names (6,) of the joints in the MJCF file, from the base outward; its actuators bear the same names."""

    @property
    def flange_site(self) -> str:
        """Name of the MJCF site whose frame is the flange."""

    @property
    def joint_lower(self) -> Sequence[float]:
        """Lower joint limits (6,) [rad]."""

    @property
    def joint_upper(self) -> Sequence[float]:
        """Upper joint limits (6,) [rad]."""

    @property
    def velocity_limits(self) -> Sequence[float]:
        """Largest joint speeds (6,) [rad/s]."""

    @property
    def torque_limits(self) -> Sequence[float]:
        """Largest joint torques (6,) [Nm]."""

    @property
    def step_seconds(self) -> float:
        """How long one step of the agent takes [s]; gives every speed."""

    @property
    def home(self) -> Sequence[float]:
        """Joint angles (6,) [rad] of the resting pose."""

    def forward(self, joints: ArrayLike) -> Array:
        """Return the flange poses (..., 7) of joint angles (..., 6) [rad]."""

    def inverse(self, pose: ArrayLike, seed: ArrayLike) -> InverseResult:
        """Return the joint angles nearest ``seed`` (6,) [rad] that bring the flange to ``pose`` (7,)."""

    def inverse_batch(self, poses: ArrayLike, seeds: ArrayLike) -> Array:
        """Return the joint angles (N, 6) that :meth:`inverse` finds for poses (N, 7) from seeds (N, 6).

        Rows are NaN where it has no success.
        """

    def solutions(self, pose: ArrayLike, seed: ArrayLike | None = None) -> Array:
        """Return all solutions (k, 6) [rad] for ``pose`` (7,), unwrapped to lie nearest ``seed`` (home if None).

        The nearest to it comes first, by the largest difference of a joint.
        """
