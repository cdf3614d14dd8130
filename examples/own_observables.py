"""Observables of your own: powers of every component, beside the paper's second-order lift and the default.

Run it with ``python examples/own_observables.py demo.count=5``.
"""

import sys

import numpy as np
from pydantic import Field

import koopdqn
from koopdqn.intent.observables import Observables
from koopdqn.pose import Array


class Powers(Observables):
    """Every component to the powers 2, 3 … up to the highest."""

    highest: int = Field(ge=2, le=9, description="highest power")

    def features(self, states: Array) -> Array:
        """Return the features (N, d (highest − 1)) of states (N, d)."""
        return np.concatenate([states**power for power in range(2, self.highest + 1)], axis=1)


def held_out_error(*overrides: str) -> float:
    """Return the root mean square error of one step [mm] on demonstrations left out of the fit."""
    config = koopdqn.load_config("task=shelf", *overrides)
    report = koopdqn.fit(config, koopdqn.generate(config)).report
    return 1e3 * float(report["one_step_error_m"]["rms"])


if __name__ == "__main__":
    own = ("intent=paper", "intent.observables.target=own_observables.Powers")
    for name, overrides in {
        "powers up to 3": (*own, "+intent.observables.highest=3"),
        "second order (the paper)": ("intent=paper",),
        "the default": (),
    }.items():
        print(f"{name:26s} {held_out_error(*overrides, *sys.argv[1:]):.4f} mm a step")
