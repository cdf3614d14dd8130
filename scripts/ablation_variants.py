"""What `make ablations` measures: cases, and the default config with one deviation from the paper undone."""

from dataclasses import dataclass
from typing import Final

# More actions than the default config needs to learn in any case. A variant that stores one action a step, not all
# that are known, makes as many updates with a tenth of them.
ALL_TRIED: Final = 700_000
ONE_TRIED: Final = 70_000


@dataclass(frozen=True)
class Case:
    """A task of the package, or motions of people.

    Attributes:
        name: of the case, of its column and of its folder.
        overrides: what makes it the training's task.
        file: of a set of people's motions, below the folder that holds all of them; "" of a task of the package. The
            last demonstration is held out.
    """

    name: str
    overrides: tuple[str, ...]
    file: str = ""


CASES: Final = (
    Case("shelf", ("task=shelf",)),
    Case("knife", ("task=knife",)),
    Case("plate", ("task=demonstrated",), "franka/plate.csv"),
    Case("pouring", ("task=demonstrated",), "franka/pouring.csv"),
    Case("gshape", ("task=demonstrated",), "lasa/gshape.csv"),
)


@dataclass(frozen=True)
class Variant:
    """The default config with something as the paper has it.

    Attributes:
        name: of the variant and of its folder.
        undone: numbers of the deviations of docs/algorithm.md that it undoes, wholly or in part.
        overrides: what it changes.
        most_actions: limit of the training, in actions tried.
    """

    name: str
    undone: tuple[int, ...]
    overrides: tuple[str, ...]
    most_actions: int = ALL_TRIED


DEFAULT: Final = Variant("default", (), ())
VARIANTS: Final = (
    DEFAULT,
    Variant("paper-intent", (1, 2, 3), ("intent=paper",)),
    Variant("apart", (1, 2, 3), ("intent=fourier",)),
    # Augmented states no farther than one step from the mean demonstration, and turned as it is.
    Variant("nothing-leads-back", (2,), ("intent.copies=1", "intent.far=0.001", "intent.far_rad=0.001")),
    Variant("raw-prediction", (4,), ("reward.prediction=raw",)),
    Variant("sign", (5,), ("reward.shape=sign",)),
    Variant("no-goal-bonus", (5,), ("reward.goal=0.0",)),
    Variant("box", (6,), ("trust=box",)),
    Variant("reached", (6,), ("trust.needs=reached",)),
    Variant("not-calibrated", (7,), ("trust.least_right=0.0", "trust.doubts=[0.0]")),
    Variant("paper-trust", (6, 7), ("trust=paper",)),
    Variant("trust-everywhere", (6, 7), ("trust=everywhere",)),
    Variant("single", (8,), ("agent.double=false",)),
    Variant("chosen", (9, 11), ("agent.trials=chosen",), ONE_TRIED),
    # As many actions between two updates as sixty-four episodes try.
    Variant("one-episode", (9,), ("agent.episodes_at_once=1", "agent.rounds_per_update=64")),
    Variant("no-exploring", (10,), ("agent.exploring_starts=0.0", "agent.exploring_scale=1.0")),
    Variant("no-extension", (12,), ("feedback.extend=false",)),
    Variant("no-memory", (13,), ("feedback.remember_m=0.0",)),
    Variant("plain-inputs", (14,), ("agent.network.fourier_features=0",)),
    Variant("position-features", (14,), ("agent.network.length_scale_rad=100.0",)),
    Variant("paper-network", (14,), ("agent.network.fourier_features=0", "agent.network.hidden=[1024,1024]")),
    Variant("transitions", (15,), ("agent.drawn=transitions", "agent.batch=1000")),
    Variant("online", (16,), ("agent.policy_network=online",)),
    Variant(
        "copied-target",
        (16,),
        ("agent.policy_network=online", "agent.target_rate=1.0", "agent.target_every=500"),
    ),
    Variant("gamma-0.9", (17,), ("agent.gamma=0.9",)),
    Variant("learning-rate", (17,), ("agent.learning_rate=0.0001",)),
    Variant("epsilon", (17,), ("agent.epsilon_start=1.0", "agent.epsilon_end=0.05", "agent.epsilon_steps=50000")),
    Variant("goal-tolerance", (18,), ("task.goal_rotation_tolerance_rad=0.005",)),
)
