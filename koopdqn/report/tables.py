"""The tables of the page: what the paper reports beside what was measured here, and how each number is written."""

from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any, Final, NamedTuple

from koopdqn.errors import BadInputError
from koopdqn.evaluation.schema import Baselines
from koopdqn.files import read_json
from koopdqn.intent.box import BoxSettings
from koopdqn.intent.tube import TubeSettings
from koopdqn.report.data import INTENTS, HeldOut, Studies
from koopdqn.report.runs import DEFAULT, PAPER, PRESETS, TASKS, Groups, Preset, Presets, Run
from koopdqn.report.schema import LeftOut, MissingPart
from koopdqn.resources import conf_dir
from koopdqn.rl.network import size
from koopdqn.tasks.actions import ACTIONS, COUNT


class Cell(NamedTuple):
    """A cell of a table: its text and the files that it came from."""

    text: str
    sources: Sequence[Path] = ()


class Table(NamedTuple):
    """A table: its title, columns and rows, each with its name first, and the numbers of rows that sum up others.

    What is written below it stands in the page's template, by its title.
    """

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    summaries: Sequence[int] = ()


_NOT_GIVEN: Final = "not given"
"""What the paper says nothing about."""
NONE: Final = Cell("–")
"""Nothing was measured."""
_DEVIATION: Final = "deviation from the demonstrator's path, mean"
_LIFT: Final = {DEFAULT: "pose", PAPER: "paper"}
"""The intent of each preset."""


def spread(values: Sequence[float | None], form: str, scale: float = 1.0, unit: str = "") -> str:
    """Return "mean (least–largest) unit" of the known values, in a format, the mean alone where they do not differ."""
    known = [scale * value for value in values if value is not None]
    if not known:
        return NONE.text
    low, mean, high = (format(value, form) for value in (min(known), fmean(known), max(known)))
    text = mean if low == high else f"{mean} ({low}–{high})"
    return f"{text} {unit}".rstrip()


class Quantity(NamedTuple):
    """A number of result files: its name with unit, the dotted keys that lead to it, and how it is written."""

    name: str
    keys: str
    form: str
    scale: float = 1.0
    unit: str = ""

    def over(self, contents: Sequence[tuple[Path, Any]], place: str = "") -> Cell:
        """Return its spread over the contents of files, below a place in them, as a cell."""
        values = [content for _, content in contents]
        for key in f"{place}{self.keys}".split("."):
            values = [None if value is None else value[key] for value in values]
        sources = dict.fromkeys(file for file, _ in contents)
        return Cell(spread(values, self.form, self.scale, self.unit), list(sources))


def _trained(runs: Sequence[Run]) -> list[tuple[Path, Any]]:
    return [(run.train_file, run.train) for run in runs]


def _until_learned(runs: Sequence[Run]) -> list[tuple[Path, Any]]:
    """Return what learning took in the runs that learned; the seconds only of those that ended then."""
    found = []
    for run in runs:
        if (learned_at := run.train["learned_at_env_steps"]) is not None:
            checks = (check["episodes"] for check in run.train["checks"] if check["env_steps"] == learned_at)
            seconds = run.train["seconds"] if run.train["env_steps"] == learned_at else None
            found.append((run.train_file, {"episodes": next(checks, None), "seconds": seconds}))
    return found


def _measured(runs: Sequence[Run]) -> list[tuple[Path, Any]]:
    return [(run.evaluation_file, run.evaluation) for run in runs if run.evaluation_file is not None]


