"""The paper's own tables and figures (numbers), beside ours: Table 1, Table A1, and what its text reports."""

from collections.abc import Callable, Mapping
from pathlib import Path

from koopdqn.intent.box import BoxSettings
from koopdqn.intent.tube import TubeSettings
from koopdqn.report.blocks import Cell, Table
from koopdqn.report.groups import DEFAULT, PAPER, TASKS, Groups, Preset, Presets
from koopdqn.report.intents import IntentStudy
from koopdqn.report.numbers import NONE, NOT_GIVEN, Studies, measured, trained
from koopdqn.resources import conf_dir
from koopdqn.rl.network import size
from koopdqn.tasks.actions import ACTIONS, COUNT

_LIFT = {DEFAULT: "pose", PAPER: "paper"}
"""The intent of each preset."""
_MOST_STEPS_M = 1.5e-3


def actions_table() -> Table:
    """Return Table 1: the discrete action space."""
    rows = tuple((Cell(str(number)), Cell(words)) for number, words in enumerate(ACTIONS, 1))
    return Table(
        "Table 1. Actions",
        "The paper's ten actions in its order. Sizes, which it does not give, are one step (2.1 mm by default) and, of"
        " actions 1 and 3, two, of action 4, four rotation tolerances.",
        ("action", "what it does"),
        rows,
    )


def _width(preset: Preset) -> str:
    trust = preset.trust
    if isinstance(trust, TubeSettings):
        return f"tube of {trust.coverage:.0%} coverage"
    return f"{trust.sigmas:g}" if isinstance(trust, BoxSettings) else type(trust).__name__


def hyperparameters_table(presets: Presets) -> Table:
    """Return Table A1 with Appendix 7.1, the paper's values beside those of both presets."""
    lines: tuple[tuple[str, str, str, Callable[[Preset], str], str], ...] = (
        ("max. number of episodes", "1,500", "1,200", lambda p: f"{p.train.max_episodes:,}", "preset"),
        ("tolerance to reach the goal", "0.005", "0.005", _goal_tolerance, "task"),
        ("tolerance to compare poses", "0.002", "0.002", _tolerance, "task"),
        ("learning rate", "1e-5", "1e-4", lambda p: f"{p.agent.learning_rate:g}", "agent"),
        ("size of the replay buffer", "10,000", "10,000", lambda p: f"{p.agent.replay:,}", "agent"),
        ("batch size", "1,000", "1,000", lambda p: f"{p.agent.batch:,}", "agent"),
        ("units of the two hidden layers", "1,024", "1,560", _units, "agent"),
        ("inputs of the network", "5", "8", _inputs, "agent"),
        ("outputs of the network", "10", "10", lambda p: str(COUNT), "agent"),
        ("discount γ", "not given", "not given", lambda p: f"{p.agent.gamma:g}", "agent"),
        ("ε, first to last", "not given", "not given", _epsilon, "agent"),
        ("target network", "not given", "not given", _target, "agent"),
        ("width of the trust domain, k", "not given", "not given", _width, "trust"),
        ("number of demonstrations", "not given", "not given", lambda p: f"{p.demonstrations}", "config"),
    )
    places = [(task, name) for name in (PAPER, DEFAULT) for task in TASKS]
    rows = []
    for what, first, second, value, part in lines:
        ours = (Cell(value(presets[place]), _file(presets[place], part)) for place in places)
        rows.append((Cell(what), Cell(first), Cell(second), *ours))
    return Table(
        "Table A1. Hyper-parameters",
        "The paper's Table A1 and Appendix 7.1 beside koopdqn's two presets. The paper gives its tolerances no unit;"
        " here they are metres and radians.",
        ("parameter", "paper, shelf", "paper, knife", *(f"preset={name}, {task}" for task, name in places)),
        tuple(rows),
    )


def _file(preset: Preset, part: str) -> tuple[Path, ...]:
    """Return the config file, or the folder of the group, that a setting stands in."""
    names = {
        "preset": f"preset/{PAPER}.yaml" if preset.name == PAPER else "config.yaml",
        "task": f"task/{preset.task.name}.yaml",
        "agent": f"agent/{preset.agent.name}.yaml",
        "trust": "trust",
        "config": "config.yaml",
    }
    return (conf_dir() / names[part],)


def _goal_tolerance(preset: Preset) -> str:
    return f"{preset.task.goal_tolerance_m:g} m, {preset.task.goal_rotation_tolerance_rad:.3g} rad"


def _tolerance(preset: Preset) -> str:
    return f"{preset.task.position_tolerance_m:g} m, {preset.task.rotation_tolerance_rad:g} rad"


