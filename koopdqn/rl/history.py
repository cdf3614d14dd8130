"""What happened during training, for ``train.json``, curves and checkpoint; and the checks on held-out starts."""

from copy import deepcopy
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import SOURCES
from koopdqn.intent.tube import scaled_distances
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy
from koopdqn.rl.settings import TrainSettings
from koopdqn.tasks.rollout import SUCCESS, roll_out
from koopdqn.tasks.task import TURNS_PER_STEP
from koopdqn.tasks.workcell import Workcell

# Below this [m, or of a quaternion's entries] a roll-out has come to rest.
_AT_REST = 1e-9


@dataclass(frozen=True)
class Check:
    """One check of the policy on held-out starts during training."""

    updates: int
    env_steps: int
    episodes: int
    success_rate: float
    intent_distance: float
    failures: dict[str, int]


@dataclass
class History:
    """What happened, for ``train.json`` and the curves.

    Attributes:
        rewards: reward gathered in each finished episode.
        lengths: steps of each finished episode.
        exploring: whether each was a short one, for exploring.
        losses: mean loss between checks.
        checks: all checks.
        judged: rewards given, by source (:data:`~koopdqn.intent.reward.SOURCES`).
        agreed: of those, how many the demonstrator agrees with.
    """

    rewards: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    exploring: list[bool] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    judged: np.ndarray = field(default_factory=lambda: np.zeros(len(SOURCES), dtype=np.int64))
    agreed: np.ndarray = field(default_factory=lambda: np.zeros(len(SOURCES), dtype=np.int64))

    def state(self) -> dict[str, Any]:
        """Return everything held, as JSON values."""
        return {**asdict(self), "judged": self.judged.tolist(), "agreed": self.agreed.tolist()}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> "History":
        """Return the history that :meth:`state` described."""
        own = deepcopy(state)
        arrays = {name: np.array(own[name], dtype=np.int64) for name in ("judged", "agreed")}
        return cls(**{**own, **arrays, "checks": [Check(**check) for check in own["checks"]]})

    def agreement(self) -> dict[str, float | None]:
        """Return the share of rewards that agree with the demonstrator, by source; None where none was given."""
        return {
            name: float(self.agreed[i] / self.judged[i]) if self.judged[i] else None
            for i, name in enumerate(SOURCES)
            if name != "rule"
        }

    def counts(self) -> dict[str, int]:
        """Return how many rewards came from each source whose rewards can be compared with the demonstrator."""
        return {name: int(self.judged[i]) for i, name in enumerate(SOURCES) if name != "rule"}


class Checker:
    """Tries policies from the same starts each time."""

    def __init__(self, workcell: Workcell, model: IntentModel, settings: TrainSettings, step_limit: int) -> None:
        """Draw the starts: ``settings.check_starts``, by ``settings.check_seed``; episodes end after ``step_limit``.

        ``model`` is the intent as it was fitted, whose roll-outs paths are compared with.
        """
        self._workcell = workcell
        self._model = model
        self._step_limit = step_limit
        rng = np.random.default_rng([settings.check_seed, 3])
        self._starts, self._joints, _ = workcell.reachability.draw_starts(workcell.task, rng, settings.check_starts)

    def measure(self, policy: Policy) -> tuple[float, float, dict[str, int]]:
        """Return a policy's success rate, its distance from the intent's own roll-out, and failed starts by cause.

        The distance is the mean, over the poses of its paths, of that to the nearest pose of the roll-out from the same
        start: in steps of position or in turns in place, whichever is more.
        """
        workcell, task = self._workcell, self._workcell.task
        begun = self._starts, self._joints, self._step_limit
        episodes = roll_out(policy, task, workcell.reachability, *begun, cut_circles=True)
        outcomes = [episode.outcome for episode in episodes]
        failures = {name: outcomes.count(name) for name in sorted(set(outcomes) - {SUCCESS})}
        intended = self._intended
        unit = np.tile([task.step_m, TURNS_PER_STEP * task.rotation_tolerance_rad], (len(intended), 1))
        each = [
            scaled_distances(episode.poses, intended[:, index], unit).min(axis=1)
            for index, episode in enumerate(episodes)
        ]
        return outcomes.count(SUCCESS) / len(outcomes), float(np.concatenate(each).mean()), failures

    @cached_property
    def _intended(self) -> Array:
        """The poses (T, N, 7) that follow one another by the intent alone from the checks' starts, until they rest."""
        poses = [self._starts]
        for _ in range(self._step_limit):
            wished = self._model.intended(poses[-1], self._starts)
            poses.append(self._model.to_step(poses[-1], wished, self._workcell.task.step_m))
            if np.abs(poses[-1] - poses[-2]).max() < _AT_REST:
                break
        return np.array(poses)
