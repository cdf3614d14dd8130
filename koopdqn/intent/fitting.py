"""Fitting the intent model and its trust domain, cross-validated by leaving one demonstration out."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.resample import to_step
from koopdqn.environment.reward import IntentReward, RewardSettings
from koopdqn.errors import BadInputError
from koopdqn.intent.convergence import convergence
from koopdqn.intent.measures import right_summary, roll_out_summary, sixty_samples, trust_summary
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.schema import FitReport
from koopdqn.intent.signs import jackknifed
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.intent.validation import Fold, cross_validate, sizes_of
from koopdqn.pose import Array
from koopdqn.tasks.path import arc_lengths
from koopdqn.tasks.task import TURNS_PER_STEP, Task

_AXES = ("x", "y", "z")
_TURNS = ("about_x", "about_y", "about_z")


class FitSettings(Settings):
    """What ``koopdqn fit`` measures beside fitting."""

    fresh: int = Field(ge=0, le=1000, description="demonstrations generated to measure the trust domain's coverage on")
    seed: int = Field(ge=0, description="of those; another than the demonstrations'")


@dataclass(frozen=True)
class Fitted:
    """A fitted intent with what is known about it.

    Attributes:
        model: fitted to all demonstrations.
        trust: where to rely on it.
        report: the content of ``fit.json``.
        folds: of the cross-validation, one for each demonstration; none for a single one.
        signs: (N − 1, L, 2) for each demonstration, as :meth:`TrustDomain.fit` takes them.
    """

    model: IntentModel
    trust: TrustDomain
    report: dict[str, Any]
    folds: tuple[Fold, ...]
    signs: list[Array]


def agent_steps(demonstrations: Demonstrations, task: Task) -> list[Array]:
    """Return the demonstrations' poses (N, 7), each resampled to the agent's step."""
    turn = TURNS_PER_STEP * task.rotation_tolerance_rad
    return to_step([item.poses for item in demonstrations.items], task.step_m, turn)


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
        demonstrations: of the task. One is left out at a time; of a single one nothing can be measured.
        task: gives goal, step and tolerances.
        intent: how the model is fitted.
        trust: how the domain is drawn.
        reward: how rewards are made; the domain is calibrated on their signs.
        advance: told the number of folds done.
        fresh: further demonstrations, which the trust domain is measured on.

    Raises:
        BadInputError: the demonstrations are of another task, or do not end at the goal.
    """
    _check(demonstrations, task)
    shown = agent_steps(demonstrations, task)
    frame = intent.start_frame(shown, task)
    trajectories = frame.each(shown)
    found = cross_validate(trajectories, task, intent, advance)
    model = IntentModel.fit(trajectories, task, intent.with_ridge(found.ridge)).within(frame)
    # Of a single demonstration nothing can be left out, and nothing speaks against it.
    signs = jackknifed(found.folds, trajectories, task, reward.prediction, trust.doubts)
    if not signs:
        signs = [np.ones((len(trajectories[0]) - 1, len(trust.doubts), 2))]
    domain = TrustDomain.fit(trajectories, signs, task.frame, trust)
    first = next(iter(model.matrices.values()))
    turning = model.matrices.get("K_o")
    learned = task.orientation == "learned"
    raw = [sizes_of(fold.error) for fold in found.folds]
    unseen = agent_steps(fresh, task) if fresh else []
    region = convergence(model, domain, trajectories, task)
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
        "converges": region.demonstrated == 1.0,
        "converging_share": region.demonstrated,
        "converging_share_wide": region.wide,
        "ridge": found.ridge,
        "regularisation": [
            {"ridge": ridge, "multi_step_error_m": error} for ridge, error in sorted(found.multi_step.items())
        ],
        "spectral_radius": first.spectral_radius(),
        "spectral_radius_rotation": None if turning is None else turning.spectral_radius(),
        "lifted_dimension": len(first.matrix),
        "trust": {
            **trust_summary(domain, trajectories, signs, task, frame.each(unseen)),
            **right_summary(found.folds, IntentReward(task, model, domain, reward), unseen),
        },
        "unmatched_share": unmatched_share(trajectories, task),
        "sixty_samples": sixty_samples(demonstrations, task, intent.with_ridge(found.ridge)),
    }
    checked = FitReport.model_validate(report).model_dump(mode="json")
    return Fitted(model, domain, checked, found.folds, signs)


def _check(demonstrations: Demonstrations, task: Task) -> None:
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
