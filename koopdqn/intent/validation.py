"""Cross-validation: each demonstration against the model of the others; signs of rewards; convergence to the goal."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.reward import Prediction, certain_signs
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.paths import arc_lengths, mean_poses
from koopdqn.pose import Array
from koopdqn.tasks.actions import excess, legal_actions, reached_poses, within_tolerance
from koopdqn.tasks.person import Expert, ReferencePath
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.step import IN_PLACE
from koopdqn.tasks.task import Task

# The multi-step error looks so many steps ahead, from every so-many-th state. Errors of a step that cancel or add up
# show after a few centimetres.
_AHEAD = 25
_EVERY = 8
# How far ahead, in steps, the expert of the mean demonstration aims.
_AIM_STEPS = 5.0


@dataclass(frozen=True)
class Fold:
    """A demonstration left out, and the model of the others.

    Attributes:
        held_out: its poses (N, 7).
        model: fitted to the others.
        error: (N − 1, 6) one-step errors of the raw prediction: x, y, z [m] and the rotation vector [rad].
        rescaled: (N − 1, 6) the same of the fixed-step prediction.
    """

    held_out: Array
    model: IntentModel
    error: Array
    rescaled: Array


@dataclass(frozen=True)
class Validation:
    """The result of leaving one demonstration out at a time.

    Attributes:
        folds: one for each demonstration; none for a single one.
        ridge: the ridge of the least multi-step error.
        multi_step: RMS multi-step error [m] of each ridge; empty for a single demonstration.
    """

    folds: tuple[Fold, ...]
    ridge: float
    multi_step: dict[float, float]


def cross_validate(
    trajectories: list[Array], task: Task, intent: IntentSettings, advance: Callable[[int], None] = lambda done: None
) -> Validation:
    """Return the folds of pose trajectories (N, 7), with the ridge of the least multi-step error.

    The trajectories are at the agent's step; ``advance`` is called with the number of folds done.
    """
    if len(trajectories) == 1:
        return Validation((), intent.ridges[0], {})
    models: list[dict[float, IntentModel]] = []
    squared: dict[float, list[Array]] = {ridge: [] for ridge in intent.ridges}
    for index, held_out in enumerate(trajectories):
        models.append(intent.alternatives(trajectories[:index] + trajectories[index + 1 :], task))
        for ridge, model in models[-1].items():
            squared[ridge].append(_multi_step_error(model, held_out, task))
        advance(index + 1)
    multi_step = {ridge: float(np.sqrt(np.concatenate(found).mean())) for ridge, found in squared.items()}
    ridge = min(multi_step, key=multi_step.__getitem__)
    folds = tuple(_fold(held_out, found[ridge], task) for held_out, found in zip(trajectories, models, strict=True))
    return Validation(folds, ridge, multi_step)


def _fold(held_out: Array, model: IntentModel, task: Task) -> Fold:
    before, after = held_out[:-1], held_out[1:]
    rescaled = pose.difference(model.predict_step(before, task.step_m), after)
    return Fold(held_out, model, pose.difference(model.predict(before), after), rescaled)


def _multi_step_error(model: IntentModel, held_out: Array, task: Task) -> Array:
    """Return squared distances [m²] between a demonstration and the model's roll-outs from its states."""
    ahead = min(_AHEAD, len(held_out) - 1)
    begin = np.arange(0, len(held_out) - ahead, _EVERY)
    reached = model.roll_out(held_out[begin], ahead, task.step_m)[-1]
    return np.asarray(pose.position_distance(reached, held_out[begin + ahead]) ** 2)


def sizes_of(errors: Array) -> Array:
    """Return the sizes (N, 2) [m, rad] of errors (N, 6) of position and orientation, Eqs. 15, 16."""
    return np.stack([np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)], axis=1)


def mean_expert(mean: Array, task: Task) -> Expert:
    """Return the expert that goes along a mean path (N, 7) in the start frame."""
    turn = IN_PLACE * task.rotation_tolerance_rad if task.orientation == "learned" else 0.0
    return Expert(ReferencePath.along(mean), _steps_ahead, task.goal, task.step_m, turn, in_full=task.turns_in_full)


def _steps_ahead(path: ReferencePath, positions: Array, arc: Array, step: float) -> Array:
    return path.places.at(arc + _AIM_STEPS * step)


