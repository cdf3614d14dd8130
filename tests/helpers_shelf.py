"""The shelf workcell with three demonstrations and a fitted intent, made once for all tests that need it."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from parts import load_parts

from koopdqn.demonstrations.generate import generate
from koopdqn.intent.fit import agent_steps, fit
from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.trust import TrustDomain
from koopdqn.pose import Array
from koopdqn.tasks.workcell import Workcell, open_workcell

PARTS = load_parts()


@cache
def shelf() -> Workcell:
    return open_workcell(PARTS.task, PARTS.arm)


@dataclass(frozen=True)
class Taught:
    model: IntentModel
    trust: TrustDomain
    trajectories: list[Array]


@cache
def taught() -> Taught:
    cell = shelf()
    settings = PARTS.demo.model_copy(update={"count": 3})
    demonstrations = generate(cell.task, cell.reachability, settings, seed=0).demonstrations
    fitted = fit(demonstrations, cell.task, PARTS.intent, PARTS.trust, PARTS.reward)
    return Taught(fitted.model, fitted.trust, agent_steps(demonstrations, cell.task))


def reward_of(known: Taught) -> IntentReward:
    """Return the reward function of what was taught."""
    return IntentReward(PARTS.task, known.model, known.trust, PARTS.reward)


@cache
def held_out(count: int) -> tuple[Array, Array]:
    """Return ``count`` starts and their joints."""
    cell = shelf()
    starts, joints, _ = cell.reachability.draw_starts(cell.task, np.random.default_rng(5), count)
    return starts, joints
