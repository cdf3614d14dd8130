"""Learns from the demonstrations of a finished training alone, and measures what was learned as `koopdqn eval` would.

    python scripts/imitate.py method=cloning run=DIR out=DIR [eval.seed=4100]

The method is behavioural cloning, cloning with noise, HG-DAgger, SQIL, a DMP or a ProMP, with the training's own
network, seed, demonstrations, start frame and step limit; its intent model only says how much of the paths lies within
the trust domain. HG-DAgger asks as many questions as the training did. Or the method is DQN, PPO or SAC of
Stable-Baselines3 on the training's own environment, with its intent's reward and its oracle. ``out`` receives
``imitation.json`` (what learning took) and ``eval.json`` (without baselines and dynamics; of a movement primitive,
whose path is followed instead of chosen action by action, the keys of a method alone).
"""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from imitation.inferred import BestOf, Imitator
from imitation.primitives import PRIMITIVES, Primitive, learn

from koopdqn import console
from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.exit_status import guard
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.folder import require_new, require_writable
from koopdqn.app.hydra.overrides import prepare
from koopdqn.envs.batch import EnvironmentParts
from koopdqn.errors import BadInputError, unknown_name
from koopdqn.files import read_json, write_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.reward import IntentReward
from koopdqn.intent.storage import StoredIntent, read_intent
from koopdqn.paths import to_step
from koopdqn.pose import Array
from koopdqn.rl.settings import AgentSettings
from koopdqn.rl.starts import StartSampler
from koopdqn.run_folder import INTENT
from koopdqn.tasks.rollout import SUCCESS, Controller, follow, roll_out
from koopdqn.tasks.step import TURNS_PER_STEP
from koopdqn.tasks.workcell import Workcell

if TYPE_CHECKING:
    from imitation.peers import Peer

PEERS: Final = ("sb3-dqn", "sb3-ppo", "sb3-sac")
METHODS: Final = ("cloning", "cloning-noise", "hg-dagger", "sqil", *PRIMITIVES, *PEERS)
# The random stream of a training's own checks, so that the starts are the same.
_CHECK_STREAM: Final = 3


@dataclass(frozen=True)
class Trained:
    """A finished training: its config, set for evaluating it, its scene, intent, demonstrated poses and step limit."""

    config: Configuration
    workcell: Workcell
    intent: StoredIntent
    trajectories: list[Array]
    step_limit: int

    def check(self, policy: Controller) -> float:
        """Return what the training's checks measure: the share of held-out starts from which a policy succeeds."""
        cell, settings = self.workcell, self.config.train
        rng = np.random.default_rng([settings.check_seed, _CHECK_STREAM])
        starts, joints, _ = cell.reachability.draw_starts(cell.task, rng, settings.check_starts)
        episodes = roll_out(policy, cell.task, cell.reachability, starts, joints, self.step_limit)
        return sum(episode.outcome == SUCCESS for episode in episodes) / len(episodes)


