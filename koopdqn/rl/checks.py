"""How a training goes: checks of the policy on held-out starts, whether the task is learned, and the history."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import SOURCES
from koopdqn.intent.tube import scaled_distances
from koopdqn.pose import Array
from koopdqn.rl.settings import TrainSettings
from koopdqn.tasks.moved_goals import draw_starts
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, roll_out
from koopdqn.tasks.step import TURNS_PER_STEP
from koopdqn.tasks.workcell import Workcell

# A check so many times as far from the intent as the first that passed shows a policy that is not settled.
_ASTRAY = 1.5
# A path so many times as far from the intent as the nearest actions lead, or as two steps, goes another way.
_ANOTHER_WAY, _NEAR_STEPS = 2.0, 2.0
# So many times as many checks must say that such a path comes no nearer.
_PATIENCE = 3


@dataclass(frozen=True)
class Check:
    """One check of the policy on held-out starts during training."""

    updates: int
    env_steps: int
    episodes: int
    success_rate: float
    intent_distance: float
    failures: dict[str, int]


class Checker:
    """Measures policies from fixed starts.

    Attributes:
        path: (T, 7) poses of the latest measured policy from the first start; empty before.
    """

    def __init__(self, workcell: Workcell, model: IntentModel, settings: TrainSettings, step_limit: int) -> None:
        """Draw the starts as ``settings`` say; episodes end after ``step_limit`` steps.

        Paths are compared with roll-outs of ``model``, the intent as it was fitted.
        """
        self._workcell = workcell
        self._model = model
        self._step_limit = step_limit
        self.path: Array = np.zeros((0, 7))
        self._measured: list[Episode] = []
        rng = np.random.default_rng([settings.check_seed, 3])
        drawn = draw_starts(workcell, workcell.task, rng, settings.check_starts)
        self._starts, self._joints, self._moved = drawn.starts, drawn.joints, drawn.moved

    def measure(self, policy: Controller) -> tuple[float, float, dict[str, int]]:
        """Return a policy's success rate, its distance from the intent's roll-outs, and failures by cause.

        The distance is the mean, over the poses of its paths, of that to the nearest pose of the roll-out from the same
        start, in steps of position or in five rotation tolerances of turn, whichever is larger.
        """
        episodes = self._measured = self._rolled_out(policy)
        self.path = episodes[0].poses
        outcomes = [episode.outcome for episode in episodes]
        failures = {name: outcomes.count(name) for name in sorted(set(outcomes) - {SUCCESS})}
        return outcomes.count(SUCCESS) / len(outcomes), self._from_intent(dict(enumerate(episodes))), failures

    def goes_another_way(self, nearest: Controller) -> bool:
        """Return whether the latest measured policy is far from the intent beside the actions nearest to it.

        Far is twice their distance, and more than four steps, from the starts from which both succeed.
        """
        own = _arrived(self._measured)
        if not own or self._from_intent(own) <= _ANOTHER_WAY * _NEAR_STEPS:
            return False
        theirs = _arrived(self._rolled_out(nearest))
        both = own.keys() & theirs.keys()
        if not both:
            return False
        far, near = (self._from_intent({index: found[index] for index in both}) for found in (own, theirs))
        return far > _ANOTHER_WAY * max(near, _NEAR_STEPS)

    def _rolled_out(self, controller: Controller) -> list[Episode]:
        workcell, task = self._workcell, self._workcell.task
        begun = self._starts, self._joints, self._step_limit
        return roll_out(controller, task, workcell.reachability, *begun, cut_circles=True, moved=self._moved)

    def _from_intent(self, episodes: dict[int, Episode]) -> float:
        """Return the distance of episodes, by their starts' numbers, from the intent's roll-outs from the same."""
        task, intended = self._workcell.task, self._intended
        unit = np.tile([task.step_m, TURNS_PER_STEP * task.rotation_tolerance_rad], (len(intended), 1))
        each = [
            scaled_distances(episode.poses, intended[:, index], unit).min(axis=1) for index, episode in episodes.items()
        ]
        return float(np.concatenate(each).mean())

    @cached_property
    def _intended(self) -> Array:
        """The intent's roll-outs (T, N, 7) from the starts, until they rest."""
        return self._model.intended_paths(self._starts, self._step_limit, self._workcell.task.step_m)


