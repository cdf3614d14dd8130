"""Fitting the intent model and its trust domain, cross-validated by leaving one demonstration out."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.resample import to_count, to_step
from koopdqn.errors import BadInputError
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.schema import FitReport
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.pose import Array
from koopdqn.tasks.path import arc_lengths
from koopdqn.tasks.task import TURNS_PER_STEP, Task

_PAPER_SAMPLES = 60
_PAPER_LARGEST_ERROR_M = 2.3e-3
_AXES = ("x", "y", "z")
_TURNS = ("about_x", "about_y", "about_z")


@dataclass(frozen=True)
class Fitted:
    """A fitted intent with what is known about it.

    Attributes:
        model: fitted to all demonstrations.
        trust: where to rely on it.
        report: the content of ``fit.json``.
    """

    model: IntentModel
    trust: TrustDomain
    report: dict[str, Any]


def agent_steps(demonstrations: Demonstrations, task: Task) -> list[Array]:
    """Return the demonstrations' poses (N, 7), each resampled to the agent's step."""
    turn = TURNS_PER_STEP * task.rotation_tolerance_rad
    return [to_step(item.poses, task.step_m, turn) for item in demonstrations.items]


def fit(
    demonstrations: Demonstrations,
    task: Task,
    intent: IntentSettings,
    trust: TrustSettings,
    advance: Callable[[int], None] = lambda done: None,
) -> Fitted:
    """Return the intent model, its trust domain and the cross-validation report.

    Args:
        demonstrations: of the task, at least two (one is left out at a time).
        task: gives goal, step and tolerances.
        intent: how the model is fitted.
        trust: how the domain is drawn.
        advance: told the number of folds done.

    Raises:
        BadInputError: the demonstrations are of another task, are too few, or do not end at the goal.
    """
    _check(demonstrations, task)
    trajectories = agent_steps(demonstrations, task)
    errors: list[Array] = []
    sizes: list[Array] = []
    rollouts: list[dict[str, float]] = []
    for index, held_out in enumerate(trajectories):
        fold = IntentModel.fit(trajectories[:index] + trajectories[index + 1 :], task, intent)
        errors.append(_errors(fold.predict(held_out[:-1]), held_out[1:]))
        rescaled = _errors(fold.preferred(held_out[:-1], task.step_m), held_out[1:])
        sizes.append(_sizes(errors[-1] if trust.error_of == "raw" else rescaled))
        rollouts.append(_roll_out_error(fold, held_out, task))
        advance(index + 1)
    model = IntentModel.fit(trajectories, task, intent)
    first = next(iter(model.matrices.values()))
    raw = [_sizes(error) for error in errors]
    report: dict[str, Any] = {
        "task": task.name,
        "intent": intent.name,
        "demonstrations": len(trajectories),
        "samples": [len(trajectory) for trajectory in trajectories],
        "step_m": task.step_m,
        "one_step_error_m": _error_summary([error[:, :3] for error in errors], _AXES),
        "one_step_error_per_step_m": _per_step([size[:, 0] for size in raw]),
        "one_step_error_rad": None,
        "one_step_error_per_step_rad": None,
        "roll_out_error_m": _summary_of_roll_outs(rollouts),
        "spectral_radius": first.spectral_radius(),
        "spectral_radius_rotation": None,
        "lifted_dimension": len(first.matrix),
        "trust": _coverage(trajectories, sizes, task, trust),
        "unmatched_share": unmatched_share(trajectories, task),
        "sixty_samples": _sixty_samples(demonstrations, task, intent),
    }
    if task.orientation == "learned":
        report["one_step_error_rad"] = _error_summary([error[:, 3:] for error in errors], _TURNS)
        report["one_step_error_per_step_rad"] = _per_step([size[:, 1] for size in raw])
        if "K_o" in model.matrices:
            report["spectral_radius_rotation"] = model.matrices["K_o"].spectral_radius()
    checked = FitReport.model_validate(report).model_dump(mode="json")
    return Fitted(model, TrustDomain.fit(trajectories, sizes, task.frame, trust), checked)


def _errors(predicted: Array, true: Array) -> Array:
    """Return x, y, z [m] and the rotation vector [rad] (N, 6) from true poses (N, 7) to predicted ones."""
    turn = pose.multiply(pose.conjugate(true[:, pose.QUATERNION]), predicted[:, pose.QUATERNION])
    position = predicted[:, pose.POSITION] - true[:, pose.POSITION]
    return np.concatenate([position, pose.to_rotation_vector(turn)], axis=1)


def _sizes(errors: Array) -> Array:
    return np.stack([np.linalg.norm(errors[:, :3], axis=1), np.linalg.norm(errors[:, 3:], axis=1)], axis=1)


def _check(demonstrations: Demonstrations, task: Task) -> None:
    if demonstrations.task != task.name:
        raise BadInputError(f"the demonstrations must be of task {task.name}, found task {demonstrations.task}")
    if len(demonstrations) < 2:
        raise BadInputError(f"there must be at least 2 demonstrations to leave one out, found {len(demonstrations)}")
    for index, item in enumerate(demonstrations.items):
        if not task.reached(item.poses[-1:])[0]:
            distance = float(pose.position_distance(item.poses[-1], task.goal))
            turn = float(pose.rotation_distance(item.poses[-1], task.goal))
            raise BadInputError(
                f"demonstration {index} must end within {task.goal_tolerance_m:g} m of the goal of task {task.name} and"
                f" {task.goal_rotation_tolerance_rad:g} rad, found {distance:.4f} m and {turn:.4f} rad"
            )
        length = float(arc_lengths(item.poses[:, pose.POSITION])[-1])
        if length < task.step_m:
            raise BadInputError(
                f"demonstration {index} must be at least one step of {task.step_m:g} m long, found {length:.2g} m"
            )


def _roll_out_error(model: IntentModel, held_out: Array, task: Task) -> dict[str, float]:
    steps = 2 * len(held_out)
    path = model.roll_out(held_out[:1], steps, task.step_m)[:, 0, pose.POSITION]
    target = held_out[:, pose.POSITION]
    gap = np.linalg.norm(path[:, None] - target[None], axis=2)
    final = float(np.linalg.norm(path[-1] - task.goal[pose.POSITION]))
    hausdorff = float(max(gap.min(axis=1).max(), gap.min(axis=0).max()))
    # A model that diverges ends far outside any workspace; JSON knows no infinity.
    return {"final": min(final, 1e3), "hausdorff": min(hausdorff, 1e3)}


def _summary_of_roll_outs(rollouts: list[dict[str, float]]) -> dict[str, Any]:
    finals = [r["final"] for r in rollouts]
    hausdorff = [r["hausdorff"] for r in rollouts]
    return {
        "final": finals,
        "hausdorff": hausdorff,
        "median_hausdorff": float(np.median(hausdorff)),
        "reached_goal": int(np.sum(np.array(finals) <= 5e-3)),
    }


def _error_summary(errors: list[Array], names: tuple[str, ...]) -> dict[str, Any]:
    together = np.concatenate(errors)
    sizes = np.linalg.norm(together, axis=1)
    rms = np.sqrt((together**2).mean(axis=0))
    return {
        "rms": float(np.sqrt((sizes**2).mean())),
        "mean": float(sizes.mean()),
        "max": float(sizes.max()),
        "rms_per_component": dict(zip(names, rms.tolist(), strict=True)),
        "max_per_component": dict(zip(names, np.abs(together).max(axis=0).tolist(), strict=True)),
    }


def _per_step(sizes: list[Array]) -> dict[str, list[float]]:
    longest = max(len(size) for size in sizes)
    at_step = [[size[t] for size in sizes if t < len(size)] for t in range(longest)]
    return {
        "mean": [float(np.mean(values)) for values in at_step],
        "max": [float(np.max(values)) for values in at_step],
    }


def _coverage(trajectories: list[Array], sizes: list[Array], task: Task, settings: TrustSettings) -> dict[str, Any]:
    shares, whole = [], []
    for index, held_out in enumerate(trajectories):
        others = [i for i in range(len(trajectories)) if i != index]
        fold = TrustDomain.fit([trajectories[i] for i in others], [sizes[i] for i in others], task.frame, settings)
        inside = fold.inside(held_out, np.arange(len(held_out)))
        shares.append(float(inside.mean()))
        whole.append(bool(inside.all()))
    return {
        "sigmas": settings.sigmas,
        "matching": settings.matching,
        "held_out_state_coverage": float(np.mean(shares)),
        "held_out_path_coverage": float(np.mean(whole)),
        "per_demonstration": shares,
    }


def unmatched_share(trajectories: list[Array], task: Task) -> float:
    """Return the share of demonstrated steps that no action can match within the task's tolerances."""
    from koopdqn.environment.actions import reached_poses

    unmatched = total = 0
    for trajectory in trajectories:
        candidates = reached_poses(trajectory[:-1], task)
        near = pose.position_distance(candidates, trajectory[1:, None]) <= task.position_tolerance_m
        turned = pose.rotation_distance(candidates, trajectory[1:, None]) <= task.rotation_tolerance_rad
        unmatched += int((~(near & turned).any(axis=1)).sum())
        total += len(trajectory) - 1
    return unmatched / total


