"""The variants that `make ablations` measures: the default config with one idea left out or put in its place."""

from dataclasses import dataclass
from typing import Final

# Twice the actions that the default config needs to learn; variants that store one action a step, not all that are
# known, need far fewer and have their own limit, again twice what they need.
ALL_TRIED: Final = 700_000
ONE_TRIED: Final = 85_000


@dataclass(frozen=True)
class Variant:
    """The default config with something left out or put in its place.

    Attributes:
        name: of the variant and of its folder.
        overrides: what it changes.
        about: in a few words what that is; D numbers are those of docs/algorithm.md.
        most_actions: limit of the training, in actions tried.
    """

    name: str
    overrides: tuple[str, ...]
    about: str
    most_actions: int = ALL_TRIED


FORGETFUL: Final = ("feedback.extend=false", "feedback.remember_m=0.0")

VARIANTS: Final = (
    Variant("default", (), "the default config"),
    # Stepping back is measured as the paper has it, an answer being used once.
    Variant(
        "chosen",
        ("agent.trials=chosen", "agent.step_back=true", *FORGETFUL),
        "one action a step, stepping back, answers used once (D13)",
        ONE_TRIED,
    ),
    Variant(
        "no-step-back",
        ("agent.trials=chosen", "agent.step_back=false", *FORGETFUL),
        "the same without stepping back",
        ONE_TRIED,
    ),
    Variant("trust-everywhere", ("trust=everywhere",), "no trust domain: the model decides everywhere (D7)"),
    # Asking the likeliest action first would hide wrong actions from the network; asking about the chosen one does not.
    Variant(
        "always-ask",
        ("trust=nowhere", "agent.trials=chosen", *FORGETFUL),
        "the person is asked about every chosen action (D18)",
        ONE_TRIED,
    ),
    Variant("forgetful", FORGETFUL, "answers neither remembered nor extending anything (D25, D26)"),
    Variant("one-sigma", ("trust=box", "trust.sigmas=1.0"), "trust within 1 σ of every component (D7)"),
    Variant("two-sigmas", ("trust=box", "trust.sigmas=2.0"), "trust within 2 σ (D7)"),
    Variant("three-sigmas", ("trust=box", "trust.sigmas=3.0"), "trust within 3 σ (D7)"),
    Variant("line", ("intent=line",), "a line fit instead of a Koopman model"),
    Variant("paper-lift", ("intent=paper",), "the paper's lift, fitted as the paper does (D1–D3)"),
    Variant("apart", ("intent=fourier",), "K_p and K_o apart, demonstrations surrounded one by one (D1, D2)"),
    Variant("raw-prediction", ("reward.prediction=raw",), "the raw prediction is compared (D4)"),
    Variant("sign", ("reward.shape=sign",), "rewards of one size (D5)"),
    Variant("no-doubt", ("trust.doubts=[0.0]",), "close comparisons count too (D6)"),
    Variant(
        "no-exploring",
        ("agent.exploring_starts=0.0", "agent.exploring_scale=1.0"),
        "every episode begins in the start region (D14)",
    ),
    Variant("gamma-0", ("agent.gamma=0.0",), "no look-ahead: γ = 0 (D16)"),
)
