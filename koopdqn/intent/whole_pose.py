"""One Koopman model of the whole pose: orientation is predicted from the position.

People turn by 0.2 to 0.3 degrees a step. Predicted from the orientation alone, "do not turn" is then always nearest;
predicted from the position, a tool that lags behind in its turn is told to turn.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.artifact import below
from koopdqn.intent.augment import SPACING_M, PursuitPath
from koopdqn.intent.koopman import KoopmanModel
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.observables import Observables, RandomFourier
from koopdqn.paths import mean_poses, to_count, turned_as_shown, way_lengths
from koopdqn.pose import Array
from koopdqn.settings import Interval
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.step import IN_PLACE, full_step, one_step
from koopdqn.tasks.task import Task

# Position, and the entries of R − I.
_PLACE, _TURN = slice(0, 3), slice(3, 12)
# Starts nearer together than this [m] do not tell how their offsets fade.
_LEAST_SPREAD_M = 1e-6
# Over which share of the way their offsets fade, at least and at most; slower ones are the start frame's.
_FADING = 0.005, 0.125
# So much of the way is straightened at most: more would lose its shape.
_STRAIGHTENED = 0.1
# What names of the start frame's arrays begin with.
_FRAME = "frame_"


class FeaturesOfPlace(Observables):
    """Random Fourier features of the position, the first three components of a state; the turn enters linearly."""

    fourier: RandomFourier

    def features(self, states: Array) -> Array:
        """Return the features (N, F) of states (N, 12)."""
        return self.fourier.features(states[:, _PLACE])


class WholePoseSettings(IntentSettings):
    """How one K is fitted to positions and orientations together."""

    unfolds: ClassVar[bool] = True

    count: int = Field(ge=1, le=5000, description="random Fourier features of the position")
    length_scales: Interval = Field(description="narrowest and widest kernel, in units of the demonstrations' spread")
    copies: int = Field(ge=1, le=100, description="augmented states around each state of the mean demonstration")
    far: float = Field(gt=0, description="largest distance of these, in units of the demonstrations' spread")
    far_rad: float = Field(gt=0, description="standard deviation of their rotation [rad]")
    lead_back_steps: float = Field(gt=0, description="distance over which they lead back, in steps of the agent")
    from_middle: bool = Field(
        default=False,
        description="whether the mean path is moved to begin in the middle of the task's start region, and turns as"
        " demonstrations do where they pass its places",
    )
    touching_m: float = Field(
        ge=0,
        description="where the path passes itself nearer than this in another direction, the later part counts [m]",
    )
    ridge: float = Field(gt=0, description="λ of the regularised least squares")
    seed: int = Field(ge=0, description="of features and augmented states")

    def start_frame(self, trajectories: list[Array], task: Task) -> StartFrame:
        """Return the frame in which the mean of the other trajectories (N, 7) is nearer to the one left out."""
        if task.unfolds:
            return task.person_frame
        return StartFrame.chosen(trajectories, task.nominal_start, task.goal)

    def mean(self, trajectories: list[Array], task: Task) -> Array:
        """Return the mean path (N, 7).

        Where the task itself knows its start region the mean begins in the middle of it, with the nominal start's
        orientation, and turns as trajectories do where they pass its places.
        """
        mean = mean_poses(trajectories)
        if not self.from_middle or task.demonstrated_middle is None:
            return mean
        moved = _moved_to(task.demonstrated_middle, mean, trajectories)
        if task.orientation == "held":
            return moved
        moved[0, pose.QUATERNION] = pose.signed_as(task.nominal_start[pose.QUATERNION], moved[0, pose.QUATERNION])
        return turned_as_shown(moved, trajectories)

    def fit(self, trajectories: list[Array], task: Task) -> IntentModel:
        """Return the model fitted to pose trajectories (N, 7)."""
        before, after, spread = self._states(trajectories, task)
        koopman = KoopmanModel.fit(self._observables, before, after, np.zeros(12), 1.0, self.ridge)
        return self._model(koopman, spread, task)

    def alternatives(self, trajectories: list[Array], task: Task) -> dict[float, IntentModel]:
        """Return the model of the one ridge, with the state's rows of K only."""
        before, after, spread = self._states(trajectories, task)
        rows = (np.zeros(12), 1.0, self.ridges, np.ones(len(before)))
        (koopman,) = KoopmanModel.one_step(self._observables, before, after, *rows)
        return {self.ridge: self._model(koopman, spread, task)}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> IntentModel:
        """Return the model with these arrays."""
        koopman = KoopmanModel(self._observables, np.zeros(12), 1.0, arrays["matrix"])
        spread, tolerance = float(arrays["spread"]), float(arrays["rotation_tolerance"])
        turns = bool(arrays["held"]), "in_full" in arrays
        return WholePoseIntent(
            koopman, spread, *turns, tolerance, arrays["goal"], StartFrame.restore(below(arrays, _FRAME))
        )

    @property
    def _observables(self) -> FeaturesOfPlace:
        fourier = RandomFourier(count=self.count, length_scales=self.length_scales, seed=self.seed)
        return FeaturesOfPlace(fourier=fourier)

    def _states(self, trajectories: list[Array], task: Task) -> tuple[Array, Array, float]:
        """Return the states (M, 12) to fit, their successors (M, 12) and the spread of the positions [m]."""
        positions = np.concatenate(trajectories)[:, pose.POSITION]
        spread = float(np.sqrt(((positions - positions.mean(axis=0)) ** 2).sum(axis=1).mean()))
        before, after = (_state(poses, task.goal, spread) for poses in self._pairs(trajectories, spread, task))
        return before, after, spread

    def _model(self, koopman: KoopmanModel, spread: float, task: Task) -> IntentModel:
        turns = task.orientation == "held", task.turns_in_full
        return WholePoseIntent(koopman, spread, *turns, task.rotation_tolerance_rad, task.goal)

    def _pairs(self, trajectories: list[Array], spread: float, task: Task) -> tuple[Array, Array]:
        """Return states (M, 7) of the mean demonstration and around it, and their successors (M, 7).

        Ten coarse actions cannot hold paths that run side by side apart, but can follow one to which all states lead.
        Augmented states lie in any direction from it, at log-uniform distances of one step and more, and lead back to
        it within some steps. Their orientations are random too, and turn to that of the path.
        """
        mean = self.mean(trajectories, task)
        path = PursuitPath.along(mean[:, pose.POSITION], self.lead_back_steps * task.step_m, self.touching_m)
        shown = to_count(mean, len(path.points))
        rng = np.random.default_rng(self.seed)
        near = np.repeat(mean[:, None], self.copies, axis=1).reshape(-1, 7)
        farthest = max(self.far * spread, task.step_m)
        size = np.exp(rng.uniform(np.log(task.step_m), np.log(farthest), (len(near), 1)))
        way = rng.normal(size=(len(near), 3))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        turn = pose.from_rotation_vector(rng.normal(scale=self.far_rad, size=(len(near), 3)))
        scattered = pose.make(near[:, pose.POSITION] + size * way, pose.multiply(near[:, pose.QUATERNION], turn))
        states = np.concatenate([mean, scattered])
        position = states[:, pose.POSITION]
        ahead = path.nearest(position) + max(1, round(task.step_m / SPACING_M))
        turned = shown[np.minimum(ahead, len(shown) - 1), pose.QUATERNION]
        return states, pose.make(path.step_from(position, task.step_m), turned)


