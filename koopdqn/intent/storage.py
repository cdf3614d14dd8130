"""Intent files: a fitted intent model and its trust domain."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn.artifact import (
    Artifact,
    arrays_digest,
    below,
    check_task,
    described,
    read_artifact,
    reading,
    write_artifact,
)
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.settings import load_settings
from koopdqn.tasks.task import Task

KIND = "intent"
_TRUST = "trust_"


@dataclass(frozen=True)
class StoredIntent:
    """The content of an intent file.

    Attributes:
        model: the intent model.
        trust: its trust domain.
        settings: how the model was fitted.
        demonstrations: SHA-256 of the demonstrations it was fitted to.
    """

    model: IntentModel
    trust: TrustDomain
    settings: IntentSettings
    demonstrations: str

    def digest(self) -> str:
        """Return the SHA-256 of the model's and the domain's arrays."""
        return arrays_digest(self._arrays())

    def _arrays(self) -> dict[str, Any]:
        return {**self.model.arrays(), **{_TRUST + name: values for name, values in self.trust.arrays().items()}}

    def write(self, path: Path, task: Task) -> None:
        """Write the file, with the task and all settings."""
        about = {
            "task": described(task.without_obstacles()),
            "intent": described(self.settings),
            "trust": described(self.trust.settings),
            "made_from": {"demonstrations": self.demonstrations},
        }
        write_artifact(path, Artifact(KIND, self._arrays(), about))


def read_intent(path: Path, task: Task) -> StoredIntent:
    """Read a fitted intent for a task.

    Raises:
        BadInputError: the file is missing, damaged, changed by hand, or of another task.
    """
    artifact = read_artifact(path, KIND)
    about, arrays = artifact.about, artifact.arrays
    check_task(f"intent {path}", about.get("task"), task.without_obstacles())
    with reading(f"intent {path}"):
        settings = load_settings(about["intent"], IntentSettings, "intent")
        trust = load_settings(about["trust"], TrustSettings, "trust")
        own = {name: values for name, values in arrays.items() if not name.startswith(_TRUST)}
        model, domain = settings.restore(own), trust.restore(below(arrays, _TRUST))
        _try_out(model, domain, task)
        return StoredIntent(model, domain, settings, str(about["made_from"]["demonstrations"]))


def _try_out(model: IntentModel, domain: TrustDomain, task: Task) -> None:
    """Predict and trust once: arrays of odd shapes fail here, where the file is known, and not in the work."""
    start = task.nominal_start[None]
    predicted = model.intended(start, start)
    if predicted.shape != start.shape or not np.isfinite(predicted).all():
        raise ValueError(f"its prediction must be a pose of finite numbers, found {predicted.tolist()}")
    domain.contains(start, np.zeros(1, dtype=int))
    domain.depth(start)
