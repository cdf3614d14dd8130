"""The history of a training run, for ``train.json``, curves and checkpoint."""

from copy import deepcopy
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from koopdqn.intent.reward import SOURCES


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
