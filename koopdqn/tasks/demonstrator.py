"""The demonstrator: a state-feedback law that says where a person would go next from any pose."""

from dataclasses import dataclass, replace

import numpy as np

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks import law
from koopdqn.tasks.path import SmoothPath


@dataclass(frozen=True)
class TurnLaw:
    """How fast a person turns toward the goal's orientation, by how much is left to turn.

    The rate is gain·φ·(1 − φ/saturation): fast while much is left, slower toward the end, but never below
    ``slowest``, so that the turn ends.

    Attributes:
        gain: share of a small remainder that one step turns.
        saturation: angle [rad] over which the rate would be zero again; over twice the angle of the greatest rate.
        slowest: least turn per step [rad].
    """

    gain: float
    saturation: float
    slowest: float

    def rate(self, left: Array) -> Array:
        """Return the turn [rad] of one step with ``left`` (N,) [rad] to go."""
        return np.minimum(left, np.maximum(self.slowest, self.gain * left * (1.0 - left / self.saturation)))


@dataclass(frozen=True)
class Demonstrator:
    """Pursues a point that runs ahead on a path, so that offsets die out over the look-ahead distance.

    From position p the nearest point of the path is found, the point ``pull_back`` further along it is
    aimed at, and one step is made straight to it: for small offsets this contracts sideways like
    exp(−distance travelled / pull_back), and it comes to rest at the path's end. Meanwhile it turns along
    the geodesic to the goal's orientation. The law knows the task only; it knows nothing of the Koopman model.

    Attributes:
        path: where the person would pass.
        goal: pose (7,) at the end.
        step: distance of one step [m].
        pull_back: look-ahead distance [m].
        turn: how fast it turns; None holds the goal's orientation.
    """

    path: SmoothPath
    goal: Array
    step: float
    pull_back: float
    turn: TurnLaw | None = None

    def aim(self, poses: Array) -> Array:
        """Return the position (N, 3) [m] that the person looks at from poses (N, 7)."""
        position = poses[:, pose.POSITION]
        return self.path.at(self.path.nearest(position) + self.pull_back)

    def next_pose(self, poses: Array) -> Array:
        """Return where the person would be after one step from poses (N, 7)."""
        aim = self.aim(poses)
        remaining = np.linalg.norm(self.goal[pose.POSITION] - poses[:, pose.POSITION], axis=1)
        position = pose.moved_toward(poses[:, pose.POSITION], aim, np.minimum(self.step, remaining))
        left = pose.rotation_distance(poses, self.goal)
        angle = np.full(len(poses), np.inf) if self.turn is None else self.turn.rate(left)
        turned = pose.turned_toward(poses[:, pose.QUATERNION], self.goal[pose.QUATERNION], angle)
        return pose.make(position, turned)

    def finer(self, times: int) -> "Demonstrator":
        """Return the same law with steps ``times`` smaller."""
        turn = self.turn
        if turn is not None:
            turn = TurnLaw(turn.gain / times, turn.saturation, turn.slowest / times)
        return replace(self, step=self.step / times, turn=turn)

    def roll_out(self, start: Array, limit: int) -> Array:
        """Return the poses (T, 7) of the law from a start (7,) until the goal, at most ``limit`` steps."""
        return law.roll_out(self, start, limit)
