"""Intent files: a fitted intent model and its trust domain, saved and loaded."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from koopdqn.artifact import Artifact, arrays_digest, described, read_artifact, write_artifact
from koopdqn.config.settings import load_settings
from koopdqn.errors import BadInputError
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.tasks.task import Task

KIND = "intent"


@dataclass(frozen=True)
class StoredIntent:
    """A fitted intent as a file holds it.

    Attributes:
        model: the intent model.
        trust: its trust domain.
        settings: what the model was fitted with.
        demonstrations: SHA-256 of the demonstrations it was fitted to.
    """

    model: IntentModel
    trust: TrustDomain
    settings: IntentSettings
    demonstrations: str

    def digest(self) -> str:
        """Return the SHA-256 of what decides the predictions."""
        return arrays_digest(self._arrays())

    def _arrays(self) -> dict[str, Any]:
        return {
            **self.model.arrays(),
            "trust_frame": self.trust.frame,
            "trust_mean": self.trust.mean,
            "trust_deviation": self.trust.deviation,
            "trust_error": self.trust.error,
        }

    def write(self, path: Path, task: Task) -> None:
        """Write the file, with the task and the settings that shaped it."""
        about = {
            "task": described(task),
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
    found = about.get("task")
    if found != described(task):
        name = found.get("name") if isinstance(found, dict) else found
        raise BadInputError(f"intent {path} must be of task {task.name} with the present settings, found task {name}")
    settings = load_settings(about["intent"], IntentSettings, "intent")
    trust = load_settings(about["trust"], TrustSettings, "trust")
    domain = TrustDomain(
        trust, arrays["trust_frame"], arrays["trust_mean"], arrays["trust_deviation"], arrays["trust_error"]
    )
    model = settings.restore(arrays)
    return StoredIntent(model, domain, settings, str(about["made_from"]["demonstrations"]))