def jackknife_signs(
    folds: Sequence[Fold], mean: Array, task: Task, prediction: Prediction, doubts: Sequence[float]
) -> list[Array]:
    """Return, for each state but the last of each demonstration, its number of right signs and of signs, (N − 1, L, 2).

    The trust domain is calibrated on them. A reward must know which actions are right, not the person's next pose to a
    millimetre. So right is what the expert of the mean of all does, as the intent has it: people who differ by
    centimetres agree on it, while no model predicts the next step of a single one of them.

    Args:
        folds: one for each demonstration; the model of the others gives the rewards.
        mean: (N, 7) of all of them, in the start frame (:meth:`IntentSettings.mean`).
        task: gives actions and tolerances.
        prediction: what rewards compare with.
        doubts: L guard bands as shares of the tolerance; a comparison within the band is not counted.
    """
    expert = mean_expert(mean, task)
    return [
        count_signs(fold.model, fold.held_out[:-1], expert.next_pose(fold.held_out[:-1]), task, prediction, doubts)
        for fold in folds
    ]


def held_out_contained(
    trajectories: list[Array], signs: list[Array], task: Task, settings: TrustSettings
) -> list[np.ndarray]:
    """Return whether the trust domain of the others contains each pose of each demonstration, (N,) each.

    The list is empty for a single demonstration. Signs are those that :meth:`TrustSettings.fit` takes.
    """
    contained = []
    for index, held_out in enumerate(trajectories if len(trajectories) > 1 else []):
        others = [i for i in range(len(trajectories)) if i != index]
        fold = settings.fit([trajectories[i] for i in others], [signs[i] for i in others], task.frame)
        contained.append(fold.contains(held_out, np.arange(len(held_out))))
    return contained


def left_out_share(folds: Sequence[Fold], task: Task, prediction: Prediction, doubt: float) -> float | None:
    """Return the share of right signs, where right is what the left-out demonstration does next; None without folds."""
    if not folds:
        return None
    found = []
    for fold in folds:
        before = fold.held_out[:-1]
        wished = mean_expert(mean_poses([fold.held_out]), task).next_pose(before)
        found.append(count_signs(fold.model, before, wished, task, prediction, [doubt]).sum(axis=(0, 1)))
    right, of = np.sum(found, axis=0)
    return float(right / of)


def count_signs(
    model: IntentModel, poses: Array, wished: Array, task: Task, prediction: Prediction, doubts: Sequence[float]
) -> Array:
    """Return the numbers of right signs and of signs, (N, L, 2), at poses (N, 7) for each of L doubts.

    The poses are in the model's start frame, ``wished`` (N, 7) are a person's next ones; prediction and doubts are as
    :func:`jackknife_signs` takes them.
    """
    reached = reached_poses(poses, task)
    predicted = model.predict(poses)
    if prediction == "rescaled":
        predicted = model.to_step(poses, predicted, task.step_m)
    margin = np.where(legal_actions(task), 1.0 - excess(reached, predicted[:, None], task), -np.inf)
    right = (margin >= 0) == within_tolerance(reached, wished[:, None], task)
    counts = np.stack([certain_signs(margin, doubt) & legal_actions(task) for doubt in doubts], axis=1)
    return np.stack([(right[:, None] & counts).sum(axis=2), counts.sum(axis=2)], axis=2).astype(float)


_STARTS = 20
# The first displacement [m]; it is halved until it lies in the domain.
_FARTHEST_M = 0.064
_HALVINGS = 7
_WIDER = 3.0
_REST_STEPS = 25
# Step limit of the roll-outs, in steps of the longest demonstration.
_PATIENCE = 3


def length_ratio(model: IntentModel, trajectories: list[Array], task: Task) -> float:
    """Return how long the model's own way to the goal is, in shares of the demonstration from the same start: a median.

    Demonstrated poses (N, 7) are in the model's start frame. Both ways end where they come within the goal's tolerance,
    a demonstration where it does so to stay. Where demonstrations come back over the same place only the last passage
    is learned, and the way is shorter.
    """
    starts = np.array([trajectory[0] for trajectory in trajectories])
    limit = 2 * max(len(trajectory) for trajectory in trajectories)
    paths = model.roll_out(starts, limit, task.step_m)
    there = pose.position_distance(paths, task.goal) <= task.goal_tolerance_m
    steps = np.where(there.any(axis=0), there.argmax(axis=0), limit)
    # Not their number: a step that turns goes less far.
    ways = [arc_lengths(paths[: count + 1, row, pose.POSITION])[-1] for row, count in enumerate(steps)]
    return float(np.median(np.array(ways) / [_way_to_goal(trajectory, task) for trajectory in trajectories]))


