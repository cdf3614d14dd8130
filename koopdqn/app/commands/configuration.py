"""The composed config as typed settings."""

import importlib.util
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import BeforeValidator, ValidationError

from koopdqn.app.recording import DemoSettings
from koopdqn.artifact import described
from koopdqn.demonstrations.cleaning import InspectSettings
from koopdqn.demonstrations.csv import ExportSettings
from koopdqn.demonstrations.derivation import Derived
from koopdqn.demonstrations.recordings.recording import ImportSettings
from koopdqn.errors import BadInputError, unknown_name
from koopdqn.evaluation.correction import CorrectionSettings
from koopdqn.evaluation.schema import EvaluationSettings
from koopdqn.intent.fit import FitSettings
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.oracles.base import OracleSettings
from koopdqn.programs.settings import ProgramSettings
from koopdqn.programs.streaming import StreamSettings
from koopdqn.report.schema import ReportSettings
from koopdqn.resources import conf_dir
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.rl.settings import Agent, TrainSettings
from koopdqn.robot.arm import Arm
from koopdqn.safety.guard import GuardSettings
from koopdqn.settings import Name, NonNegativeInt, PathText, Settings, flaw, load_settings, plain, validate
from koopdqn.tasks.person import Person
from koopdqn.tasks.task import Task, TaskChoice
from koopdqn.view.schema import CompareSettings, ExplainSettings, ViewSettings

# Groups whose options name the class of their settings; the other sections have one class each.
_GROUPS = ("intent", "trust", "oracle", "agent", "robot")
# What may change between two parts of one run without changing what either does.
_WHEN_TO_STOP = ("stop", "extend", "max_steps", "max_episodes")


def _to_sources(value: object) -> object:
    values = value if isinstance(value, list | tuple) else [value]
    if not values or not all(isinstance(each, str) and each.strip() for each in values):
        raise ValueError("must be a path or a glob, or a list of them in brackets")
    return tuple(values)


def _to_modules(value: object) -> object:
    values = [value] if isinstance(value, str) or not isinstance(value, Sequence) else list(value)
    if not all(isinstance(each, str) and all(part.isidentifier() for part in each.split(".")) for each in values):
        raise ValueError("must be the dotted name of a module, or a list of them in brackets")
    for each in values:
        _check_found(each)
    return tuple(values)


def _check_found(module: Any) -> None:
    rule = "must name modules that can be found"
    try:
        if module in sys.modules or importlib.util.find_spec(module) is not None:
            return
    # To find what lies in a package imports that, and a user's own may raise anything then.
    except Exception as error:
        if not isinstance(error, ModuleNotFoundError) or not f"{module}.".startswith(f"{error.name}."):
            raise ValueError(f"{rule}, found {module}, whose package raises {type(error).__name__}: {error}") from error
    raise ValueError(f"{rule}, found none called {module}; the folder it lies in must be on PYTHONPATH")


Sources = Annotated[tuple[str, ...], BeforeValidator(_to_sources)]
"""Paths or globs, one as a text or several as a YAML list; they need not match anything."""
Modules = Annotated[tuple[Name, ...], BeforeValidator(_to_modules)]
"""Dotted names of modules, one as a text or several as a YAML list."""


class Inputs(Settings):
    """The root's own keys."""

    command: str
    actions: Literal["table1", "continuous"] = "table1"
    seed: NonNegativeInt
    out: PathText
    run: PathText | None
    demos: Sources | None
    intent_file: PathText | None
    trust_modules: Modules


def scaled(task: Task, arm: Arm) -> Task:
    """Return a task in the size that an arm asks for.

    Raises:
        BadInputError: a value of the task is then out of its bounds.
    """
    try:
        return task.scaled(arm.task_scale)
    except ValidationError as error:
        raise BadInputError(
            f"robot.task_scale: must leave every length of task {task.name} within its bounds,"
            f" found {arm.task_scale:g} ({flaw(error)})"
        ) from error


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
    agent: Agent
    robot: Arm
    demo: DemoSettings
    fit: FitSettings
    reward: RewardSettings
    feedback: FeedbackSettings
    train: TrainSettings
    eval: EvaluationSettings
    view: ViewSettings
    explain: ExplainSettings
    compare: CompareSettings
    correct: CorrectionSettings
    report: ReportSettings
    import_: ImportSettings
    inspect: InspectSettings
    export: ExportSettings
    program: ProgramSettings
    stream: StreamSettings
    guard: GuardSettings
    derived: Derived | None = None

    @property
    def run(self) -> Path:
        """The folder of the trained run to look at; BadInputError if none is named."""
        if self.inputs.run is None:
            raise BadInputError("run: must name the run to look at (run=DIR), found none")
        return self.inputs.run

    @property
    def task(self) -> Task:
        """The task; BadInputError if it is made from demonstrations and nothing was made yet."""
        if self.derived is not None:
            return self.derived.task
        if isinstance(self.chosen, Task):
            return self.chosen
        options = sorted(file.stem for file in (conf_dir() / "task").glob("*.yaml"))
        valid = ", ".join(name for name in options if name != "demonstrated")
        raise BadInputError(
            f"task: must be one that stands by itself, found one that is made from demonstrations; valid: {valid}"
        )

    @classmethod
    def load(cls, config: Mapping[Any, Any]) -> "Configuration":
        """Return the typed form of a composed config.

        Raises:
            BadInputError: a key is unknown, or a value is of the wrong type or breaks a rule.
        """
        content = plain(config)
        own, kinds = set(Inputs.model_fields), get_type_hints(cls)
        # Python keeps the word import for itself.
        names = {key.removesuffix("_"): key for key in kinds if key not in ("inputs", "chosen", "derived")}
        sections = {name: kinds[key] for name, key in names.items()}
        known = own | set(sections) | {"task", "person"}
        for key in content:
            if key not in known:
                raise unknown_name("key", key, known)
        # The task holds the person; here mistakes are told by the key under which they were made.
        load_settings(content.get("person"), Person, "person")
        parts: dict[str, Any] = {"inputs": validate({key: content.get(key) for key in own}, Inputs)}
        parts["chosen"] = load_settings(content.get("task"), TaskChoice, "task")
        for key, kind in sections.items():
            node = content.get(key)
            parts[names[key]] = load_settings(node, kind, key) if key in _GROUPS else validate(node, kind, key)
        if isinstance(parts["chosen"], Task):
            parts["chosen"] = scaled(parts["chosen"], parts["robot"])
        made = cls(**parts)
        continuous = made.inputs.actions == "continuous"
        if made.agent.continuous != continuous:
            kind = "td3, or another" if continuous else "fast, paper, or another"
            raise BadInputError(f"agent: must be {kind} of actions={made.inputs.actions}, found {made.agent.name}")
        return made

    def shaped_by(self) -> dict[str, Any]:
        """Return what decides a training run's bytes: no path, no date, no answer source, no stopping rule."""
        train = {key: value for key, value in described(self.train).items() if key not in _WHEN_TO_STOP}
        parts = ("task", "intent", "trust", "agent", "robot", "reward", "feedback")
        return {
            "seed": self.inputs.seed,
            "train": train,
            **{name: described(getattr(self, name)) for name in parts},
        }