_FITTED: Final[tuple[tuple[Sequence[str], str, Callable[[HeldOut], str]], ...]] = (
    (TASKS, "largest one-step position error", lambda fit: f"{1e3 * fit.sixty[:, 0].max():.2f} mm"),
    (["shelf"], "steps with an error under 1.5 mm", lambda fit: f"{100 * (fit.sixty[:, 0] < 1.5e-3).mean():.0f} %"),
    (["knife"], "largest one-step orientation error", lambda fit: f"{fit.sixty[:, 1].max():.4f} rad"),
    (TASKS, "steps that the expert is asked about", lambda fit: f"{100 * fit.asked.mean():.0f} %"),
)
_LEARNED: Final = (
    (_until_learned, Quantity("episodes to learn", "episodes", ",.0f")),
    (_until_learned, Quantity("minutes to learn", "seconds", ".2f", 1 / 60)),
    (_trained, Quantity("questions asked", "oracle_queries", ",.0f")),
    (_measured, Quantity("success from held-out starts", "success_rate", ".3g", 100.0, "%")),
    (_measured, Quantity(_DEVIATION, "path_deviation_mm.mean", ".1f", unit="mm")),
)
_REPORTED: Final = {
    "shelf: largest one-step position error": "2.3 mm, at steps 48 to 52 (§5.1)",
    "shelf: steps with an error under 1.5 mm": "most (§5.1)",
    "shelf: steps that the expert is asked about": "steps 48 to 52 (§5.1)",
    "shelf: episodes to learn": "1,200 (§5.1)",
    "shelf: minutes to learn": "about 135 (§5.1)",
    "knife: largest one-step position error": "order of submillimetres (§5.2)",
    "knife: episodes to learn": "1,200 at most (Table A1)",
    "knife: minutes to learn": "about 210 (§5.2)",
}
"""What the paper's text says."""


def comparison(groups: Groups, studies: Studies) -> Table:
    """Return what the paper's text reports beside what was measured here."""
    ours: dict[str, list[Cell]] = {}
    for task in TASKS:
        fits = [studies.get(task, {}).get(_LIFT[name]) for name in PRESETS]
        for tasks, what, value in _FITTED:
            if task in tasks:
                ours[f"{task}: {what}"] = [NONE if fit is None else Cell(value(fit), [fit.file]) for fit in fits]
        for read, quantity in _LEARNED:
            runs = [read(groups.get((task, name), ())) for name in PRESETS]
            ours[f"{task}: {quantity.name}"] = [quantity.over(found) for found in runs]
    return Table(
        "What the paper reports, and what was measured here",
        ("quantity", "the paper", "default preset", "paper preset"),
        [(Cell(what), Cell(_REPORTED.get(what, _NOT_GIVEN)), *cells) for what, cells in ours.items()],
    )


def actions() -> Table:
    """Return Table 1: the discrete action space."""
    return Table(
        "Table 1. Actions",
        ("action", "what it does"),
        [(Cell(str(number)), Cell(words)) for number, words in enumerate(ACTIONS, 1)],
    )


_TABLE_A1: Final = (
    ("max. number of episodes", "1,500", "1,200"),
    ("tolerance to reach the goal", "0.005", "0.005"),
    ("tolerance to compare poses", "0.002", "0.002"),
    ("learning rate", "1e-5", "1e-4"),
    ("size of the replay buffer", "10,000", "10,000"),
    ("batch size", "1,000", "1,000"),
    ("units of the two hidden layers", "1,024", "1,560"),
    ("inputs of the network", "5", "8"),
    ("outputs of the network", "10", "10"),
    ("discount γ", _NOT_GIVEN, _NOT_GIVEN),
    ("ε, first to last", _NOT_GIVEN, _NOT_GIVEN),
    ("target network", _NOT_GIVEN, _NOT_GIVEN),
    ("width of the trust domain, k", _NOT_GIVEN, _NOT_GIVEN),
    ("number of demonstrations", _NOT_GIVEN, _NOT_GIVEN),
)
"""The paper's values for shelf and knife."""


def hyperparameters(presets: Presets) -> Table:
    """Return Table A1 with Appendix 7.1, the paper's values beside those of both presets."""
    places = [(task, name) for name in (PAPER, DEFAULT) for task in TASKS]
    ours = zip(*(_hyperparameters(presets[place]) for place in places), strict=True)
    return Table(
        "Table A1. Hyper-parameters",
        ("parameter", "paper, shelf", "paper, knife", *(f"preset={name}, {task}" for task, name in places)),
        [(*map(Cell, said), *cells) for said, cells in zip(_TABLE_A1, ours, strict=True)],
    )


