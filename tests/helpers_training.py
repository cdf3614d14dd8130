"""A small and short training, for tests of the trainer and of what answers do in it."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from parts import Clerk, Parts

from koopdqn.intent.reward import IntentReward
from koopdqn.intent.tube import Tube
from koopdqn.oracles.base import Asking, Oracle
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.tasks.workcell import Workcell

UNCHECKED = {"check_every": 10**6}
FORGETFUL = {"remember_m": 0.0, "extend": False}
"""Answers that teach nothing but the reward of the action asked about."""

_AGENT = {
    "batch": 16,
    "replay": 400,
    "warm_up": 60,
    "episodes_at_once": 4,
    "updates_per_round": 4,
    "exploring_steps": 8,
    "epsilon_steps": 1000,
}
_TRAIN = {"gain": 1.0, "check_every": 10, "max_steps": 500, "max_episodes": 200, "stop": "limit", "check_success": 1.0}


def small_trainer(
    parts: Parts,
    workcell: Workcell,
    reward: IntentReward,
    trajectories: list[Array],
    oracle: Oracle | None = None,
    seed: int = 0,
    agent: dict[str, Any] | None = None,
    train: dict[str, Any] | None = None,
    feedback: dict[str, Any] | None = None,
    asking: Asking = Asking(),  # noqa: B008 (frozen)
) -> Trainer:
    """Return a trainer of a second or two, with some settings changed.

    It learns the last part of the demonstrations: a low step limit, so that checks are short.
    """
    network = parts.agent.network.model_copy(update={"hidden": (8,), "fourier_features": 8})
    return Trainer(
        workcell,
        reward,
        [rows[-20:] for rows in trajectories[:3]],
        oracle or ScriptedOracle(workcell.task),
        parts.agent.model_copy(update={"network": network, **_AGENT, **(agent or {})}),
        parts.train.model_copy(update={**_TRAIN, **(train or {})}),
        seed,
        parts.feedback.model_copy(update=feedback or {}),
        asking,
    )


def untrusting(reward: IntentReward) -> IntentReward:
    """The same reward with a trust domain that trusts nothing, so that everything legal is asked."""
    assert isinstance(reward.trust, Tube)
    trust = replace(reward.trust, radius=1e-6 * reward.trust.radius)
    return IntentReward(reward.task, reward.model, trust, reward.settings)


def assert_spends_its_budget(make: Callable[..., Trainer], clerk: Clerk, when_spent: str) -> Trainer:
    """Train with a budget of five questions, check that they are all that is asked, and return the trainer."""
    trainer = make(
        clerk,
        asking=Asking(budget=5, when_spent=when_spent),  # type: ignore[arg-type]  # one of the literals
        feedback=FORGETFUL,
        train={"max_steps": 300, "max_episodes": 60, **UNCHECKED},
    )
    trainer.run()
    assert trainer.questions == len(clerk.asked) == 5
    assert [asked.left for asked in clerk.asked] == [5, 4, 3, 2, 1]
    assert trainer.feedback.spent
    assert trainer.feedback.stopped == (when_spent == "stop")
    assert (trainer.feedback.substituted > 0) == (when_spent == "scripted")
    return trainer


def assert_same_run(one: Trainer, two: Trainer) -> None:
    (arrays, about), (other_arrays, other_about) = one.state(), two.state()
    for part in about:
        assert about[part] == other_about[part], part
    assert arrays.keys() == other_arrays.keys()
    for name, values in arrays.items():
        np.testing.assert_array_equal(values, other_arrays[name], err_msg=name)