def _units(preset: Preset) -> str:
    return ", ".join(f"{units:,}" for units in preset.agent.network.hidden)


def _inputs(preset: Preset) -> str:
    features = preset.agent.network.fourier_features
    return f"{size(preset.task)}" + (f" and {features} Fourier features" if features else "")


def _epsilon(preset: Preset) -> str:
    agent = preset.agent
    return f"{agent.epsilon_start:g} to {agent.epsilon_end:g} in {agent.epsilon_steps:,} actions"


def _target(preset: Preset) -> str:
    agent = preset.agent
    if agent.target_rate == 1.0:
        return f"copied every {agent.target_every:,} updates"
    often = "update" if agent.target_every == 1 else f"{agent.target_every:,} updates"
    return f"follows by {agent.target_rate:.0%} every {often}"


def comparison_table(groups: Groups, studies: Studies) -> Table:
    """Return what the paper's text reports beside what was measured here."""
    rows: list[tuple[Cell, ...]] = []
    for task in TASKS:
        rows += _predictions(task, studies.get(task, {}))
        rows += _trainings(task, groups)
    return Table(
        "What the paper reports, and what was measured here",
        "One-step errors: raw prediction of the held-out demonstration 0 at 60 samples, by the default lift under the"
        " default preset and by the paper's lift under the paper's. Ours are means over seeds, least and largest in"
        " parentheses; – where nothing was measured. The paper's minutes are on an Intel i7 with 16 GB.",
        ("quantity", "the paper", "default preset", "paper preset"),
        tuple(rows),
    )


def _predictions(task: str, studies: Mapping[str, tuple[IntentStudy, Path]]) -> list[tuple[Cell, ...]]:
    def ours(value: Callable[[IntentStudy], str]) -> tuple[Cell, Cell]:
        first, second = (
            Cell(value(studies[_LIFT[name]][0]), (studies[_LIFT[name]][1],)) if _LIFT[name] in studies else NONE
            for name in (DEFAULT, PAPER)
        )
        return first, second

    def largest(study: IntentStudy) -> str:
        return f"{1e3 * study.held_out.sixty[:, 0].max():.2f} mm"

    def below(study: IntentStudy) -> str:
        return f"{100 * (study.held_out.sixty[:, 0] < _MOST_STEPS_M).mean():.0f} %"

    def turned(study: IntentStudy) -> str:
        return f"{study.held_out.sixty[:, 1].max():.4f} rad"

    def asked(study: IntentStudy) -> str:
        return f"{100 * study.held_out.asked.mean():.0f} %"

    share = (Cell(f"{task}: steps that the expert is asked about"), Cell("steps 48 to 52 (§5.1)"), *ours(asked))
    if task == "shelf":
        return [
            (Cell("shelf: largest one-step position error"), Cell("2.3 mm, at steps 48 to 52 (§5.1)"), *ours(largest)),
            (Cell("shelf: steps with an error under 1.5 mm"), Cell("most (§5.1)"), *ours(below)),
            share,
        ]
    return [
        (Cell("knife: largest one-step position error"), Cell("order of submillimetres (§5.2)"), *ours(largest)),
        (Cell("knife: largest one-step orientation error"), NOT_GIVEN, *ours(turned)),
        (share[0], NOT_GIVEN, *share[2:]),
    ]


def _trainings(task: str, groups: Groups) -> list[tuple[Cell, ...]]:
    found = [groups.get((task, name)) for name in (DEFAULT, PAPER)]
    runs = [group.runs if group else () for group in found]
    episodes = {"shelf": "1,200 (§5.1)", "knife": "1,200 at most (Table A1)"}[task]
    minutes = {"shelf": "about 135 (§5.1)", "knife": "about 210 (§5.2)"}[task]
    return [
        (Cell(f"{task}: episodes to learn"), Cell(episodes), *(trained(own, ",.0f", "episodes") for own in runs)),
        (
            Cell(f"{task}: minutes to learn"),
            Cell(minutes),
            *(trained(own, ".2f", "seconds", scale=1 / 60) for own in runs),
        ),
        (Cell(f"{task}: questions asked"), NOT_GIVEN, *(trained(own, ",.0f", "oracle_queries") for own in runs)),
        (
            Cell(f"{task}: success from held-out starts"),
            NOT_GIVEN,
            *(measured(own, ".0f", "success_rate", scale=100.0, unit="%") for own in runs),
        ),
        (
            Cell(f"{task}: deviation from the demonstrator's path, mean"),
            NOT_GIVEN,
            *(measured(own, ".1f", "path_deviation_mm", "mean", unit="mm") for own in runs),
        ),
    ]