@dataclass(frozen=True)
class WholePoseIntent(IntentModel):
    """A model whose state is the position from the goal, in spreads, and the entries of R − I from the goal.

    Attributes:
        koopman: the model of states (N, 12).
        spread: unit of positions [m].
        held: whether orientation is held in place of the prediction.
        in_full: whether the predicted turn counts in full, and not its part toward the goal alone.
        rotation_tolerance: [rad].
        goal: the goal pose (7,).
        start_frame: in which it was fitted.
    """

    koopman: KoopmanModel
    spread: float
    held: bool
    in_full: bool
    rotation_tolerance: float
    goal: Array
    start_frame: StartFrame = STILL

    def predict(self, poses: Array) -> Array:
        """Return the predicted next poses (N, 7) of poses (N, 7); orientations are the nearest rotations to R̂."""
        rows = self.koopman.predict(_state(poses, self.goal, self.spread))
        position = self.goal[pose.POSITION] + self.spread * rows[:, _PLACE]
        if self.held:
            return pose.make(position, poses[:, pose.QUATERNION])
        turned = _nearest_rotations(rows[:, _TURN].reshape(-1, 3, 3) + np.eye(3))
        return pose.make(position, pose.multiply(self.goal[pose.QUATERNION], turned))

    def to_step(self, poses: Array, predicted: Array, step: float, starts: Array | None = None) -> Array:
        """Return predictions (N, 7) rescaled to one step of the agent [m], position and turn together."""
        if self.held:
            return super().to_step(poses, predicted, step, starts)
        room, turn = self._room(poses, starts), IN_PLACE * self.rotation_tolerance
        if self.in_full:
            return full_step(poses, predicted, room, step, turn)
        return one_step(poses, predicted, self.goal, room, step, turn)

    def within(self, frame: StartFrame) -> "WholePoseIntent":
        """Return the model with the frame in which it was fitted."""
        return replace(self, start_frame=frame)

    @property
    def matrices(self) -> dict[str, KoopmanModel]:
        """The one K."""
        return {"K": self.koopman}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the model as arrays, without its settings."""
        return {
            "matrix": self.koopman.matrix,
            "spread": np.array(self.spread),
            "held": np.array(self.held),
            "rotation_tolerance": np.array(self.rotation_tolerance),
            "goal": self.goal,
            **({"in_full": np.array(True)} if self.in_full else {}),
            **{f"{_FRAME}{name}": values for name, values in self.start_frame.arrays().items()},
        }


def _moved_to(middle: Array, mean: Array, trajectories: list[Array]) -> Array:
    """Return the mean (N, 7) of trajectories (N, 7) as if they had begun around a ``middle`` (3,) [m].

    A few starts lie beside the middle of the region that they were drawn from, and the mean path begins there: the mean
    start is a control variate of it. What it is off fades over the arc length s as e^(−s/ℓ), with the ℓ by which the
    demonstrations' own offsets from the mean do, taken at right angles to it (least squares): those along it also tell
    how far the shares of two ways are apart. From all of the region behind its beginning the path is led to as it
    begins, so that what is left there to chance must not turn it: up to 2ℓ, of a tenth of the way at most, it is the
    cubic that leaves the middle straight and runs into what follows. Where all begin alike, the mean stays as it is.
    """
    from scipy.optimize import minimize_scalar

    places, arc = mean[:, pose.POSITION], way_lengths(mean)
    directions = np.gradient(places, axis=0)
    directions /= np.maximum(pose.norm(directions, keepdims=True), 1e-12)
    aligned = np.array([to_count(rows, len(mean), way_lengths(rows))[:, pose.POSITION] for rows in trajectories])
    off = aligned - places
    if pose.norm(off[:, 0]).max() < _LEAST_SPREAD_M:
        return mean
    begun, left = _across(np.broadcast_to(off[:, :1], off.shape), directions), _across(off, directions)

    def error(length: float) -> float:
        return float(((left - np.exp(-arc / length)[:, None] * begun) ** 2).sum())

    length = minimize_scalar(error, bounds=arc[-1] * np.array(_FADING), method="bounded").x
    moved = places - np.exp(-arc / length)[:, None] * (places[0] - middle)
    joined = max(1, int(np.searchsorted(arc, min(2.0 * length, _STRAIGHTENED * arc[-1]))))
    way, onward = moved[joined] - middle, moved[min(joined + 1, len(moved) - 1)] - moved[joined - 1]
    onward *= pose.norm(way) / max(float(pose.norm(onward)), 1e-12)
    share = (arc[:joined] / arc[joined])[:, None]
    moved[:joined] = middle + share * (1.5 * way - 0.5 * onward) + share**3 * (0.5 * onward - 0.5 * way)
    return pose.make(moved, mean[:, pose.QUATERNION])


def _across(vectors: Array, directions: Array) -> Array:
    """Return the parts of vectors (..., N, 3) at right angles to unit vectors (N, 3)."""
    return np.asarray(vectors - (vectors * directions).sum(axis=-1, keepdims=True) * directions)


def _state(poses: Array, goal: Array, spread: float) -> Array:
    turned = pose.to_matrix(pose.multiply(pose.conjugate(goal[pose.QUATERNION]), poses[:, pose.QUATERNION]))
    place = (poses[:, pose.POSITION] - goal[pose.POSITION]) / spread
    return np.concatenate([place, (turned - np.eye(3)).reshape(len(poses), 9)], axis=1)


def _nearest_rotations(matrices: Array) -> Array:
    """Return the quaternions (N, 4) of the rotations nearest to matrices (N, 3, 3), by their SVD."""
    from scipy.spatial.transform import Rotation

    left, _, right = np.linalg.svd(matrices)
    left[..., 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    return np.asarray(Rotation.from_matrix(left @ right).as_quat()[:, [3, 0, 1, 2]])
