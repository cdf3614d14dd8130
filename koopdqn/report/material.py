"""What a task's figures are drawn from: the demonstrations of one run, its scene, and intents fitted to them."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.hdf5 import read_hdf5
from koopdqn.errors import BadInputError
from koopdqn.files import write_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.pose import Array
from koopdqn.report.groups import PAPER, Group
from koopdqn.report.intents import IntentStudy, study
from koopdqn.report.runs import Run
from koopdqn.robot.scene import Scene
from koopdqn.settings import load_settings
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import open_workcell

SHOWN = 0
"""The demonstration that figures draw, and hold out."""


_BAND_SIGMAS = 3.0


@dataclass(frozen=True)
class Material:
    """What a task's figures are drawn from.

    Attributes:
        run: whose demonstrations they are.
        groups: the task's runs, by preset; at least one.
        demonstrations: of the run.
        trajectories: their poses (N, 7) at the agent's step.
        studies: intents fitted to them, with the file that holds each, by name.
        scene: the arm in the task's scene.
    """

    run: Run
    groups: Mapping[str, Group]
    demonstrations: Demonstrations
    trajectories: list[Array]
    studies: Mapping[str, tuple[IntentStudy, Path]]
    scene: Scene

    @property
    def task(self) -> Task:
        """The task."""
        return self.run.task

    @property
    def intents(self) -> dict[str, IntentStudy]:
        """The fitted intents by name."""
        return {name: found for name, (found, _) in self.studies.items()}

    @property
    def sigmas(self) -> float:
        """Half the width of the run's boxes in standard deviations; of the usual band where it trusts a tube."""
        return float(self.run.about["trust"].get("sigmas", _BAND_SIGMAS))

    @property
    def fits(self) -> tuple[Path, ...]:
        """The files of the paper's lift and of the default, which figures show."""
        return tuple(self.studies[name][1] for name in ("paper", "pose"))


Intents = Mapping[str, tuple[IntentSettings, TrustSettings, RewardSettings]]
"""How intents are fitted, where they are trusted and how they reward, by name."""


def gather(groups: Mapping[str, Group], intents: Intents, folder: Path, advance: Callable[[], None]) -> Material:
    """Return a task's material; the fits are written to ``fits/`` in a folder.

    The run is the first one of the first group. Its own intent and trust domain take the place of those given, so
    that figures show what it learned from.

    Args:
        groups: the task's runs by preset.
        intents: what is fitted to its demonstrations.
        folder: of the report.
        advance: called after every fit.

    Raises:
        BadInputError: the demonstrations are damaged, or do not allow a fit.
    """
    run = next(iter(groups.values())).first
    demonstrations = read_hdf5(run.demonstrations_file)
    if len(demonstrations) < 2:
        raise BadInputError(f"{run.demonstrations_file} must hold at least 2 demonstrations, found 1")
    try:
        own = load_settings(run.about["intent"], IntentSettings, "intent")
        trust = load_settings(run.about["trust"], TrustSettings, "trust")
        reward = load_settings(run.about["reward"], RewardSettings, "reward")
    except BadInputError as error:
        raise BadInputError(f"run {run.folder} must have an intent of this release, found: {error}") from error
    studies = {}
    for name, (settings, its_trust, its_reward) in intents.items():
        # Another intent than the paper's is trusted as the run's own, unless the run is the paper's.
        ours = run.train["intent"] == name or (name != PAPER and run.train["intent"] != PAPER)
        used = own if own.name == name else settings
        domain, rewarded = (trust, reward) if ours else (its_trust, its_reward)
        found = study(demonstrations, run.task, used, domain, rewarded, SHOWN)
        file = folder / "fits" / f"{run.task.name}-{name}.json"
        write_json(file, found.content())
        studies[name] = (found, file)
        advance()
    scene = open_workcell(run.task, run.arm).scene
    return Material(run, groups, demonstrations, agent_steps(demonstrations, run.task), studies, scene)
