"""What a finished training left in its folder, read back to look at it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.demonstrated import with_task
from koopdqn.app.hydra.application import given_now, how_to_go_on, search_path
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.app.hydra.record import read_record
from koopdqn.artifact import below, described, read_artifact, reading
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.errors import BadInputError
from koopdqn.evaluation.correction import check_clear
from koopdqn.files import read_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.reward import IntentReward, RewardSettings
from koopdqn.intent.storage import StoredIntent, read_intent
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.checkpoint import latest_checkpoint
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.policy import Policy, PolicyAround, around, read_policy
from koopdqn.robot.arm import Arm
from koopdqn.robot.mjcf import MjcfArm, recorded_arm
from koopdqn.run_folder import BEGUN, CHECKPOINT, INTENT, POLICY, TRAINING
from koopdqn.settings import load_settings, shown
from koopdqn.tasks.demonstrated import DemonstratedTask
from koopdqn.tasks.task import Task
from koopdqn.tasks.unfolding import Unfolding
from koopdqn.tasks.workcell import Workcell

_LONGEST = 1_000_000
"""The most steps that an episode may be given."""


@dataclass(frozen=True)
class TrainedRun:
    """A finished training.

    Attributes:
        policy: what was learned; led around what stands in the scene now, and along what a person corrected.
        about: the metadata of the policy's file.
        demonstrations: that it learned from.
        trajectories: their poses (N, 7) at the agent's step.
        intent: that was fitted to them.
        workcell: task, arm and scene.
        reward: the reward function of the intent.
        step_limit: of its episodes.
        referred: whether the scripted person's own paths are what learned ones are compared with.
    """

    policy: Policy | PolicyAround
    about: dict[str, Any]
    demonstrations: Demonstrations
    trajectories: list[Array]
    intent: StoredIntent
    workcell: Workcell
    reward: IntentReward
    step_limit: int
    referred: bool

    @property
    def beside(self) -> list[tuple[str, str]]:
        """A remark, in two parts, if obstacles stand in the scene that the policy never saw."""
        if not self.obstacles_added:
            return []
        if isinstance(self.policy, PolicyAround) and self.policy.policy.bend is None:
            return [("led around", "obstacles that the policy never saw")]
        return [("among", "obstacles that the policy never saw, none of them in its way")]

    @property
    def obstacles_added(self) -> bool:
        """Whether obstacles stand in the scene that the policy never saw."""
        return bool(self.workcell.task.obstacles) and not self.about["task"].get("obstacles")


def read_trained(config: Configuration, source: Path) -> TrainedRun:
    """Return the training in a folder.

    Raises:
        BadInputError: a file is missing or damaged, obstacles leave no way, or they stand in that of a corrected run.
    """
    policy, about = read_policy(source / POLICY, config.task, anywhere=True)
    demonstrations = pipeline.demonstrations_of(config, source)
    intent = read_intent(source / INTENT, config.task)
    limit = step_limit_of(source)
    workcell = pipeline.open_scene(config)
    trajectories = agent_steps(demonstrations, config.task)
    reward = pipeline.reward_of(config, workcell, intent, trajectories)
    served, referred = around(policy, reward.model), config.derived is None
    run = TrainedRun(served, about, demonstrations, trajectories, intent, workcell, reward, limit, referred)
    if run.obstacles_added and policy.bend is not None:
        check_clear(workcell, served, limit)
    return run


def feedback_of(config: Configuration, trained: TrainedRun, source: Path) -> Feedback:
    """Return the reward function of the training in a folder, with what answers taught if a checkpoint holds it.

    Raises:
        BadInputError: the checkpoint is damaged.
    """
    feedback = Feedback(trained.reward, ScriptedOracle(config.task), config.feedback)
    checkpoint = latest_checkpoint(source)
    if checkpoint is not None:
        with reading(f"checkpoint {source / CHECKPOINT}"):
            feedback.restore(below(checkpoint.arrays, "feedback/"))
    return feedback


def as_recorded(run: Path, config: Configuration, *more: str) -> list[str]:
    """Return the overrides that make the config that a run was begun with, as Hydra takes them.

    What a run folder cannot say is the present command's: where options are searched, and where its arm's file lies.
    """
    # A folder of the default name would be made.
    given = [f"run={run}", "out=unused", *more]
    arms = [item.value for item in read_record(run, "a training run") if item.key == "robot"]
    if arms[-1:] == ["mjcf"]:
        given += [f"robot.path={config.robot.path}"] if isinstance(config.robot, MjcfArm) else given_now("robot")
    return [*prepare("eval", given).overrides, *search_path()]


def as_trained(config: Configuration, run: Path) -> Configuration:
    """Return a config with the task, arm and reward that a run was trained with, as its policy's file holds them.

    They may differ from the config because koopdqn's defaults have changed since. What the command line changes
    stays changed, and whether it fits the policy is for others to say.

    Raises:
        BadInputError: the file is missing, damaged, or holds what this release does not know.
    """
    policy = run / POLICY
    if not policy.exists() and (run / BEGUN).is_file():
        raise BadInputError(
            f"run: must have been trained to its end, found it stopped on the way; {how_to_go_on('train', run)}"
        )
    artifact = read_artifact(policy, "policy")
    about = artifact.about
    taken = "continuous" if "actions" in about else "table1"
    if taken != config.inputs.actions:
        raise BadInputError(f"actions: must be those of the run's policy, {taken}, found {config.inputs.actions}")
    with reading(f"policy {policy}"):
        task = load_settings(about["task"], Task, "task")
        robot = recorded_arm(about["robot"], config.robot) or config.robot
        reward = load_settings(about["reward"], RewardSettings, "reward")
        unfolding = Unfolding.restore(below(artifact.arrays, "frame/"))
    if not task.obstacles:
        # They may be added to any task.
        task = task.model_copy(update={"obstacles": config.task.obstacles})
    trained: dict[str, Any] = {"task": task, "robot": robot, "reward": reward}
    changed = [name for name, each in trained.items() if described(each) != described(getattr(config, name))]
    if unfolding is not None and "task" not in changed:
        config = _shown_as_trained(config, task, unfolding)
    if not changed:
        return config
    recorded = composed(as_recorded(run, config))
    if config.task.obstacles and not about["task"].get("obstacles"):
        recorded.task.obstacles = described(config.task)["obstacles"]
    default = with_task(Configuration.load(recorded), run, keep=False)
    own = [name for name in changed if described(getattr(default, name)) == described(getattr(config, name))]
    for name in own:
        console.note(f"{name}: as in the run, from which today's defaults differ")
    if "task" in own and config.derived is None:
        config = replace(config, chosen=task)
    elif "task" in own:
        config = _shown_as_trained(config, task, unfolding)
    return replace(config, **{name: trained[name] for name in own if name != "task"})


def _shown_as_trained(config: Configuration, task: Task, unfolding: Unfolding | None) -> Configuration:
    """Return a config with a task as its run was trained with it, shown by the config's demonstrations."""
    if config.derived is None or not isinstance(task, DemonstratedTask):
        return config
    task = task.showing(agent_steps(config.derived.training, task), unfolding)
    return replace(config, derived=replace(config.derived, task=task))


def differs_from_trained(robot: Arm, trained: Mapping[str, Any]) -> bool:
    """Return whether an arm is another than the one that a policy's file says it was trained with."""
    mine: Any = robot
    its: Any = recorded_arm(trained, robot)
    return its is None or described(mine) != described(its)


def step_limit_of(run: Path) -> int:
    """Return the step limit that a run's training report says.

    Raises:
        BadInputError: the file is missing, or holds none.
    """
    path = run / TRAINING
    report = read_json(path, "the training report")
    limit = report.get("step_limit") if isinstance(report, dict) else None
    if not isinstance(limit, int) or isinstance(limit, bool) or not 1 <= limit <= _LONGEST:
        raise BadInputError(
            f"{path}: step_limit must be a whole number above 0, at most {_LONGEST}, found {shown(limit)}"
        )
    return limit