def _hyperparameters(preset: Preset) -> list[Cell]:
    """Return a preset's column of Table A1, each value with the config file, or the folder, that it stands in."""
    task, agent, trust = preset.task, preset.agent, preset.trust
    features = agent.network.fourier_features
    often = "update" if agent.target_every == 1 else f"{agent.target_every:,} updates"
    target = f"follows by {agent.target_rate:.0%} every {often}"
    width = f"{trust.sigmas:g}" if isinstance(trust, BoxSettings) else type(trust).__name__
    texts = {
        f"preset/{PAPER}.yaml" if preset.name == PAPER else "config.yaml": [f"{preset.train.max_episodes:,}"],
        f"task/{task.name}.yaml": [
            f"{task.goal_tolerance_m:g} m, {task.goal_rotation_tolerance_rad:.3g} rad",
            f"{task.position_tolerance_m:g} m, {task.rotation_tolerance_rad:g} rad",
        ],
        f"agent/{agent.name}.yaml": [
            f"{agent.learning_rate:g}",
            f"{agent.replay:,}",
            f"{agent.batch:,}",
            ", ".join(f"{units:,}" for units in agent.network.hidden),
            f"{size(task)}" + (f" and {features} Fourier features" if features else ""),
            str(COUNT),
            f"{agent.gamma:g}",
            f"{agent.epsilon_start:g} to {agent.epsilon_end:g} in {agent.epsilon_steps:,} actions",
            f"copied every {agent.target_every:,} updates" if agent.target_rate == 1.0 else target,
        ],
        "trust": [f"tube of {trust.coverage:.0%} coverage" if isinstance(trust, TubeSettings) else width],
        "./config.yaml": [f"{preset.demonstrations}"],
    }
    return [Cell(text, [conf_dir() / file]) for file, found in texts.items() for text in found]


_INTENT_NAMES: Final = {
    "paper": "paper: second-order lift, K = A G†",
    "pose": "pose: the default",
    "line": "line: least-squares line",
    "joint": "joint: one K for the whole pose",
}


def intents(studies: Studies) -> Table | MissingPart:
    """Return how well each intent predicts the demonstrations, a row a task and intent, or what it needs."""
    rows = []
    for task, by_name in studies.items():
        for name in INTENTS:
            report = by_name[name].report
            one, sixty, rolled = report["one_step_error_m"], report["sixty_samples"], report["roll_out_error_m"]
            turned, far = sixty["rms_over_persistence_rotation"], rolled["median_hausdorff"]
            texts = {
                "one step of the agent: RMS / largest [mm]": f"{one['rms'] * 1e3:.2f} / {one['max'] * 1e3:.2f}",
                "at 60 samples: RMS / largest [mm]": f"{sixty['rms_m'] * 1e3:.2f} / {sixty['max_m'] * 1e3:.2f}",
                "over persistence, position": f"{sixty['rms_over_persistence']:.3f}",
                "over persistence, rotation": "held" if turned is None else f"{turned:.3f}",
                "rolled out: goal reached": f"{rolled['reached_goal']} of {report['demonstrations']}",
                "median Hausdorff distance [mm]": f"{far * 1e3:.0f}" if far < 1.0 else "over 1000",
            }
            cells = (Cell(text, [by_name[name].file]) for text in texts.values())
            rows.append((Cell(f"{task}, {_INTENT_NAMES[name]}"), *cells))
    if not rows:
        reason = "It needs demonstrations that allow a fit, and none were found."
        return MissingPart(what="The table of intents", reason=reason)
    return Table("Intents compared", ("intent", *texts), rows)


_TRAINING: Final = (
    Quantity("episodes", "episodes", ",.0f"),
    Quantity("actions tried", "env_steps", ",.0f"),
    Quantity("updates", "updates", ",.0f"),
    Quantity("questions", "oracle_queries", ",.0f"),
    Quantity("agreement [%]", "reward_agreement.trusted", ".1f", 100.0),
    Quantity("time [s]", "seconds", ".0f"),
)


def training(groups: Groups) -> Table:
    """Return what training took, a row a task and preset."""
    rows = []
    for (task, preset), runs in groups.items():
        learned = f"{sum(run.train['learned'] for run in runs)} of {len(runs)}"
        cells = (quantity.over(_trained(runs)) for quantity in _TRAINING)
        rows.append((Cell(f"{task}, {preset} preset"), Cell(learned, [run.train_file for run in runs]), *cells))
    return Table("What training took", ("task", "learned", *(quantity.name for quantity in _TRAINING)), rows)


