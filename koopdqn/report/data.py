"""What a task's figures are drawn from: the demonstrations of one run, and intents fitted to them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.errors import BadInputError
from koopdqn.files import write_json
from koopdqn.intent.fit import agent_steps, fit
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.intent.validation import sizes_of
from koopdqn.pose import Array
from koopdqn.report.runs import PAPER, Run
from koopdqn.robot.scene import Scene
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import open_workcell

INTENTS: Final = ("paper", "pose", "line", "joint")
"""The compared options of the config group ``intent``, in the order of tables."""
SHOWN: Final = 0
"""The demonstration that figures draw, and hold out."""
_BAND_SIGMAS: Final = 3.0

Intents = Mapping[str, tuple[IntentSettings, TrustSettings, RewardSettings]]
"""How intents are fitted, where they are trusted and how they reward, by name."""


@dataclass(frozen=True)
class HeldOut:
    """How an intent fitted to the other demonstrations predicts the one that figures show.

    Attributes:
        file: where :attr:`content` is kept.
        report: the content of a ``fit.json``, of the fit to all demonstrations.
        reward: how the intent's rewards are made.
        error: (N - 1, 2) one-step errors of the raw prediction at the agent's step [m, rad].
        rescaled: (N - 1, 2) the same of the prediction rescaled to the agent's step [m, rad].
        asked: (N - 1,) whether the trust domain drawn from the others leaves a step to the expert.
        sixty: (59, 2) raw one-step errors with every demonstration resampled to 60 poses [m, rad].
    """

    file: Path
    report: dict[str, Any]
    reward: RewardSettings
    error: Array
    rescaled: Array
    asked: np.ndarray
    sixty: Array

    @property
    def content(self) -> dict[str, Any]:
        """What the report's own file of it holds, as JSON values."""
        held_out: dict[str, Any] = {"demonstration": SHOWN, "asked": self.asked.tolist()}
        for prefix, errors in (
            ("one_step", self.error),
            ("rescaled_one_step", self.rescaled),
            ("sixty_samples", self.sixty),
        ):
            held_out |= {f"{prefix}_error_{unit}": errors[:, i].tolist() for i, unit in enumerate(("m", "rad"))}
        return {"fit": self.report, "held_out": held_out}


def held_out(
    demonstrations: Demonstrations,
    task: Task,
    intent: IntentSettings,
    trust: TrustSettings,
    reward: RewardSettings,
    file: Path,
) -> HeldOut:
    """Return what the cross-validation of an intent says of the demonstration that figures show.

    Raises:
        BadInputError: the demonstrations do not fit the task.
    """
    fitted = fit(demonstrations, task, intent, trust, reward)
    fold, inside = fitted.folds[SHOWN], fitted.contained[SHOWN]
    # As the reward does: the reached state must be trusted, by default the one before as well.
    asked = ~inside[1:] if trust.needs == "reached" else ~(inside[1:] & inside[:-1])
    errors = sizes_of(fold.error), sizes_of(fold.rescaled)
    return HeldOut(file, fitted.report, reward, *errors, asked, fitted.sixty[SHOWN])


Studies = Mapping[str, Mapping[str, HeldOut]]
"""Fitted intents, by task and name of the intent."""


@dataclass(frozen=True)
class Material:
    """What a task's figures are drawn from.

    Attributes:
        run: whose demonstrations they are.
        demonstrations: of the run.
        trajectories: their poses (N, 7) at the agent's step.
        intents: fitted to them, by name.
        scene: the arm in the task's scene.
    """

    run: Run
    demonstrations: Demonstrations
    trajectories: list[Array]
    intents: Mapping[str, HeldOut]
    scene: Scene

    @property
    def sigmas(self) -> float:
        """Half the width of the run's boxes in standard deviations; of the usual band where it trusts a tube."""
        return float(self.run.about["trust"].get("sigmas", _BAND_SIGMAS))


def gather(run: Run, intents: Intents, folder: Path, advance: Callable[[], None]) -> Material:
    """Return what the figures of a run's task are drawn from; the fits are written to ``fits/`` in a folder.

    The run's own intent and trust domain take the place of those given, so that figures show what it learned from.

    ``advance`` is called after every fit.

    Raises:
        BadInputError: the demonstrations are damaged, or do not allow a fit.
    """
    demonstrations = read_hdf5(run.demonstrations_file)
    if len(demonstrations) < 2:
        raise BadInputError(f"{run.demonstrations_file} must hold at least 2 demonstrations, found 1")
    found = {}
    for name, (settings, trust, reward) in intents.items():
        # Another intent than the paper's is trusted as the run's own, unless the run is the paper's.
        own = run.intent.name == name
        ours = own or PAPER not in (name, run.intent.name)
        file = folder / "fits" / f"{run.task.name}-{name}.json"
        found[name] = held_out(
            demonstrations,
            run.task,
            run.intent if own else settings,
            run.trust if ours else trust,
            run.reward if ours else reward,
            file,
        )
        write_json(file, found[name].content)
        advance()
    scene = open_workcell(run.task, run.arm).scene
    return Material(run, demonstrations, agent_steps(demonstrations, run.task), found, scene)
