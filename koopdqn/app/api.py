"""koopdqn from Python: each stage of the command line as one function of a config and what came before."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.commands.demonstrated import with_task
from koopdqn.app.hydra.compose import composed, explain
from koopdqn.app.hydra.overrides import as_hydra_takes_it, literal
from koopdqn.demonstrations.dataset import Demonstrations
from koopdqn.demonstrations.generate import generate as generate_demonstrations
from koopdqn.errors import BadInputError
from koopdqn.evaluation.evaluate import Evaluation
from koopdqn.evaluation.evaluate import evaluate as evaluate_policy
from koopdqn.intent.fit import Fitted, agent_steps, check_shown
from koopdqn.intent.fit import fit as fit_intent
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.storage import StoredIntent
from koopdqn.oracles.base import Oracle
from koopdqn.settings import shown, typed
from koopdqn.tasks.workcell import Workcell

if TYPE_CHECKING:
    from koopdqn.envs.batch import EnvironmentParts
    from koopdqn.envs.dm import KoopmanEnvironment
    from koopdqn.rl.checks import Check, History
    from koopdqn.rl.policy import Policy


@dataclass(frozen=True)
class Trained:
    """What training brought.

    Attributes:
        policy: the best by its checks.
        learned: whether the task was learned within the limits.
        questions: how many the oracle was asked.
        step_limit: steps after which an episode is cut.
        history: checks, episodes and rewards on the way.
    """

    policy: "Policy"
    learned: bool
    questions: int
    step_limit: int
    history: "History"


@typed
def load_config(*overrides: str, config_dir: str | Path | None = None) -> Configuration:
    """Return the config under overrides in Hydra's grammar, such as ``"task=shelf"`` and ``"seed=3"``.

    Args:
        overrides: as on the command line of ``koopdqn train``, short names such as ``obstacles=FILE`` included.
        config_dir: a folder of own options, searched beside koopdqn's.

    Raises:
        BadInputError: a key or option is unknown or of the command line alone, as ``out=`` and ``run=``, a value breaks
            a rule, or ``demos=`` cannot be learned from.
    """
    odd = [each for each in overrides if not isinstance(each, str)]
    if odd:
        raise BadInputError(f"an override must be a text such as 'seed=3', found {shown(odd[0])}")
    if config_dir is not None and not Path(config_dir).is_dir():
        raise BadInputError(f"config_dir: must be a folder that exists, found {str(config_dir)!r}")
    own = [] if config_dir is None else [f"hydra.searchpath=[{literal(f'file://{Path(config_dir).resolve()}')}]"]
    try:
        config = Configuration.load(composed([*own, "out=.", *map(as_hydra_takes_it, overrides)]))
    except Exception as error:
        told = explain(error)
        if told is None:
            raise
        raise told from error
    return with_task(config, None, keep=False)


@typed
def open_workcell(config: Configuration) -> Workcell:
    """Return task, arm and compiled MuJoCo scene, in which starts are drawn and moves are tried.

    Args:
        config: of the task and the arm.

    Raises:
        BadInputError: the scene does not compile, or the arm cannot take the task's start or goal in it.
    """
    return pipeline.open_scene(config)


@typed
def generate(config: Configuration) -> Demonstrations:
    """Return the demonstrations of ``demos=``, or, where it names none, those of the scripted person.

    Each of their ``items`` holds ``times`` (N,) [s], flange ``poses`` (N, 7) in UR Base, x y z [m] and a unit
    quaternion w first, and, where they are known, ``joints`` (N, 6) [rad], of an arm of n joints (N, n).

    Args:
        config: of the task, the arm and the person (``demo.count`` demonstrations by ``seed``), or of the files.

    Raises:
        BadInputError: a file is damaged, of another task or out of the arm's reach; the scene does not compile, or the
            arm cannot take the task's start or goal; or a person is to demonstrate, which only ``koopdqn demo`` lets
            them do.
        WorkFailedError: the arm cannot follow the scripted person, or refuses most of the paths drawn.
    """
    if config.derived is not None:
        return config.derived.training
    if config.inputs.demos:
        return pipeline.demonstrations_read(config, config.inputs.demos)
    pipeline.check_scripted(config)
    seed = config.inputs.seed
    clear = open_workcell(config).without_obstacles()
    return generate_demonstrations(clear.task, clear.reachability, config.demo, seed).demonstrations


@typed
def fit(config: Configuration, demonstrations: Demonstrations) -> Fitted:
    """Return the intent model K and its trust domain, fitted to demonstrations, with the report of ``fit.json``.

    Args:
        config: of the task, the intent, the trust domain and the reward that it is calibrated on.
        demonstrations: of that task; of a single one no error is measured.

    Raises:
        BadInputError: the demonstrations are not of the config's task, do not end at its goal or are shorter than a
            step.
    """
    return fit_intent(demonstrations, config.task, config.intent, config.trust, config.reward)


@typed
def intent_reward(config: Configuration, fitted: Fitted | StoredIntent) -> IntentReward:
    """Return the reward function (Eqs. 15, 16) of a fitted intent, as if the task had no obstacles.

    Its ``evaluate_actions`` takes poses (N, 7), x y z [m] and a unit quaternion w first, their steps (N,) and the
    starts (N, 7) of their episodes, and gives rewards (N, A) of all A actions: ten, or more where they are continuous.
    Where a path may pass itself starts change on the way: ``config.task.onward`` gives those that count.

    Args:
        config: of the task, the reward and the agent, whose actions are rewarded.
        fitted: the intent.

    Raises:
        BadInputError: the intent is of another task, or turns otherwise than it.
    """
    _check_intent(config, fitted)
    return IntentReward(config.task, fitted.model, fitted.trust, config.reward, continuous=config.agent.continuous)


@typed
def train(
    config: Configuration,
    demonstrations: Demonstrations,
    fitted: Fitted | StoredIntent,
    oracle: Oracle | None = None,
    on_check: "Callable[[Check], None]" = lambda check: None,
) -> Trained:
    """Learn the path (Algorithm 1).

    Args:
        config: of the task, the agent and the training.
        demonstrations: that the intent was fitted to.
        fitted: the intent.
        oracle: who answers where the intent is not trusted; None for the config's.
        on_check: called after every check on held-out starts.

    Raises:
        BadInputError: ``agent.device`` is not there, demonstrations or intent are of another task, or who answers
            cannot.
        PauseRequested: who answers wants to go on another time.
    """
    from koopdqn.app.commands.train import trainer_of
    from koopdqn.rl.settings import check_device

    check_device(config.agent)
    workcell = open_workcell(config)
    reward = _reward_around_obstacles(config, workcell, demonstrations, fitted)
    who = _answering(config, oracle, workcell, reward)
    trainer = trainer_of(config, workcell, reward, agent_steps(demonstrations, config.task), who)
    trainer.run(on_check)
    return Trained(trainer.best_policy(), trainer.learned, trainer.questions, trainer.step_limit, trainer.history)


@typed
def evaluate(
    config: Configuration, demonstrations: Demonstrations, fitted: Fitted | StoredIntent, trained: Trained
) -> Evaluation:
    """Return how a trained policy does from held-out starts, beside what comes without learning (``eval.json``).

    The units of the report's keys stand in docs/files.md. Each of the ``episodes`` holds the poses (T + 1, 7) and joint
    angles (T + 1, 6) [rad] of T steps and what became of it.

    Args:
        config: of the task, the arm, the reward and the evaluation (``eval.episodes`` starts by ``eval.seed``).
        demonstrations: that the intent was fitted to.
        fitted: the intent, for ``tube_fraction`` and the methods that learn nothing.
        trained: what :func:`train` returned.

    Raises:
        BadInputError: demonstrations, intent or policy are of another task, or the policy has other actions; the scene
            does not compile; hardly any start of the region can be taken; or obstacles leave no way.
    """
    from koopdqn.rl.policy import around

    taken = "continuous" if trained.policy.continuous else "table1"
    if taken != config.inputs.actions:
        raise BadInputError(f"actions: must be those of the policy, {taken}, found {config.inputs.actions}")
    if trained.policy.task.name != config.task.name:
        raise BadInputError(f"the policy must be of task {config.task.name}, found task {trained.policy.task.name}")
    workcell = open_workcell(config)
    reward = _reward_around_obstacles(config, workcell, demonstrations, fitted)
    return evaluate_policy(
        workcell,
        around(trained.policy, reward.model),
        reward,
        agent_steps(demonstrations, config.task),
        config.eval,
        trained.step_limit,
        held_out=pipeline.held_out_of(config),
        guard=config.guard,
    )


@typed
def environment_parts(
    config: Configuration,
    demonstrations: Demonstrations,
    fitted: Fitted | StoredIntent,
    oracle: Oracle | None = None,
    *,
    exploring_starts: bool = False,
) -> "EnvironmentParts":
    """Return what an environment for another learner consists of.

    With ``exploring_starts`` episodes begin as in training, most of them short (``agent.exploring_…``); without, all
    begin in the start region.

    Raises:
        BadInputError: demonstrations or intent are of another task, who answers cannot, or questions are to be put off,
            which nothing but koopdqn's own training does.
    """
    from koopdqn.envs.batch import EnvironmentParts
    from koopdqn.rl.starts import StartSampler
    from koopdqn.tasks.moved_goals import trained_in

    if config.oracle.ask != "at_once":
        raise BadInputError(f"oracle.ask: must be at_once in an environment, found {config.oracle.ask}")
    workcell = open_workcell(config)
    reward = _reward_around_obstacles(config, workcell, demonstrations, fitted)
    shown = agent_steps(demonstrations, config.task)
    limit = int(config.train.step_limit_factor * max(len(rows) for rows in shown))
    starts = None
    if exploring_starts:
        known = trained_in(workcell)
        starts = StartSampler(known, reward.model.start_frame, reward.model.placed(shown), limit, config.agent)
    return EnvironmentParts(
        workcell,
        reward,
        _answering(config, oracle, workcell, reward),
        limit,
        config.feedback,
        config.oracle,
        starts,
    )


@typed
def make_env(
    config: Configuration, demonstrations: Demonstrations, fitted: Fitted | StoredIntent, oracle: Oracle | None = None
) -> "KoopmanEnvironment":
    """Return the environment that training uses, as dm_env knows it, for another learner.

    Observations are float32 (5,) where orientation is held, otherwise (8,): position [m], there the rotation vector
    from the goal's orientation [rad], and the distances to the goal [m, rad]. An action is an index into Table 1 from
    0, or, with continuous actions, a twist of 3 or 6 numbers from −1 to 1.

    Args:
        config: of the task, the arm, the reward and the oracle; ``seed`` is of the starts.
        demonstrations: that the intent was fitted to; they set an episode's step limit too.
        fitted: the intent.
        oracle: who answers where the intent is not trusted; None for the config's.

    Raises:
        BadInputError: demonstrations or intent are of another task, the scene does not compile, obstacles leave no way,
            who answers cannot, or questions are to be put off, which nothing but koopdqn's own training does.
    """
    from koopdqn.envs.dm import KoopmanEnvironment

    return KoopmanEnvironment(environment_parts(config, demonstrations, fitted, oracle), config.inputs.seed)


def _reward_around_obstacles(
    config: Configuration, workcell: Workcell, demonstrations: Demonstrations, fitted: Fitted | StoredIntent
) -> IntentReward:
    """Return the reward function of a fitted intent, bent around obstacles of the task.

    Raises:
        BadInputError: demonstrations or intent are of another task, or obstacles leave no way.
    """
    check_shown(demonstrations, config.task)
    _check_intent(config, fitted)
    return pipeline.reward_of(config, workcell, fitted, agent_steps(demonstrations, config.task))


def _check_intent(config: Configuration, fitted: Fitted | StoredIntent) -> None:
    """Raise BadInputError if an intent leads elsewhere than to the task's goal, or turns otherwise."""
    goal, found = config.task.goal, fitted.model.goal
    if not np.allclose(goal, found, atol=1e-9):
        raise BadInputError(
            f"the intent must be of task {config.task.name}, which ends at {goal.round(4).tolist()}, found one that"
            f" ends at {found.round(4).tolist()}"
        )
    turns = config.task.turns_in_full
    if getattr(fitted.model.fitted, "in_full", turns) is not turns:
        raise BadInputError(
            f"the intent must turn as task {config.task.name} with its task.turning, {'' if turns else 'not '}in full,"
            " found the other"
        )


def _answering(config: Configuration, oracle: Oracle | None, workcell: Workcell, reward: IntentReward) -> Oracle:
    """Return who answers: the oracle given, or that of the config, which may see no scene.

    Raises:
        BadInputError: it cannot.
    """
    from koopdqn.rl.human_reward import answering

    if oracle is None:
        config.oracle.check()
        return answering(config.oracle.open(workcell, config.inputs.seed, Path()), config.oracle, reward.model)
    return oracle
