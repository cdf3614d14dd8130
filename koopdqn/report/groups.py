"""Grouping runs: for each task and preset, the runs of one configuration, one a seed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.report.runs import Run, Skipped
from koopdqn.rl.settings import AgentSettings, TrainSettings
from koopdqn.tasks.task import Task

DEFAULT = "default"
PAPER = "paper"
PRESETS = (DEFAULT, PAPER)
TASKS = ("shelf", "knife")
"""The paper's two tasks, in its order."""


@dataclass(frozen=True)
class Preset:
    """What a preset sets for a task.

    Attributes:
        name: of the preset.
        task: the task under it.
        agent: its agent.
        intent: how its intent model is fitted.
        trust: how its trust domain is drawn.
        reward: how its comparison becomes a reward.
        train: when its training stops.
        demonstrations: how many are generated.
        key: :func:`koopdqn.report.runs.configuration_key` of its runs.
    """

    name: str
    task: Task
    agent: AgentSettings
    intent: IntentSettings
    trust: TrustSettings
    reward: RewardSettings
    train: TrainSettings
    demonstrations: int
    key: str


Presets = Mapping[tuple[str, str], Preset]
"""Presets by task and name."""


@dataclass(frozen=True)
class Group:
    """Runs of one task and one configuration.

    Attributes:
        task: the task's name.
        preset: name of the preset they belong to.
        runs: one a seed, by seed; at least one.
    """

    task: str
    preset: str
    runs: tuple[Run, ...]

    @property
    def first(self) -> Run:
        """The run of the least seed, whose demonstrations are drawn."""
        return self.runs[0]

    @property
    def measured(self) -> tuple[Run, ...]:
        """The runs with an evaluation."""
        return tuple(run for run in self.runs if run.evaluation is not None)


Groups = Mapping[tuple[str, str], Group]
"""Groups by task and preset; what has no runs is absent."""


def group_runs(runs: Sequence[Run], presets: Presets) -> tuple[Groups, list[Skipped]]:
    """Return the groups that the report shows, and the runs that it leaves out with the reason.

    A run belongs to a preset if it has the preset's agent and intent. Of several configurations of one preset
    the one shown is that of the present config tree, if there is one, or else that with most seeds, or else the
    newest; of several runs of one seed an evaluated one, or else the newest.
    """
    by_preset: dict[tuple[str, str], dict[str, list[Run]]] = {}
    left_out = []
    for run in runs:
        place = next((place for place, preset in presets.items() if _belongs(run, preset)), None)
        if place is None:
            what = f"agent {run.train['agent']}, intent {run.train['intent']}, task {run.task.name}"
            left_out.append(Skipped(run.folder, f"{what}: no preset has these"))
        else:
            by_preset.setdefault(place, {}).setdefault(run.key, []).append(run)
    groups = {}
    for place, configurations in by_preset.items():
        shown = max(configurations, key=lambda key: _rank(key, configurations[key], presets[place].key))
        for key, others in configurations.items():
            if key != shown:
                left_out += [Skipped(run.folder, f"another configuration of preset {place[1]}") for run in others]
        kept: dict[int, Run] = {}
        for run in sorted(configurations[shown], key=lambda run: (run.evaluation is not None, run.age)):
            if run.seed in kept:
                left_out.append(Skipped(kept[run.seed].folder, f"another run of seed {run.seed} is shown"))
            kept[run.seed] = run
        groups[place] = Group(*place, tuple(kept[seed] for seed in sorted(kept)))
    return groups, sorted(left_out, key=lambda item: str(item.folder))


def _belongs(run: Run, preset: Preset) -> bool:
    names = run.task.name, run.train["agent"], run.train["intent"]
    return names == (preset.task.name, preset.agent.name, preset.intent.name)


def _rank(key: str, runs: Sequence[Run], present: str) -> tuple[bool, int, int]:
    return key == present, len({run.seed for run in runs}), max(run.age for run in runs)
