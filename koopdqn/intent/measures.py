"""What ``fit.json`` says beyond one-step errors: roll-outs, the trust domain's coverage, the paper's sampling."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.resample import to_count
from koopdqn.environment.compare import within_tolerance
from koopdqn.environment.reward import TRUSTED, IntentReward
from koopdqn.feedback.scripted import demonstrator_wishes
from koopdqn.intent.box import Box
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.signs import left_out
from koopdqn.intent.trust import TrustDomain
from koopdqn.intent.tube import Tube
from koopdqn.intent.validation import Fold, differences, sizes_of
from koopdqn.pose import Array
from koopdqn.tasks.path import hausdorff
from koopdqn.tasks.task import Task

_PAPER_SAMPLES = 60
_PAPER_LARGEST_ERROR_M = 2.3e-3


def roll_out_summary(folds: Sequence[Fold], task: Task) -> dict[str, Any] | None:
    """Return how far models followed from the start of what they have not seen end from the goal, and pass from it."""
    if not folds:
        return None
    rollouts = [_roll_out_error(fold.model, fold.held_out, task) for fold in folds]
    finals, apart = ([r[key] for r in rollouts] for key in ("final", "hausdorff"))
    return {
        "final": finals,
        "hausdorff": apart,
        "median_hausdorff": float(np.median(apart)),
        "reached_goal": int(np.sum(np.array(finals) <= 5e-3)),
    }


def _roll_out_error(model: IntentModel, held_out: Array, task: Task) -> dict[str, float]:
    steps = 2 * len(held_out)
    path = model.roll_out(held_out[:1], steps, task.step_m)[:, 0, pose.POSITION]
    target = held_out[:, pose.POSITION]
    final = float(np.linalg.norm(path[-1] - task.goal[pose.POSITION]))
    far = hausdorff(path, target)
    # A model that diverges ends far outside any workspace; JSON knows no infinity.
    return {"final": min(final, 1e3), "hausdorff": min(far, 1e3)}


def trust_summary(
    domain: TrustDomain, trajectories: list[Array], signs: list[Array], task: Task, fresh: list[Array]
) -> dict[str, Any]:
    """Return width and coverage of a trust domain.

    Args:
        domain: drawn from all demonstrations.
        trajectories: their poses (N, 7).
        signs: (N − 1, L, 2) of each, that it was drawn with.
        task: gives the frame of angles.
        fresh: poses (N, 7) of demonstrations that nothing was fitted to.
    """
    settings, count = domain.settings, len(trajectories)
    tube = domain if isinstance(domain, Tube) else None
    shares, whole = [], []
    for index, held_out in enumerate(trajectories if count > 1 else []):
        others = [i for i in range(count) if i != index]
        fold = TrustDomain.fit([trajectories[i] for i in others], [signs[i] for i in others], task.frame, settings)
        inside = fold.inside(held_out, np.arange(len(held_out)))
        shares.append(float(inside.mean()))
        whole.append(bool(inside.all()))
    return {
        "sigmas": domain.settings.sigmas if isinstance(domain, Box) else None,
        "matching": domain.settings.matching if isinstance(domain, Box) else "any",
        "nominal_coverage": settings.nominal(count),
        "fresh": len(fresh),
        "measured_coverage": path_coverage(domain, fresh) if fresh else None,
        "radius_m": None if tube is None else float(np.median(tube.radius[:, 0])),
        "largest_radius_m": None if tube is None else float(tube.radius[:, 0].max()),
        "radius_rad": None if tube is None else float(np.median(tube.radius[:, 1])),
        "spread_m": None if tube is None or count == 1 else float(np.median(tube.spread[:, 0])),
        "known_share": float(domain.known.mean()),
        "held_out_state_coverage": float(np.mean(shares)) if shares else None,
        "held_out_path_coverage": float(np.mean(whole)) if whole else None,
        "per_demonstration": shares or None,
    }


def right_summary(folds: Sequence[Fold], reward: IntentReward, fresh: list[Array]) -> dict[str, float | None]:
    """Return how often the signs of rewards are right.

    Args:
        folds: of the cross-validation.
        reward: by the model and the trust domain fitted to all demonstrations.
        fresh: poses (N, 7) of demonstrations that nothing was fitted to, not placed.
    """
    trust, prediction = reward.trust, reward.settings.prediction
    doubt = float(np.median(trust.doubt))
    return {
        "least_right": trust.settings.least_right,
        "doubt": doubt if np.isfinite(doubt) else None,
        "right_share": float(trust.right[trust.known].mean()) if folds and trust.known.any() else None,
        "left_out_right_share": left_out(folds, reward.task, prediction, trust.settings.doubts[0]) if folds else None,
        "fresh_right_share": _trusted_right(reward, fresh) if fresh else None,
    }


def _trusted_right(reward: IntentReward, trajectories: list[Array]) -> float | None:
    """Return the share of trusted rewards along pose trajectories (N, 7) that agree with the task's person."""
    right = of = 0
    for rows in trajectories:
        before, starts = rows[:-1], np.repeat(rows[:1], len(rows) - 1, axis=0)
        judged = reward.judge(before, np.arange(len(before)), starts)
        wished = demonstrator_wishes(reward.task, before, starts)
        agrees = within_tolerance(judged.reached, wished[:, None], reward.task) == (judged.reward >= 0)
        trusted = judged.source == TRUSTED
        right, of = right + int((agrees & trusted).sum()), of + int(trusted.sum())
    return right / of if of else None


def path_coverage(domain: TrustDomain, trajectories: list[Array]) -> float:
    """Return the share of pose trajectories (N, 7) that a domain's shape holds from end to end."""
    return float(np.mean([bool((domain.distance(rows) <= 1.0).all()) for rows in trajectories]))


def sampled_at(trajectories: list[Array], task: Task) -> Task:
    """Return a task whose step is the median distance of neighbours in pose trajectories (N, 7)."""
    steps = np.concatenate([pose.position_distance(rows[1:], rows[:-1]) for rows in trajectories])
    return task.model_copy(update={"step_m": float(np.median(steps))})


def sixty_samples(demonstrations: Demonstrations, task: Task, intent: IntentSettings) -> dict[str, float | None] | None:
    """Return the held-out one-step errors at the paper's sampling, beside those of predicting no motion."""
    if len(demonstrations) == 1:
        return None
    trajectories = [to_count(item.poses, _PAPER_SAMPLES) for item in demonstrations.items]
    task = sampled_at(trajectories, task)
    errors, motions = [], []
    for index, held_out in enumerate(trajectories):
        others = trajectories[:index] + trajectories[index + 1 :]
        fold = next(iter(intent.alternatives(others, task).values()))
        errors.append(sizes_of(differences(fold.predict(held_out[:-1]), held_out[1:])))
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