def imitate(method: str, run: Path, folder: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Learn by a method from a training's demonstrations, measure it, and return the content of ``eval.json``.

    The folder exists.

    Raises:
        BadInputError: a file of the training is missing or damaged, or an override is none of evaluating.
    """
    import torch

    evaluating = [f"run={run}", "out=unused", *overrides, "eval.dynamics=false", "eval.baselines=false"]
    config = composed(prepare("eval", evaluating).overrides)
    configuration = Configuration.load(config)
    torch.set_num_threads(configuration.train.threads)
    demonstrations = pipeline.demonstrations_of(configuration, run)
    report = read_json(run / "train.json", "the training report")
    trained = Trained(
        configuration,
        pipeline.open_scene(configuration),
        read_intent(run / INTENT, configuration.task),
        agent_steps(demonstrations, configuration.task),
        int(report["step_limit"]),
    )
    began, took = monotonic(), {"updates": 0, "env_steps": 0, "oracle_queries": 0}
    measured: Callable[[], dict[str, Any]]
    if method in PRIMITIVES:
        measured = partial(_followed, learn(method, trained.trajectories), trained)
    elif method in PEERS:
        peer = _peer(method, trained)
        took |= {"env_steps": peer.env_steps, "oracle_queries": peer.questions}
        measured = partial(_evaluated, peer, trained, run)
    else:
        learned = _learned(method, trained, int(report["oracle_queries"]))
        took = {"updates": learned.updates, "env_steps": learned.env_steps, "oracle_queries": learned.questions}
        measured = partial(_evaluated, learned.policy, trained, run)
    about = {
        "settings": [f"method={method}", *overrides],
        "seed": configuration.inputs.seed,
        "made_from": {"demonstrations": demonstrations.digest()},
        "seconds": monotonic() - began,
        **took,
    }
    content = measured()
    write_json(folder / "imitation.json", about)
    # Last: it is the sign that all was made.
    write_json(folder / "eval.json", content)
    return content


def _learned(method: str, trained: Trained, questions: int) -> Imitator:
    from imitation.cloning import UPDATES, Cloning, Noise
    from imitation.hg_dagger import corrected
    from imitation.sqil import Sqil

    config, cell, frame = trained.config, trained.workcell, trained.intent.model.start_frame
    agent, seed, limit = config.agent, config.inputs.seed, trained.step_limit
    if not isinstance(agent, AgentSettings):
        raise BadInputError(f"actions: must be table1 for {method}, found continuous")
    if method == "sqil":
        sqil = Sqil(cell, trained.trajectories, agent, seed, limit, frame=frame)
        return sqil.run(check=trained.check, check_every=config.train.check_every)
    # As far as the default strews where its own episodes begin.
    near = Noise(agent.exploring_spread_m, agent.exploring_spread_rad)
    noise = near if method == "cloning-noise" else None
    cloning = Cloning(trained.trajectories, config.task, agent, seed, frame, noise)
    if method == "hg-dagger":
        return corrected(cloning, cell, seed, limit, questions, check=trained.check)
    best, learned = BestOf(trained.check), cloning.policy
    while cloning.updates < UPDATES:
        cloning.update(min(config.train.check_every, UPDATES - cloning.updates))
        learned = best.offer(cloning.policy)
    return Imitator(learned, cloning.updates)


def _peer(method: str, trained: Trained) -> "Peer":
    from imitation.peers import Peer

    config, cell, intent = trained.config, trained.workcell, trained.intent
    seed, frame = config.inputs.seed, intent.model.start_frame
    # Nearly all episodes short, along a demonstration: from the start region alone PPO forgets what it passed.
    agent = config.agent.model_copy(update={"exploring_starts": 0.95, "exploring_in_region": 0.2})
    starts = StartSampler(cell, frame, frame.each(trained.trajectories), trained.step_limit, agent)
    reward = IntentReward(config.task, intent.model, intent.trust, config.reward, continuous=method == "sb3-sac")
    oracle = config.oracle.open(cell, seed, Path())
    return Peer(
        method, EnvironmentParts(cell, reward, oracle, trained.step_limit, config.feedback, starts=starts), seed
    )


def _evaluated(policy: Controller, trained: Trained, run: Path) -> dict[str, Any]:
    from koopdqn.evaluation.evaluate import evaluate
    from koopdqn.evaluation.schema import EvaluationFile

    config, intent = trained.config, trained.intent
    reward = IntentReward(config.task, intent.model, intent.trust, config.reward)
    evaluation = evaluate(trained.workcell, policy, reward, trained.trajectories, config.eval, trained.step_limit)
    return EvaluationFile.model_validate({**evaluation.report, "run": str(run)}).model_dump(mode="json")


def _followed(primitive: Primitive, trained: Trained) -> dict[str, Any]:
    """Return what is measured of following a primitive's paths, at the agent's step, from the held-out starts."""
    from koopdqn.evaluation.baselines import straight_path
    from koopdqn.evaluation.evaluate import drawn_starts
    from koopdqn.evaluation.metrics import measure, reference_paths

    task, reachability, intent = trained.workcell.task, trained.workcell.reachability, trained.intent
    drawn = drawn_starts(trained.workcell, trained.config.eval)
    starts, joints = drawn.starts, drawn.joints
    paths = []
    for start in starts:
        path = primitive(start, task.goal)
        # A ProMP of few demonstrations cannot begin everywhere.
        paths.append(np.concatenate([straight_path(start, path[0], task)[:-1], path]))
    stepped = to_step(paths, task.step_m, TURNS_PER_STEP * task.rotation_tolerance_rad)
    episodes = follow(stepped, task, reachability, joints)
    references = reference_paths(task, starts, trained.step_limit)
    report = measure(episodes, references, task, intent.trust, intent.model.start_frame, reachability)
    return report.model_dump(mode="json")


def main(arguments: Sequence[str]) -> int:
    """Learn and measure what the arguments name."""

    def work() -> int:
        given = {name: value for name, _, value in (item.partition("=") for item in arguments)}
        method, run, out = (given.pop(name, "") for name in ("method", "run", "out"))
        if method not in METHODS:
            raise unknown_name("method", method, METHODS)
        if not out:
            raise BadInputError("out: must name a folder, found ''")
        require_new(Path(out))
        require_writable(Path(out))
        found = imitate(method, Path(run), Path(out), [f"{name}={value}" for name, value in given.items()])
        console.say(f"{method}: success {found['success_rate']:.0%}, see {out}")
        return 0

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
