"""How a training goes: checks of the policy on held-out starts, whether the task is learned, and the history."""

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
# So many times as many starts as a check's confirm what is learned.
_OTHERS = 2
# Of the checks' random numbers, apart from those of demonstrations (1), training (2) and evaluation (4).
_STREAM = 3


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
        self._parts = workcell, model, step_limit
        self._seed, self._count = settings.check_seed, settings.check_starts
        self.path: Array = np.zeros((0, 7))
        self._held_out = _HeldOut(*self._parts, [self._seed, _STREAM], self._count)

    def measure(self, policy: Controller) -> tuple[float, float, dict[str, int]]:
        """Return a policy's success rate, its distance from the intent's roll-outs, and failures by cause.

        The distance is the mean, over the poses of its paths, of that to the nearest pose of the roll-out from the same
        start, in steps of position or in five rotation tolerances of turn, whichever is larger.
        """
        episodes = self._held_out.rolled_out(policy)
        self.path = episodes[0].poses
        outcomes = [episode.outcome for episode in episodes]
        failures = {name: outcomes.count(name) for name in sorted(set(outcomes) - {SUCCESS})}
        return outcomes.count(SUCCESS) / len(outcomes), self._held_out.distance(dict(enumerate(episodes))), failures

    def confirm(self, policy: Controller, nearest: Controller) -> tuple[float, bool]:
        """Return a policy's success rate from twice as many other starts, and whether it goes another way from these.

        It does where it is more than twice as far from the intent as the actions ``nearest`` to it, and more than four
        steps, from the starts from which both succeed.
        """
        own = _arrived(self._others.rolled_out(policy))
        rate = len(own) / self._others.count
        if not own or self._others.distance(own) <= _ANOTHER_WAY * _NEAR_STEPS:
            return rate, False
        theirs = _arrived(self._others.rolled_out(nearest))
        both = own.keys() & theirs.keys()
        if not both:
            return rate, False
        far, near = (self._others.distance({index: found[index] for index in both}) for found in (own, theirs))
        return rate, far > _ANOTHER_WAY * max(near, _NEAR_STEPS)

    @cached_property
    def _others(self) -> "_HeldOut":
        return _HeldOut(*self._parts, [self._seed, _STREAM, 1], _OTHERS * self._count)


class _HeldOut:
    """Held-out starts, and the intent's roll-outs from them.

    Attributes:
        count: how many.
    """

    def __init__(self, workcell: Workcell, model: IntentModel, step_limit: int, seed: list[int], count: int) -> None:
        """Draw ``count`` starts with a seed."""
        self.count = count
        self._workcell, self._model, self._step_limit = workcell, model, step_limit
        drawn = draw_starts(workcell, workcell.task, np.random.default_rng(seed), count)
        self._starts, self._joints, self._moved = drawn.starts, drawn.joints, drawn.moved

    def rolled_out(self, controller: Controller) -> list[Episode]:
        """Return the episodes of a controller from the starts."""
        workcell, task = self._workcell, self._workcell.task
        begun = self._starts, self._joints, self._step_limit
        return roll_out(controller, task, workcell.reachability, *begun, cut_circles=True, moved=self._moved)

    def distance(self, episodes: dict[int, Episode]) -> float:
        """Return the distance of episodes, by their starts' numbers, from the roll-outs: that of a check."""
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
        best_success: success rate of the best check, or of its policy from other starts if it failed from these; −1
            before the first.
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

    def astray(self, check: Check, settings: TrainSettings) -> bool:
        """Return whether a check passed so far off that it says nothing; the next one may."""
        passed = self.passed and check.success_rate >= settings.check_success
        return bool(passed and check.intent_distance > _ASTRAY * self.first_distance)

    def better(self, check: Check) -> bool:
        """Return whether a check is better than the best so far."""
        return (check.success_rate, -check.intent_distance) >= (self.best_success, -self.best_distance)

    def add(self, check: Check, settings: TrainSettings, *, best: bool) -> None:
        """Add a check that is not astray, and take it as the best or not."""
        if check.success_rate < settings.check_success:
            self.passed = 0
        elif self.passed and check.intent_distance >= (1.0 - settings.gain) * self.first_distance:
            self.passed += 1
        else:
            self.passed, self.first_distance = 1, check.intent_distance
        if best:
            self.best_success, self.best_distance = check.success_rate, check.intent_distance
            self.best_update = check.updates

    def settled(self, settings: TrainSettings) -> bool:
        """Return whether the best policy, if it is confirmed, is what was to be learned."""
        return not self.learned and self.passed >= settings.checks_to_learn

    def confirm(self, check: Check, settings: TrainSettings, success_rate: float, *, another_way: bool) -> None:
        """Take the best policy as learned at a check, or the checks that it passed as passed by chance.

        Given are its success rate from other starts, and whether it goes another way than the intent, which more checks
        must bring no nearer.
        """
        if success_rate < settings.check_success:
            # What it is known to reach now, so that a later policy can be better.
            self.passed, self.best_success = 0, success_rate
        elif not another_way or self.passed >= _PATIENCE * settings.checks_to_learn:
            self.learned_at = check.env_steps


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
