"""What a finished training left in its folder, read back to look at it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.eval import step_limit_of
from koopdqn.app.commands.pipeline import POLICY
from koopdqn.app.commands.train import REPORT
from koopdqn.artifact import read_artifact, reading
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.storage import read_intent
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.rl import checkpoint
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import Policy, PolicyAround, around, read_policy
from koopdqn.tasks.workcell import Workcell

_FEEDBACK: Final = "feedback/"


@dataclass(frozen=True)
class TrainedRun:
    """A finished training.

    Attributes:
        policy: what was learned; led around what stands in the scene now, and along what a person corrected.
        demonstrations: that it learned from.
        workcell: task, arm and scene.
        feedback: the reward function, with what answers taught.
        step_limit: of its episodes.
        referred: whether the scripted person's own paths are what learned ones are compared with.
    """

    policy: Policy | PolicyAround
    demonstrations: Demonstrations
    workcell: Workcell
    feedback: Feedback
    step_limit: int
    referred: bool


def read_trained(config: Configuration, source: Path) -> TrainedRun:
    """Return the training in a folder.

    Raises:
        BadInputError: a file is missing or damaged, or obstacles leave no way.
    """
    policy, _ = read_policy(source / POLICY, config.task, anywhere=True)
    demonstrations = pipeline.demonstrations_of(config, source)
    intent = read_intent(source / pipeline.INTENT, config.task)
    workcell = pipeline.open_scene(config)
    reward = pipeline.reward_of(config, workcell, intent, agent_steps(demonstrations, config.task))
    served = around(policy, reward.model)
    feedback = Feedback(reward, ScriptedOracle(config.task), config.feedback)
    path = checkpoint.checkpoint_path(source)
    if path.is_file():
        arrays = read_artifact(path, checkpoint.KIND).arrays
        with reading(f"checkpoint {path}"):
            feedback.restore({k.removeprefix(_FEEDBACK): v for k, v in arrays.items() if k.startswith(_FEEDBACK)})
    referred = pipeline.held_out_of(config) is None
    return TrainedRun(served, demonstrations, workcell, feedback, step_limit_of(source / REPORT), referred)