def _arrived(episodes: list[Episode]) -> dict[int, Episode]:
    """Return the episodes that succeeded, by the numbers of their starts."""
    return {index: episode for index, episode in enumerate(episodes) if episode.outcome == SUCCESS}


@dataclass
class Progress:
    """The best check so far, and whether the task is learned: quality has stopped improving.

    Attributes:
        learned_at: actions tried when it was learned, or −1.
        passed: checks passed in a row, none nearer to the intent than the first by the gain; one that is far astray is
            not counted.
        first_distance: distance of the first of these from the intent.
        best_success: success rate of the best check; −1 before the first.
        best_distance: its distance from the intent.
        best_update: updates made before it.
    """

    learned_at: int = -1
    passed: int = 0
    first_distance: float = 0.0
    best_success: float = -1.0
    best_distance: float = 0.0
    best_update: int = 0

    @property
    def learned(self) -> bool:
        """Whether enough checks in a row were passed."""
        return self.learned_at >= 0

    def add(self, check: Check, settings: TrainSettings, goes_another_way: Callable[[], bool] = lambda: False) -> bool:
        """Add a check; return whether it is the best so far.

        Where its policy ``goes_another_way``, which is asked when the task would be learned, more checks are needed.
        """
        if check.success_rate < settings.check_success:
            self.passed = 0
        elif self.passed and check.intent_distance > _ASTRAY * self.first_distance:
            # It confirms nothing; the next one may.
            pass
        elif self.passed and check.intent_distance >= (1.0 - settings.gain) * self.first_distance:
            self.passed += 1
        else:
            self.passed, self.first_distance = 1, check.intent_distance
        needed = settings.checks_to_learn
        if not self.learned and self.passed >= needed and (self.passed >= _PATIENCE * needed or not goes_another_way()):
            self.learned_at = check.env_steps
        best = (check.success_rate, -check.intent_distance) >= (self.best_success, -self.best_distance)
        if best:
            self.best_success, self.best_distance = check.success_rate, check.intent_distance
            self.best_update = check.updates
        return best


@dataclass
class History:
    """The history of a training run.

    Attributes:
        rewards: return of each finished episode.
        lengths: steps of each finished episode.
        exploring: whether each was a short exploring one.
        losses: mean loss between checks.
        checks: all checks.
        labelled: number of rewards by source (:data:`~koopdqn.intent.reward.SOURCES`).
        agreed: number of those that the demonstrator agrees with.
    """

    rewards: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    exploring: list[bool] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    checks: list[Check] = field(default_factory=list)
    labelled: np.ndarray = field(default_factory=lambda: np.zeros(len(SOURCES), dtype=np.int64))
    agreed: np.ndarray = field(default_factory=lambda: np.zeros(len(SOURCES), dtype=np.int64))

    def state(self) -> dict[str, Any]:
        """Return the history as JSON values."""
        return {**asdict(self), "labelled": self.labelled.tolist(), "agreed": self.agreed.tolist()}

    @classmethod
    def restored(cls, state: dict[str, Any]) -> "History":
        """Return the history with these :meth:`state` values."""
        own = deepcopy(state)
        arrays = {name: np.array(own[name], dtype=np.int64) for name in ("labelled", "agreed")}
        return cls(**{**own, **arrays, "checks": [Check(**check) for check in own["checks"]]})

    def agreement(self) -> dict[str, float | None]:
        """Return the share of rewards that the demonstrator agrees with, by source; None without rewards."""
        return {
            name: float(self.agreed[i] / self.labelled[i]) if self.labelled[i] else None
            for i, name in enumerate(SOURCES)
            if name != "rule"
        }

    def counts(self) -> dict[str, int]:
        """Return the number of rewards by source, except those by rule."""
        return {name: int(self.labelled[i]) for i, name in enumerate(SOURCES) if name != "rule"}
