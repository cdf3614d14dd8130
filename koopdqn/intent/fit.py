"""Fits the intent model and its trust domain, cross-validates them, and reports the results for ``fit.json``."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.intent.box import Box
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.reward import TRUSTED, IntentReward, RewardSettings
from koopdqn.intent.schema import FitReport
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.intent.tube import Tube
from koopdqn.intent.validation import (
    Fold,
    convergence,
    cross_validate,
    held_out_contained,
    jackknife_signs,
    left_out_share,
    length_ratio,
    sizes_of,
)
from koopdqn.paths import arc_lengths, hausdorff, to_count
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.actions import reached_poses, within_tolerance
from koopdqn.tasks.step import TURNS_PER_STEP
from koopdqn.tasks.task import Task, demonstrator_next_poses

_PAPER_SAMPLES = 60
_PAPER_LARGEST_ERROR_M = 2.3e-3


def roll_out_summary(folds: Sequence[Fold], task: Task) -> dict[str, Any] | None:
    """Return the errors of roll-outs from the start of each left-out demonstration; None without folds."""
    if not folds:
        return None
    # JSON has no infinity for a model that diverges.
    finals, apart = (
        np.minimum(each, 1e3).tolist() for each in zip(*(_roll_out_error(f, task) for f in folds), strict=True)
    )
    return {
        "final": finals,
        "hausdorff": apart,
        "median_hausdorff": float(np.median(apart)),
        "reached_goal": int(np.sum(np.array(finals) <= 5e-3)),
    }


def _roll_out_error(fold: Fold, task: Task) -> tuple[float, float]:
    """Return the final distance [m] of a fold's roll-out from the goal, and the Hausdorff distance to the fold."""
    steps = 2 * len(fold.held_out)
    path = fold.model.roll_out(fold.held_out[:1], steps, task.step_m)[:, 0, pose.POSITION]
    final = float(np.linalg.norm(path[-1] - task.goal[pose.POSITION]))
    return final, hausdorff(path, fold.held_out[:, pose.POSITION])


def trust_summary(
    domain: TrustDomain, trajectories: list[Array], contained: Sequence[np.ndarray], fresh: list[Array]
) -> dict[str, Any]:
    """Return width and coverage of a trust domain fitted to demonstrated poses (N, 7), as in ``fit.json``.

    ``contained`` is that of :func:`held_out_contained`; to fresh demonstrations (N, 7) nothing was fitted.
    """
    settings = domain.settings
    tube = domain if isinstance(domain, Tube) else None
    shares, whole = [float(each.mean()) for each in contained], [bool(each.all()) for each in contained]
    return {
        "sigmas": domain.settings.sigmas if isinstance(domain, Box) else None,
        "matching": domain.settings.matching if isinstance(domain, Box) else "any",
        "nominal_coverage": settings.nominal(trajectories),
        "fresh": len(fresh),
        "measured_coverage": path_coverage(domain, fresh) if fresh else None,
        "radius_m": None if tube is None else float(np.median(tube.radius[:, 0])),
        "largest_radius_m": None if tube is None else float(tube.radius[:, 0].max()),
        "radius_rad": None if tube is None else float(np.median(tube.radius[:, 1])),
        "spread_m": None if tube is None or len(trajectories) == 1 else float(np.median(tube.spread[:, 0])),
        "known_share": float(domain.known.mean()),
        "held_out_state_coverage": float(np.mean(shares)) if shares else None,
        "held_out_path_coverage": float(np.mean(whole)) if whole else None,
        "per_demonstration": shares or None,
    }


def right_summary(folds: Sequence[Fold], reward: IntentReward, fresh: list[Array]) -> dict[str, float | None]:
    """Return the shares of rewards whose sign is right, in the folds and by what was fitted to all demonstrations.

    To fresh demonstrations (N, 7), as recorded, nothing was fitted.
    """
    trust, prediction = reward.trust, reward.settings.prediction
    doubt = float(np.median(trust.doubt))
    return {
        "least_right": trust.settings.least_right,
        "doubt": doubt if np.isfinite(doubt) else None,
        "right_share": float(trust.right[trust.known].mean()) if folds and trust.known.any() else None,
        "left_out_right_share": left_out_share(folds, reward.task, prediction, trust.settings.doubts[0]),
        "fresh_right_share": _trusted_right(reward, fresh) if fresh else None,
    }