def _way_to_goal(trajectory: Array, task: Task) -> float:
    """Return the length [m] of a demonstration (N, 7) until it is within the goal's tolerance to stay."""
    away = pose.position_distance(trajectory, task.goal) > task.goal_tolerance_m
    arrival = min(len(away) - int(away[::-1].argmax()), len(away) - 1)
    return float(arc_lengths(trajectory[: arrival + 1, pose.POSITION])[-1])


def convergence(model: IntentModel, trust: TrustDomain, trajectories: list[Array], task: Task) -> tuple[float, float]:
    """Return the shares of starts from which roll-outs of fixed step reach the goal's position and stay there.

    First of starts in the demonstrated region: the demonstrations' own, some of the task's region and trusted states
    beside the demonstrations. Then of starts up to three times as far out as the start region.

    Demonstrated poses (N, 7) are in the model's start frame; the trust domain says how far beside them starts may lie.
    """
    rng = np.random.default_rng(0)
    drawn = task.draw_starts(rng, _STARTS)
    demonstrated = np.concatenate([[rows[0] for rows in trajectories], _beside(trust, trajectories, rng)])
    wide = task.draw_starts(rng, _STARTS)
    wide[:, pose.POSITION] += (_WIDER - 1.0) * (wide - task.nominal_start)[:, pose.POSITION]
    limit = _PATIENCE * max(len(trajectory) for trajectory in trajectories)

    def in_frame(poses: Array, starts: Array) -> Array:
        return model.predict_step(poses, task.step_m)

    def from_starts(poses: Array, starts: Array) -> Array:
        starts[:] = model.start_frame.onward(poses, starts)
        return model.to_step(poses, model.intended(poses, starts), task.step_m, starts)

    there = _arrives(in_frame, demonstrated, task, STILL, limit)
    far_and_near = _arrives(from_starts, np.concatenate([wide, drawn]), task, model.start_frame, limit)
    region = np.concatenate([there, far_and_near[len(wide) :]])
    return float(region.mean()), float(far_and_near[: len(wide)].mean())


def _beside(trust: TrustDomain, trajectories: list[Array], rng: np.random.Generator) -> Array:
    """Return demonstrated states (M, 7) displaced within the domain, by at least half its extent."""
    everything = np.concatenate(trajectories)
    states = everything[rng.integers(len(everything), size=_STARTS)]
    direction = rng.normal(size=(_STARTS, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    size = np.full(_STARTS, _FARTHEST_M)
    for _ in range(_HALVINGS):
        moved = pose.make(states[:, pose.POSITION] + size[:, None] * direction, states[:, pose.QUATERNION])
        size = np.where(trust.distance(moved) > 1.0, size / 2, size)
    return pose.make(states[:, pose.POSITION] + size[:, None] * direction, states[:, pose.QUATERNION])


def _arrives(
    move: Callable[[Array, Array], Array], starts: Array, task: Task, frame: StartFrame, limit: int
) -> np.ndarray:
    """Return whether the roll-out from each start (N, 7) reaches the goal in ``limit`` steps and stays, (N,).

    ``move`` gives the next poses (N, 7) of poses (N, 7) of roll-outs from starts (N, 7), and sets the starts that count
    from there on; the frame says whether their leg ends at the goal.
    """
    arrived = np.zeros(len(starts), dtype=bool)
    under_way, poses, begun = np.arange(len(starts)), starts, starts.copy()
    ends, starts = starts.copy(), starts.copy()
    for _ in range(limit):
        poses = move(poses, begun)
        there = _at_goal(poses, task) & frame.on_last_leg(begun)
        arrived[under_way[there]] = True
        ends[under_way[there]], starts[under_way[there]] = poses[there], begun[there]
        under_way, poses, begun = under_way[~there], poses[~there], begun[~there]
        if not len(under_way):
            break
    # A roll-out that only passes the goal has left it a few steps later.
    rest, begun = ends[arrived], starts[arrived]
    for _ in range(_REST_STEPS):
        rest = move(rest, begun)
    ends[arrived] = rest
    arrived[arrived] = _at_goal(ends[arrived], task)
    return arrived


def _at_goal(poses: Array, task: Task) -> np.ndarray:
    return np.asarray(pose.position_distance(poses, task.goal) <= task.goal_tolerance_m)
