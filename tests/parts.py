"""Typed parts of a composed config, and small stand-ins, for tests."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.app.hydra.folder import ensure_resolver
from koopdqn.app.recording import DemoSettings
from koopdqn.artifact import described
from koopdqn.demonstrations.dataset import Demonstration, Demonstrations
from koopdqn.intent.model import IntentSettings
from koopdqn.intent.reward import RewardSettings
from koopdqn.intent.trust import TrustSettings
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.pose import Array
from koopdqn.resources import conf_dir
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.rl.settings import AgentSettings, TrainSettings
from koopdqn.robot.ur import URArm
from koopdqn.settings import TARGET, load_settings, validate
from koopdqn.tasks.shelf import ShelfTask
from koopdqn.tasks.task import Task


@dataclass(frozen=True)
class Parts:
    """The groups of a composed config that the core uses."""

    task: ShelfTask
    arm: URArm
    demo: DemoSettings
    intent: IntentSettings
    trust: TrustSettings
    agent: AgentSettings
    reward: RewardSettings
    feedback: FeedbackSettings
    train: TrainSettings


def load_parts(*overrides: str) -> Parts:
    """Return the typed parts of the project's own config under overrides."""
    from hydra import compose, initialize_config_dir

    ensure_resolver()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = compose("config", overrides=list(overrides))
    return Parts(
        load_settings(config.task, ShelfTask, "task"),
        load_settings(config.robot, URArm, "robot"),
        validate(config.demo, DemoSettings, "demo"),
        load_settings(config.intent, IntentSettings, "intent"),
        load_settings(config.trust, TrustSettings, "trust"),
        load_settings(config.agent, AgentSettings, "agent"),
        validate(config.reward, RewardSettings, "reward"),
        validate(config.feedback, FeedbackSettings, "feedback"),
        validate(config.train, TrainSettings, "train"),
    )


def with_fields(task: Task, **fields: object) -> ShelfTask:
    """Return the shelf task with some fields changed and checked anew (``model_copy`` would keep what is cached)."""
    node = {key: value for key, value in described(task).items() if key != TARGET}
    return validate(node | fields, ShelfTask, "task")


def straight_poses(start: Array, end: Array, count: int, quaternion: Array) -> Array:
    """Return poses (count, 7) evenly on the line between two positions (3,) [m], orientation held."""
    share = np.linspace(0.0, 1.0, count)[:, None]
    return pose.make((1 - share) * start + share * end, quaternion)


def as_demonstrations(task: str, trajectories: list[Array]) -> Demonstrations:
    """Return pose trajectories (N, 7) as demonstrations, a sample every 0.1 s."""
    items = [Demonstration(0.1 * np.arange(float(len(poses))), poses) for poses in trajectories]
    return Demonstrations(task, "UR5", items)


class Clerk(Oracle):
    """An oracle that answers by a rule and keeps what it was asked."""

    def __init__(self, rule: Callable[[Question], bool | None] = lambda question: True) -> None:
        self.rule = rule
        self.asked: list[Question] = []
        self.closed = False

    def answer(self, question: Question) -> Answer:
        self.asked.append(question)
        return Answer(self.rule(question), "clerk", 0.25)

    def close(self) -> None:
        self.closed = True