def _trusted_right(reward: IntentReward, trajectories: list[Array]) -> float | None:
    """Return the share of trusted rewards along pose trajectories (N, 7) that the demonstrator agrees with."""
    right = of = 0
    for rows in trajectories:
        before, starts = rows[:-1], reward.task.begun(rows, hindsight=True)[:-1]
        evaluation = reward.evaluate_actions(before, np.arange(len(before)), starts)
        wished = demonstrator_next_poses(reward.task, before, starts)
        agrees = within_tolerance(evaluation.reached, wished[:, None], reward.task) == (evaluation.reward >= 0)
        trusted = evaluation.source == TRUSTED
        right, of = right + int((agrees & trusted).sum()), of + int(trusted.sum())
    return right / of if of else None


def path_coverage(domain: TrustDomain, trajectories: list[Array]) -> float:
    """Return the share of pose trajectories (N, 7) that a domain's shape contains from end to end."""
    inside = (domain.shape_contains(rows, np.arange(len(rows)))[0].all() for rows in trajectories)
    return float(np.mean(list(inside)))


def sampled_at(trajectories: list[Array], task: Task) -> Task:
    """Return a task whose step is the median distance of neighbours in pose trajectories (N, 7)."""
    steps = np.concatenate([pose.position_distance(rows[1:], rows[:-1]) for rows in trajectories])
    return task.model_copy(update={"step_m": float(np.median(steps))})


def sixty_samples(
    demonstrations: Demonstrations, task: Task, intent: IntentSettings
) -> tuple[dict[str, float | None] | None, list[Array]]:
    """Return a summary of the held-out one-step errors at the paper's sampling, and the errors themselves.

    The errors are (N, 2) [m, rad] for each demonstration, N = 59 unless its path is unfolded. Both are empty for a
    single demonstration.
    """
    if len(demonstrations) == 1:
        return None, []
    trajectories = [to_count(item.poses, _PAPER_SAMPLES) for item in demonstrations.items]
    task = sampled_at(trajectories, task)
    trajectories = intent.start_frame(trajectories, task).each_unseen(trajectories)
    errors, motions = [], []
    for index, held_out in enumerate(trajectories):
        others = trajectories[:index] + trajectories[index + 1 :]
        fold = next(iter(intent.alternatives(others, task).values()))
        errors.append(sizes_of(pose.difference(fold.predict(held_out[:-1]), held_out[1:])))
        moved = pose.position_distance(held_out[1:], held_out[:-1])
        motions.append(np.stack([moved, pose.rotation_distance(held_out[1:], held_out[:-1])], axis=1))
    error, motion = np.concatenate(errors), np.concatenate(motions)
    rms, persistence = (np.sqrt((rows**2).mean(axis=0)) for rows in (error, motion))
    turns = task.orientation == "learned"
    summary = {
        "rms_m": float(rms[0]),
        "persistence_rms_m": float(persistence[0]),
        "rms_over_persistence": float(rms[0] / persistence[0]),
        "max_m": float(error[:, 0].max()),
        "paper_max_m": _PAPER_LARGEST_ERROR_M if task.name == "shelf" else None,
        "rms_rad": float(rms[1]) if turns else None,
        "persistence_rms_rad": float(persistence[1]) if turns else None,
        "rms_over_persistence_rotation": float(rms[1] / persistence[1]) if turns and persistence[1] > 0.0 else None,
        "max_rad": float(error[:, 1].max()) if turns else None,
    }
    return summary, errors


_AXES = ("x", "y", "z")
_TURNS = ("about_x", "about_y", "about_z")


class FitSettings(Settings):
    """What ``koopdqn fit`` measures in addition."""

    fresh: int = Field(ge=0, le=1000, description="demonstrations generated to measure the trust domain's coverage on")
    seed: int = Field(ge=0, description="of those; different from the demonstrations' seed")


@dataclass(frozen=True)
class Fitted:
    """A fitted intent and its cross-validation.

    Attributes:
        model: fitted to all demonstrations.
        trust: its trust domain.
        report: the content of ``fit.json``.
        folds: of the cross-validation, one for each demonstration; none for a single one.
        contained: (N,) for each fold, whether the trust domain of the others contains each pose.
        sixty: (N, 2) [m, rad] for each fold, its errors at the paper's sampling.
    """

    model: IntentModel
    trust: TrustDomain
    report: dict[str, Any]
    folds: tuple[Fold, ...]
    contained: list[np.ndarray]
    sixty: list[Array]


def agent_steps(demonstrations: Demonstrations, task: Task) -> list[Array]:
    """Return the demonstrations' poses (N, 7), each resampled to the agent's step."""
    return demonstrations.resampled(task.step_m, TURNS_PER_STEP * task.rotation_tolerance_rad)


