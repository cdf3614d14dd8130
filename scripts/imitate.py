"""Learns from the demonstrations of a finished training alone, and measures what was learned as `koopdqn eval` would.

    python scripts/imitate.py cloning run=DIR out=DIR [eval.seed=4100]

The method is behavioural cloning, cloning with noise, HG-DAgger, SQIL, a DMP or a ProMP, with the training's own
network, seed, demonstrations, start frame and step limit; its intent model only says how much of the paths lies within
the trust domain. HG-DAgger asks as many questions as the training did. ``out`` receives ``imitation.json`` (what
learning took) and ``eval.json`` (without baselines and dynamics; of a movement primitive, whose path is followed
instead of chosen action by action, the keys of a method alone).
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np
from imitation.imitator import Imitator
from primitives import PRIMITIVES, Primitive, learn

from koopdqn.app.commands import pipeline
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.exit_status import guard
from koopdqn.app.hydra.compose import composed
from koopdqn.app.hydra.overrides import prepare
from koopdqn.files import read_json, write_json
from koopdqn.intent.fit import agent_steps
from koopdqn.intent.storage import StoredIntent, read_intent
from koopdqn.paths import to_step
from koopdqn.pose import Array
from koopdqn.tasks.rollout import SUCCESS, Controller, follow, roll_out
from koopdqn.tasks.task import TURNS_PER_STEP
from koopdqn.tasks.workcell import Workcell

METHODS: Final = ("cloning", "cloning-noise", "hg-dagger", "sqil", *PRIMITIVES)
IMITATION: Final = "imitation.json"
# The random stream of a training's own checks, so that the starts are the same.
_CHECK_STREAM: Final = 3


def configuration_of(run: Path, overrides: Sequence[str] = ()) -> Configuration:
    """Return the config with which a training's run folder was made, set for evaluating it.

    Raises:
        BadInputError: the folder holds no training, or an override is none of evaluating.
    """
    prepared = prepare("eval", [f"run={run}", "out=unused", "eval.dynamics=false", "eval.baselines=false", *overrides])
    config = composed(prepared.overrides)
    return Configuration.load({key: config[key] for key in config if key != "hydra"})


def checked_by(config: Configuration, workcell: Workcell, step_limit: int) -> Callable[[Controller], float]:
    """Return what a training's checks measure: the share of held-out starts from which a policy succeeds."""
    rng = np.random.default_rng([config.train.check_seed, _CHECK_STREAM])
    starts, joints, _ = workcell.reachability.draw_starts(config.task, rng, config.train.check_starts)

    def check(policy: Controller) -> float:
        episodes = roll_out(policy, config.task, workcell.reachability, starts, joints, step_limit)
        return sum(episode.outcome == SUCCESS for episode in episodes) / len(episodes)

    return check


