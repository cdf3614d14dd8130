"""The lines of the table that `make study` makes: what is trained, how it is measured, and with which seeds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

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
        seeds: with which seeds it is measured.
    """

    name: str
    about: str
    overrides: tuple[str, ...] = ()
    evaluation: tuple[str, ...] = ()
    of: str = ""
    method: Literal["", "cloning", "sqil"] = ""
    baselines: Mapping[str, str] = field(default_factory=dict)
    seeds: tuple[int, ...] = SEEDS

    def named(self, baseline: str) -> str:
        """Return what the results of a baseline shown below the line are called."""
        return f"{self.name}/{baseline}"


DEFAULT: Final = "default"
LINES: Final = (
    Line(
        DEFAULT,
        "the default preset",
        baselines={
            "greedy": "greedy on the intent model",
            "argmax_reward": "argmax of the reward, no network",
            "floor": "the action nearest to the person's next pose",
            "mean_demonstration": "mean demonstration replayed",
            "nearest_demonstration": "nearest demonstration replayed",
            "constant_action": "the best constant action",
            "straight_line": "straight line to the goal",
        },
    ),
    Line("cloning", "behavioural cloning from observation", of=DEFAULT, method="cloning"),
    Line("sqil", "SQIL on the same network", of=DEFAULT, method="sqil", seeds=FEW),
    Line("gamma-0", "no look-ahead", ("agent.gamma=0.0",)),
    Line(
        "always-ask",
        "asked about every chosen action, nothing remembered",
        ("trust=nowhere", "agent.trials=chosen", "feedback.extend=false", "feedback.remember_m=0.0"),
        seeds=FEW,
    ),
    Line("wrong-answers", "one answer in twenty wrong", ("oracle=noisy", "oracle.wrong=0.05")),
    Line(
        "wide",
        "the default, starts three times wider",
        evaluation=("eval.start_scale=3.0",),
        of=DEFAULT,
        baselines={"greedy": "greedy, starts three times wider"},
    ),
    Line(
        "continued",
        "trained on to five times the actions",
        ("train.stop=limit", "train.extend=5.0", "train.max_steps=5000000"),
        seeds=FEW,
    ),
)
PAPER: Final = "the paper preset"
