"""The composed config as typed settings."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from koopdqn.app.recording.settings import DemoSettings
from koopdqn.artifact import described
from koopdqn.demonstrations.csv import ExportSettings
from koopdqn.demonstrations.derivation import Derived
from koopdqn.errors import BadInputError, unknown_name
from koopdqn.evaluation.settings import EvaluationSettings
from koopdqn.intent.fit import FitSettings
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.oracles.base import OracleSettings
from koopdqn.report.runs import ReportSettings
from koopdqn.rl.human_reward import FeedbackSettings
from koopdqn.rl.settings import AgentSettings, TrainSettings
from koopdqn.robot.arm import Arm
from koopdqn.settings import Modules, NonNegativeInt, PathText, Settings, Sources, load_settings, plain, validate
from koopdqn.tasks.person import Person
from koopdqn.tasks.task import Task, TaskChoice

# What may change between two parts of one run without changing what either does.
_WHEN_TO_STOP = ("stop", "extend", "max_steps", "max_episodes")


class Inputs(Settings):
    """The root's own keys."""

    command: str
    seed: NonNegativeInt
    out: PathText
    run: PathText | None
    demos: Sources | None
    intent_file: PathText | None
    trust_modules: Modules


@dataclass(frozen=True)
class Configuration:
    """Everything a command may need, validated.

    Attributes:
        chosen: the option of the group ``task``: the task, or how it is made from demonstrations.
        derived: the task made from demonstrations, with them; None before, and where the option is a task.
    """

    inputs: Inputs
    chosen: TaskChoice
    intent: IntentSettings
    trust: TrustSettings
    oracle: OracleSettings
    agent: AgentSettings
    robot: Arm
    demo: DemoSettings
    fit: FitSettings
    reward: RewardSettings
    feedback: FeedbackSettings
    train: TrainSettings
    eval: EvaluationSettings
    report: ReportSettings
    export: ExportSettings
    derived: Derived | None = None

    @property
    def task(self) -> Task:
        """The task.

        Raises:
            BadInputError: it is made from demonstrations, and nothing was made yet.
        """
        if self.derived is not None:
            return self.derived.task
        if isinstance(self.chosen, Task):
            return self.chosen
        raise BadInputError(
            "task: must be one that stands by itself, found one that is made from demonstrations; valid: knife, shelf"
        )

    @classmethod
    def load(cls, config: Mapping[Any, Any]) -> "Configuration":
        """Return the typed form of a composed config.

        Raises:
            BadInputError: a key is unknown, or a value is of the wrong type or breaks a rule.
        """
        content = plain(config)
        polymorphic: dict[str, type] = {
            "task": TaskChoice,
            "intent": IntentSettings,
            "trust": TrustSettings,
            "oracle": OracleSettings,
            "agent": AgentSettings,
            "robot": Arm,
        }
        fixed: dict[str, type[Settings]] = {
            "demo": DemoSettings,
            "fit": FitSettings,
            "reward": RewardSettings,
            "feedback": FeedbackSettings,
            "train": TrainSettings,
            "eval": EvaluationSettings,
            "report": ReportSettings,
            "export": ExportSettings,
        }
        own = set(Inputs.model_fields)
        known = own | set(polymorphic) | set(fixed) | {"person"}
        for key in content:
            if key not in known:
                raise unknown_name("key", key, known)
        # The task holds the person; here mistakes are told by the key under which they were made.
        load_settings(content.get("person"), Person, "person")
        parts: dict[str, Any] = {"inputs": validate({key: content.get(key) for key in own}, Inputs)}
        parts |= {key: load_settings(content.get(key), base, key) for key, base in polymorphic.items()}
        parts |= {key: validate(content.get(key), model, key) for key, model in fixed.items()}
        return cls(chosen=parts.pop("task"), **parts)

    def shaped_by(self) -> dict[str, Any]:
        """Return what decides a training run's bytes: no path, no date, no answer source, no stopping rule."""
        train = {key: value for key, value in described(self.train).items() if key not in _WHEN_TO_STOP}
        parts = ("task", "intent", "trust", "agent", "robot", "reward", "feedback")
        return {
            "seed": self.inputs.seed,
            "train": train,
            **{name: described(getattr(self, name)) for name in parts},
        }