def imitate(method: str, run: Path, folder: Path, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Learn by a method from a training's demonstrations, measure it, and return the content of ``eval.json``.

    Raises:
        BadInputError: a file of the training is missing or damaged, or an override is none of evaluating.
    """
    import torch

    config = configuration_of(run, overrides)
    torch.set_num_threads(config.train.threads)
    workcell = pipeline.open_scene(config)
    demonstrations = pipeline.demonstrations_of(config, run)
    intent = read_intent(run / pipeline.INTENT, config.task)
    trajectories = agent_steps(demonstrations, config.task)
    trained = read_json(run / "train.json", "the training report")
    step_limit, questions = int(trained["step_limit"]), int(trained["oracle_queries"])
    about = {"method": method, "seed": config.inputs.seed, "made_from": {"demonstrations": demonstrations.digest()}}
    began = monotonic()
    content: dict[str, Any]
    if method in PRIMITIVES:
        primitive = learn(method, trajectories)
        about |= {"seconds": monotonic() - began, "updates": 0, "env_steps": 0, "oracle_queries": 0}
        content = _followed(primitive, workcell, config, intent, step_limit)
    else:
        learned = _learned(method, workcell, config, intent, trajectories, step_limit, questions)
        about |= {"seconds": monotonic() - began, "updates": learned.updates, "env_steps": learned.env_steps}
        about["oracle_queries"] = learned.questions
        content = _evaluated(learned, workcell, config, intent, trajectories, step_limit, run)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / IMITATION, about)
    # Last: it is the sign that all was made.
    write_json(folder / "eval.json", content)
    return content


def _learned(
    method: str,
    workcell: Workcell,
    config: Configuration,
    intent: StoredIntent,
    trajectories: list[Array],
    step_limit: int,
    questions: int,
) -> Imitator:
    from imitation.cloning import Noise, clone
    from imitation.hg_dagger import HgDagger
    from imitation.sqil import Sqil

    seed, frame = config.inputs.seed, intent.model.start_frame
    if method == "hg-dagger":
        return HgDagger(workcell, trajectories, config.agent, seed, step_limit, frame).run(questions)
    if method == "sqil":
        sqil = Sqil(workcell, trajectories, config.agent, seed, step_limit, frame=frame)
        return sqil.run(check=checked_by(config, workcell, step_limit), check_every=config.train.check_every)
    # As far as the default strews where its own episodes begin.
    near = Noise(config.agent.exploring_spread_m, config.agent.exploring_spread_rad)
    noise = near if method == "cloning-noise" else None
    return clone(trajectories, config.task, config.agent, seed, frame=frame, noise=noise)


def _evaluated(
    learned: Imitator,
    workcell: Workcell,
    config: Configuration,
    intent: StoredIntent,
    trajectories: list[Array],
    step_limit: int,
    run: Path,
) -> dict[str, Any]:
    from koopdqn.evaluation.evaluate import evaluate
    from koopdqn.evaluation.schema import EvaluationFile
    from koopdqn.intent.reward import IntentReward

    reward = IntentReward(config.task, intent.model, intent.trust, config.reward)
    evaluation = evaluate(workcell, learned.policy, reward, trajectories, config.eval, step_limit).report
    return EvaluationFile.model_validate({**evaluation, "run": str(run)}).model_dump(mode="json")


def _followed(
    primitive: Primitive, workcell: Workcell, config: Configuration, intent: StoredIntent, step_limit: int
) -> dict[str, Any]:
    """Return what is measured of following a primitive's paths, at the agent's step, from the held-out starts."""
    from koopdqn.evaluation.baselines import straight_path
    from koopdqn.evaluation.evaluate import drawn_starts
    from koopdqn.evaluation.metrics import measure, reference_paths

    task, reachability = workcell.task, workcell.reachability
    starts, joints, _ = drawn_starts(workcell, config.eval)
    paths = []
    for start in starts:
        path = primitive(start, task.goal)
        # A ProMP of few demonstrations cannot begin everywhere.
        paths.append(np.concatenate([straight_path(start, path[0], task)[:-1], path]))
    stepped = to_step(paths, task.step_m, TURNS_PER_STEP * task.rotation_tolerance_rad)
    episodes = follow(stepped, task, reachability, joints)
    references = reference_paths(task, starts, step_limit)
    report = measure(episodes, references, task, intent.trust, intent.model.start_frame, reachability)
    return report.model_dump(mode="json")


def main(arguments: Sequence[str] | None = None) -> int:
    """Learn and measure what the arguments name."""
    parser = argparse.ArgumentParser(description="Learn from a finished training's demonstrations alone.")
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("run", type=lambda text: Path(text.removeprefix("run=")), help="run=DIR, the training")
    parser.add_argument("out", type=lambda text: Path(text.removeprefix("out=")), help="out=DIR, for the results")
    parser.add_argument("overrides", nargs="*", help="what the evaluation changes, like eval.seed=4100")
    given = parser.parse_args(arguments)

    def work() -> int:
        found = imitate(given.method, given.run, given.out, given.overrides)
        print(f"{given.method}: success {found['success_rate']:.0%}, see {given.out}")
        return 0

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