def _sixty_samples(demonstrations: Demonstrations, task: Task, intent: IntentSettings) -> dict[str, float | None]:
    """Return the held-out one-step errors at the paper's sampling, beside those of predicting no motion."""
    trajectories = [to_count(item.poses, _PAPER_SAMPLES) for item in demonstrations.items]
    errors, motions = [], []
    for index, held_out in enumerate(trajectories):
        fold = IntentModel.fit(trajectories[:index] + trajectories[index + 1 :], task, intent)
        errors.append(_sizes(_errors(fold.predict(held_out[:-1]), held_out[1:])))
        moved = pose.position_distance(held_out[1:], held_out[:-1])
        motions.append(np.stack([moved, pose.rotation_distance(held_out[1:], held_out[:-1])], axis=1))
    error, motion = np.concatenate(errors), np.concatenate(motions)
    rms, persistence = (np.sqrt((rows**2).mean(axis=0)) for rows in (error, motion))
    turns = task.orientation == "learned"
    return {
        "rms_m": float(rms[0]),
        "persistence_rms_m": float(persistence[0]),
        "rms_over_persistence": float(rms[0] / persistence[0]),
        "max_m": float(error[:, 0].max()),
        "paper_max_m": _PAPER_LARGEST_ERROR_M if task.name == "shelf" else None,
        "rms_rad": float(rms[1]) if turns else None,
        "persistence_rms_rad": float(persistence[1]) if turns else None,
        "rms_over_persistence_rotation": float(rms[1] / persistence[1]) if turns else None,
        "max_rad": float(error[:, 1].max()) if turns else None,
    }