_EVALUATION: Final = (
    Quantity("success [%]", "success_rate", ".3g", 100.0),
    Quantity("deviation, mean [mm]", "path_deviation_mm.mean", ".1f"),
    Quantity("its 95th percentile of maxima [mm]", "path_deviation_mm.p95_of_max", ".0f"),
    Quantity("sideways, mean [mm]", "lateral_deviation_mm.mean", ".1f"),
)


def evaluation(groups: Groups) -> Table | MissingPart:
    """Return what the policies do from held-out starts, and what comes without learning; or what makes it."""
    rows = []
    for (task, preset), runs in groups.items():
        found = _measured(runs)
        methods = {"": f"{task}, {preset} preset: learned policy"} if found else {}
        if found and all(content["baselines"] is not None for _, content in found):
            names = Baselines.model_fields
            # Of a preset too: greedy and argmax are of its own intent and reward.
            of = f"{task}, {preset} preset"
            methods |= {f"baselines.{name}.": f"{of}: {name.replace('_', ' ')}, no learning" for name in names}
        for place, title in methods.items():
            rows.append((Cell(title), *(quantity.over(found, place) for quantity in _EVALUATION)))
    if not rows:
        what, reason = "The table of evaluations", "It needs evaluations, and none was found."
        return MissingPart(what=what, reason=reason, command="koopdqn report report.make=true")
    return Table("From held-out starts", ("method", *(quantity.name for quantity in _EVALUATION)), rows)


_ABLATED: Final = (
    Quantity("episodes", "episodes", ",.0f"),
    Quantity("questions", "oracle_queries", ",.0f"),
    Quantity("success [%]", "success_rate", ".3g", 100.0),
    Quantity("deviation [mm]", "deviation_mm", ".1f"),
)


def ablations(file: Path) -> Table | MissingPart:
    """Return the table of ``ablations.json``, a row a case and variant, or what makes it.

    What a variant changes is what it was trained with and the default of its case was not.

    Raises:
        BadInputError: the file is damaged.
    """
    if not file.is_file():
        reason = f"It needs {file}, which does not exist."
        return MissingPart(what="The table of ablations", reason=reason, command="make ablations")
    found = read_json(file, "the ablations")
    variants: dict[tuple[str, str], list[tuple[Path, Any]]] = {}
    rows = []
    try:
        for run in found:
            variants.setdefault((run["case"], run["variant"]), []).append((file, run))
        own = {(run["case"], run["seed"]): run["settings"]["train"] for run in found if run["variant"] == "default"}
        for place, runs in variants.items():
            learned = f"{sum(bool(run['learned']) for _, run in runs)} of {len(runs)}"
            first = runs[0][1]
            given, default = first["settings"]["train"], own.get((place[0], first["seed"]), {})
            changed = [f"`{name}={value}`" for name, value in given.items() if default.get(name) != value]
            cells = (quantity.over(runs) for quantity in _ABLATED)
            rows.append((Cell(", ".join(place)), Cell(" ".join(changed) or "nothing"), Cell(learned, [file]), *cells))
    except (KeyError, TypeError) as error:
        rule = "must hold one row a run as `make ablations` writes them"
        raise BadInputError(f"{file} {rule}, found: {error!r}") from error
    return Table(
        "Ablations", ("case, variant", "changed", "seeds learned", *(quantity.name for quantity in _ABLATED)), rows
    )


def shown_runs(groups: Groups) -> Table:
    """Return the runs that the report shows, a row a run."""
    rows = []
    for (task, preset), runs in groups.items():
        for run in runs:
            learned = f"yes, after {run.train['learned_at_env_steps']:,} actions" if run.train["learned"] else "no"
            folder, seed, outcome = (Cell(str(text), [run.train_file]) for text in (run.folder, run.seed, learned))
            counts = [Cell(f"{content['episodes']} starts", [file]) for file, content in _measured([run])]
            rows.append((folder, Cell(task), Cell(preset), seed, outcome, *(counts or [Cell("no")])))
    return Table("Runs that this page shows", ("folder", "task", "preset", "seed", "learned", "evaluated on"), rows)


def left_out(title: str, items: Sequence[LeftOut]) -> Table:
    """Return runs that have nothing to show, a row a run."""
    return Table(title, ("folder", "reason"), [(Cell(item.folder), Cell(item.reason)) for item in items])