def fit(
    demonstrations: Demonstrations,
    task: Task,
    intent: IntentSettings,
    trust: TrustSettings,
    reward: RewardSettings,
    advance: Callable[[int], None] = lambda done: None,
    fresh: Demonstrations | None = None,
) -> Fitted:
    """Return the intent model, its trust domain and the cross-validation report.

    Args:
        demonstrations: of the task; without cross-validation if there is only one.
        task: gives goal, step and tolerances.
        intent: how the model is fitted.
        trust: how the domain is fitted.
        reward: how rewards are made; the domain is calibrated on their signs.
        advance: called with the number of folds done.
        fresh: further demonstrations, on which the trust domain is measured.

    Raises:
        BadInputError: the demonstrations are of another task, or do not end at the goal.
    """
    check_shown(demonstrations, task)
    shown = agent_steps(demonstrations, task)
    frame = intent.start_frame(shown, task)
    trajectories = frame.each_unseen(shown)
    found = cross_validate(trajectories, task, intent, advance)
    model = intent.with_ridge(found.ridge).fit(trajectories, task).within(frame)
    # A single demonstration cannot be left out: all its signs count as right.
    signs = jackknife_signs(found.folds, intent.mean(trajectories, task), task, reward.prediction, trust.doubts)
    if not signs:
        signs = [np.ones((len(trajectories[0]) - 1, len(trust.doubts), 2))]
    domain = trust.fit(trajectories, signs, task.frame)
    first = next(iter(model.matrices.values()))
    turning = model.matrices.get("K_o")
    learned = task.orientation == "learned"
    raw = [sizes_of(fold.error) for fold in found.folds]
    unseen = agent_steps(fresh, task) if fresh else []
    converging, converging_wide = convergence(model, domain, trajectories, task)
    contained = held_out_contained(trajectories, signs, task, trust)
    at_sixty, sixty = sixty_samples(demonstrations, task, intent.with_ridge(found.ridge))
    report: dict[str, Any] = {
        "task": task.name,
        "intent": intent.name,
        "demonstrations": len(trajectories),
        "samples": [len(trajectory) for trajectory in trajectories],
        "step_m": task.step_m,
        "one_step_error_m": _error_summary([fold.error[:, :3] for fold in found.folds], _AXES),
        "one_step_error_per_step_m": _per_step([size[:, 0] for size in raw]),
        "one_step_error_rad": _error_summary([fold.error[:, 3:] for fold in found.folds], _TURNS) if learned else None,
        "one_step_error_per_step_rad": _per_step([size[:, 1] for size in raw]) if learned else None,
        "roll_out_error_m": roll_out_summary(found.folds, task),
        "converges": converging == 1.0,
        "converging_share": converging,
        "converging_share_wide": converging_wide,
        "length_ratio": length_ratio(model, trajectories, task),
        "ridge": found.ridge,
        "regularisation": [
            {"ridge": ridge, "multi_step_error_m": error} for ridge, error in sorted(found.multi_step.items())
        ],
        "spectral_radius": first.spectral_radius(),
        "spectral_radius_rotation": None if turning is None else turning.spectral_radius(),
        "lifted_dimension": len(first.matrix),
        "trust": {
            **trust_summary(domain, trajectories, contained, frame.each(unseen)),
            **right_summary(found.folds, IntentReward(task, model, domain, reward), unseen),
        },
        "unmatched_share": unmatched_share(trajectories, task),
        "sixty_samples": at_sixty,
    }
    checked = FitReport.model_validate(report).model_dump(mode="json")
    return Fitted(model, domain, checked, found.folds, contained, sixty)


def check_shown(demonstrations: Demonstrations, task: Task) -> None:
    """Raise BadInputError unless demonstrations are of a task, end at its goal and are at least a step long."""
    if demonstrations.task != task.name:
        raise BadInputError(f"the demonstrations must be of task {task.name}, found task {demonstrations.task}")
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


def _error_summary(errors: list[Array], names: tuple[str, ...]) -> dict[str, Any] | None:
    if not errors:
        return None
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


def _per_step(sizes: list[Array]) -> dict[str, list[float]] | None:
    if not sizes:
        return None
    longest = max(len(size) for size in sizes)
    at_step = [[size[t] for size in sizes if t < len(size)] for t in range(longest)]
    return {
        "mean": [float(np.mean(values)) for values in at_step],
        "max": [float(np.max(values)) for values in at_step],
    }


def unmatched_share(trajectories: list[Array], task: Task) -> float:
    """Return the share of demonstrated steps that no action matches within the task's tolerances."""
    unmatched = total = 0
    for trajectory in trajectories:
        candidates = reached_poses(trajectory[:-1], task)
        near = pose.position_distance(candidates, trajectory[1:, None]) <= task.position_tolerance_m
        turned = pose.rotation_distance(candidates, trajectory[1:, None]) <= task.rotation_tolerance_rad
        unmatched += int((~(near & turned).any(axis=1)).sum())
        total += len(trajectory) - 1
    return unmatched / total
