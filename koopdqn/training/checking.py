"""The check that training makes of its policy now and then, on held-out starts."""

import numpy as np

from koopdqn.dqn.policy import Policy
from koopdqn.rollout import SUCCESS, roll_out
from koopdqn.training.settings import TrainSettings
from koopdqn.workcell import Workcell


class Checker:
    """Tries policies from the same starts each time."""

    def __init__(self, workcell: Workcell, settings: TrainSettings, step_limit: int) -> None:
        """Draw the starts: ``settings.check_starts``, by ``settings.check_seed``; episodes end after ``step_limit``."""
        self._workcell = workcell
        self._step_limit = step_limit
        rng = np.random.default_rng([settings.check_seed, 3])
        self._starts, self._joints, _ = workcell.reachability.draw_starts(workcell.task, rng, settings.check_starts)

    def measure(self, policy: Policy) -> tuple[float, dict[str, int]]:
        """Return a policy's success rate, and how many starts failed, by cause."""
        workcell = self._workcell
        episodes = roll_out(policy, workcell.task, workcell.reachability, self._starts, self._joints, self._step_limit)
        outcomes = [episode.outcome for episode in episodes]
        failures = {name: outcomes.count(name) for name in sorted(set(outcomes) - {SUCCESS})}
        return outcomes.count(SUCCESS) / len(outcomes), failures
