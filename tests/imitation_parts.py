"""A short way round a corner, shown three times, that imitating takes seconds to learn."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from imitation.inferred import Imitator
from parts import load_parts
from small_run import SMALL

from koopdqn.demonstrations.generate import generate
from koopdqn.intent.fit import agent_steps
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy
from koopdqn.rl.settings import AgentSettings
from koopdqn.tasks.rollout import SUCCESS, roll_out
from koopdqn.tasks.workcell import Workcell, open_workcell

STEP_LIMIT = 200
_CORNER = "task.waypoints=[[0.45,-0.20,0.45],[0.39,-0.21,0.45],[0.37,-0.13,0.45]]"


@dataclass(frozen=True)
class Short:
    cell: Workcell
    agent: AgentSettings
    trajectories: list[Array]


@cache
def short() -> Short:
    parts = load_parts(*SMALL, _CORNER)
    cell = open_workcell(parts.task, parts.arm)
    shown = generate(cell.task, cell.reachability, parts.demo, seed=0).demonstrations
    return Short(cell, parts.agent, agent_steps(shown, cell.task))


def success(policy: Policy, count: int = 20) -> float:
    """Return the share of held-out starts from which a policy succeeds."""
    cell = short().cell
    starts, joints, _ = cell.reachability.draw_starts(cell.task, np.random.default_rng(11), count)
    episodes = roll_out(policy, cell.task, cell.reachability, starts, joints, STEP_LIMIT)
    return sum(episode.outcome == SUCCESS for episode in episodes) / count


def parameters(imitator: Imitator) -> list[np.ndarray]:
    return [values.numpy() for values in imitator.policy.network.state_dict().values()]
