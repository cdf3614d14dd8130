"""The lines of the table that `make study` makes: what is trained, how it is measured, and with which seeds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

TASKS: Final = ("shelf", "knife", "both_sides")
EVALUATION_SEED: Final = 4100
"""Of the held-out starts; nothing was ever tuned on it, nor on the seeds of the trainings."""
SEEDS: Final = tuple(range(100, 110))
FEW: Final = SEEDS[:3]
"""Of lines whose single run takes minutes."""


@dataclass(frozen=True)
class Line:
    """One line.

    Attributes:
        name: of the line and of its folder.
        about: in a few words what it is.
        overrides: what the training changes of the default preset.
        evaluation: what the evaluation changes of it.
        of: name of the line whose training is measured, if it has none of its own.
        method: what learns from that training's demonstrations instead, if anything does.
        baselines: what of that which learns nothing is shown below it: keys of ``eval.json`` and what they are.
        tasks: on which it is measured.
        seeds: with which seeds it is measured.
        shown_anew: whether it learns from demonstrations of its own, not those of the other lines.
    """

    name: str
    about: str
    overrides: tuple[str, ...] = ()
    evaluation: tuple[str, ...] = ()
    of: str = ""
    method: Literal["", "cloning", "cloning-noise", "hg-dagger", "sqil", "dmp", "promp"] = ""
    baselines: Mapping[str, str] = field(default_factory=dict)
    tasks: tuple[str, ...] = TASKS
    seeds: tuple[int, ...] = SEEDS
    shown_anew: bool = False

    def named(self, baseline: str) -> str:
        """Return what the results of a baseline shown below the line are called."""
        return f"{self.name}/{baseline}"


def _person(name: str, about: str, *overrides: str) -> Line:
    floor = {"floor": "the action nearest to that person's next pose"}
    return Line(name, f"a person {about}", overrides, baselines=floor, tasks=("shelf",), shown_anew=True)


DEFAULT: Final = "default"
LINES: Final = (
    Line(
        DEFAULT,
        "the default preset",
        baselines={
            "greedy": "greedy on the intent model",
            "argmax_reward": "argmax of the reward, no network",
            "nearest_velocity": "greedy, K replaced by the nearest demonstrated pose's velocity",
            "mean_tangent": "greedy, K replaced by the mean demonstration's tangent",
            "mean_pursuit": "greedy, K replaced by pursuit of the mean demonstration",
            "floor": "the action nearest to the person's next pose",
            "mean_demonstration": "mean demonstration replayed",
            "nearest_demonstration": "nearest demonstration replayed",
            "constant_action": "the best constant action",
            "straight_line": "straight line to the goal",
        },
    ),
    Line("dmp", "DMP of the mean demonstration", of=DEFAULT, method="dmp"),
    Line("promp", "ProMP of the demonstrations", of=DEFAULT, method="promp"),
    Line("cloning", "behavioural cloning from observation", of=DEFAULT, method="cloning"),
    Line("cloning-noise", "behavioural cloning with noise augmentation", of=DEFAULT, method="cloning-noise"),
    Line("hg-dagger", "HG-DAgger, as many questions as the default", of=DEFAULT, method="hg-dagger"),
    Line("sqil", "SQIL on the same network", of=DEFAULT, method="sqil", seeds=FEW),
    Line("gamma-0", "no look-ahead", ("agent.gamma=0.0",), seeds=FEW),
    Line(
        "always-ask",
        "asked about every chosen action, nothing remembered",
        ("trust=nowhere", "agent.trials=chosen", "feedback.extend=false", "feedback.remember_m=0.0"),
        seeds=FEW,
    ),
    Line("trust-everywhere", "nobody is asked, the intent model is trusted everywhere", ("trust=everywhere",)),
    Line(
        "noisy-100",
        "ten answers in a hundred wrong, a yes certifies nothing around it: at least a hundred questions",
        ("oracle=noisy", "oracle.wrong=0.1", "feedback.extend=false"),
    ),
    Line(
        "wide",
        "the default, starts three times wider",
        evaluation=("eval.start_scale=3.0",),
        of=DEFAULT,
        baselines={"greedy": "greedy, starts three times wider"},
    ),
    _person("pursuit-5", "who looks 5 mm ahead instead of 15", "person.look_ahead_m=0.005"),
    _person("pursuit-60", "who looks 60 mm ahead", "person.look_ahead_m=0.06"),
    _person("square", "who first returns to the path at a right angle", "person=square"),
    _person("via", "who passes via points with the least jerk", "person=via"),
    _person("berth", "who keeps a wide berth", "person=wide"),
    Line(
        "continued",
        "trained on to five times the actions",
        ("train.stop=limit", "train.extend=5.0", "train.max_steps=5000000"),
        seeds=FEW,
    ),
)
PAPER: Final = "the paper preset"


@dataclass(frozen=True)
class Comparison:
    """Two lines, or baselines below one, that differ in what is to be shown, with the same seeds.

    Attributes:
        question: what their difference answers.
        line: name of the one with it.
        beside: name of the one without it.
    """

    question: str
    line: str
    beside: str


_DEFAULT: Final = LINES[0]
COMPARISONS: Final = (
    Comparison(
        "what K adds over the nearest demonstrated pose's velocity",
        _DEFAULT.named("greedy"),
        _DEFAULT.named("nearest_velocity"),
    ),
    Comparison(
        "what K adds over the mean demonstration's tangent", _DEFAULT.named("greedy"), _DEFAULT.named("mean_tangent")
    ),
    Comparison(
        "what K adds over pursuit of the mean demonstration", _DEFAULT.named("greedy"), _DEFAULT.named("mean_pursuit")
    ),
    Comparison("what the network adds over argmax of the reward", DEFAULT, _DEFAULT.named("argmax_reward")),
    Comparison("what learning adds over greedy on the intent model", DEFAULT, _DEFAULT.named("greedy")),
    Comparison("what asking adds over trusting everywhere", DEFAULT, "trust-everywhere"),
    Comparison("the default over the nearest demonstration replayed", DEFAULT, _DEFAULT.named("nearest_demonstration")),
    Comparison("the default over a DMP", DEFAULT, "dmp"),
    Comparison("the default over a ProMP", DEFAULT, "promp"),
    Comparison("the default over cloning with noise", DEFAULT, "cloning-noise"),
    Comparison("the default over HG-DAgger", DEFAULT, "hg-dagger"),
)
