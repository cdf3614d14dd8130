"""The shelf workcell with three demonstrations and a fitted intent, made once for all tests that need it."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
from omegaconf import OmegaConf

from koopdqn.config.settings import load_settings
from koopdqn.demonstrations.generator import DemonstrationSettings, generate
from koopdqn.intent.fitting import agent_steps, fit
from koopdqn.intent.model import IntentModel, IntentSettings
from koopdqn.intent.trust import TrustDomain, TrustSettings
from koopdqn.pose import Array
from koopdqn.robot.arm import Arm
from koopdqn.tasks.task import Task
from koopdqn.workcell import Workcell, open_workcell

T = TypeVar("T")


def configured(group: str, option: str, base: type[T]) -> T:
    path = Path(__file__).parents[1] / "conf" / group / f"{option}.yaml"
    return load_settings(cast(dict[Any, Any], OmegaConf.to_container(OmegaConf.load(path))), base, group)


@cache
def shelf() -> Workcell:
    return open_workcell(configured("task", "shelf", Task), configured("robot", "ur5", Arm))


@dataclass(frozen=True)
class Taught:
    model: IntentModel
    trust: TrustDomain
    trajectories: list[Array]


@cache
def taught() -> Taught:
    cell = shelf()
    settings = DemonstrationSettings(count=3, speed_m_s=0.1, pace_variation=0.3, sample_seconds=0.02)
    demonstrations = generate(cell.task, cell.reachability, settings, seed=0).demonstrations
    intent, trust = configured("intent", "fourier", IntentSettings), configured("trust", "tube", TrustSettings)
    fitted = fit(demonstrations, cell.task, intent, trust)
    return Taught(fitted.model, fitted.trust, agent_steps(demonstrations, cell.task))


@cache
def held_out(count: int) -> tuple[Array, Array]:
    """Return ``count`` starts and their joints."""
    cell = shelf()
    starts, joints, _ = cell.reachability.draw_starts(cell.task, np.random.default_rng(5), count)
    return starts, joints
