"""Fitting the intents anew to a run's demonstrations: the paper's lift, the default, and what they are held against."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from koopdqn import pose
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.intent.fit import fit, sampled_at
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.intent.validation import sizes_of
from koopdqn.paths import to_count
from koopdqn.pose import Array
from koopdqn.tasks.task import Task

INTENTS: Final = ("paper", "pose", "line", "joint")
"""The compared options of the config group ``intent``, in the order of tables."""
SAMPLES: Final = 60
"""Poses of a demonstration in the comparison with the paper, whose figures mention steps up to 52."""


@dataclass(frozen=True)
class HeldOut:
    """How an intent fitted to the other demonstrations predicts one that it has not seen.

    Attributes:
        demonstration: which one is held out, from 0.
        error: (N - 1, 2) one-step errors of the raw prediction at the agent's step [m, rad].
        rescaled: (N - 1, 2) the same of the prediction rescaled to the agent's step [m, rad].
        asked: (N - 1,) whether the trust domain drawn from the others leaves a step to the expert.
        sixty: (59, 2) raw one-step errors with every demonstration resampled to 60 poses [m, rad].
    """

    demonstration: int
    error: Array
    rescaled: Array
    asked: np.ndarray
    sixty: Array

    def content(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "demonstration": self.demonstration,
            "one_step_error_m": self.error[:, 0].tolist(),
            "one_step_error_rad": self.error[:, 1].tolist(),
            "rescaled_one_step_error_m": self.rescaled[:, 0].tolist(),
            "rescaled_one_step_error_rad": self.rescaled[:, 1].tolist(),
            "asked": self.asked.tolist(),
            "sixty_samples_error_m": self.sixty[:, 0].tolist(),
            "sixty_samples_error_rad": self.sixty[:, 1].tolist(),
        }


@dataclass(frozen=True)
class IntentStudy:
    """An intent fitted to a run's demonstrations.

    Attributes:
        name: of the intent's config option.
        reward: how its rewards are made.
        report: the content of a ``fit.json``.
        held_out: the demonstration shown in figures, predicted by the others.
    """

    name: str
    reward: RewardSettings
    report: dict[str, Any]
    held_out: HeldOut

    def content(self) -> dict[str, Any]:
        """Return what the report's own file of it holds, as JSON values."""
        return {"fit": self.report, "held_out": self.held_out.content()}


def study(
    demonstrations: Demonstrations,
    task: Task,
    intent: IntentSettings,
    trust: TrustSettings,
    reward: RewardSettings,
    shown: int = 0,
) -> IntentStudy:
    """Return an intent's cross-validated report and its errors on one held-out demonstration.

    Args:
        demonstrations: of the task, at least two.
        task: gives goal, step and tolerances.
        intent: how the model is fitted.
        trust: how the trust domain is drawn.
        reward: how rewards are made.
        shown: which demonstration is held out.

    Raises:
        BadInputError: the demonstrations do not fit the task, or are too few.
    """
    fitted = fit(demonstrations, task, intent, trust, reward)
    intent = intent.with_ridge(fitted.report["ridge"])
    trajectories = [fold.held_out for fold in fitted.folds]
    domain = TrustDomain.fit(_without(trajectories, shown), _without(fitted.signs, shown), task.frame, trust)
    raw, rescaled = sizes_of(fitted.folds[shown].error), sizes_of(fitted.folds[shown].rescaled)
    inside = domain.inside(trajectories[shown], np.arange(len(trajectories[shown])))
    # As the reward does: the reached state must be trusted, by default the one before as well.
    asked = ~inside[1:] if trust.needs == "reached" else ~(inside[1:] & inside[:-1])
    held_out = HeldOut(shown, raw, rescaled, asked, _sixty(demonstrations, task, intent, shown))
    return IntentStudy(intent.name, reward, fitted.report, held_out)


def _sixty(demonstrations: Demonstrations, task: Task, intent: IntentSettings, shown: int) -> Array:
    trajectories = [to_count(item.poses, SAMPLES) for item in demonstrations.items]
    model = IntentModel.fit(_without(trajectories, shown), sampled_at(trajectories, task), intent)
    return _distances(model.predict(trajectories[shown][:-1]), trajectories[shown][1:])


def _without(items: list[Array], index: int) -> list[Array]:
    return items[:index] + items[index + 1 :]


def _distances(a: Array, b: Array) -> Array:
    """Return position [m] and rotation [rad] distances (N, 2) of poses (N, 7), Eqs. 15, 16."""
    return np.stack([pose.position_distance(a, b), pose.rotation_distance(a, b)], axis=1)
