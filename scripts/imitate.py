"""Learns from the demonstrations of a finished training alone, and measures what was learned as `koopdqn eval` would.

    python scripts/imitate.py cloning run=DIR out=DIR

The method is behavioural cloning or SQIL, with the training's own network, seed, demonstrations and step limit; its
intent model only says how much of the paths lies within the trust domain. ``out`` receives ``imitation.json`` (what
learning took) and ``eval.json`` (without baselines and dynamics).
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np

from koopdqn.commands import stages
from koopdqn.commands.configuration import Configuration
from koopdqn.config.compose import composed
from koopdqn.config.overrides import prepare
from koopdqn.exit_status import guard
from koopdqn.files import read_json, write_json
from koopdqn.intent.fitting import agent_steps
from koopdqn.intent.storage import read_intent
from koopdqn.rollout import SUCCESS, Controller, roll_out
from koopdqn.workcell import Workcell

METHODS: Final = ("cloning", "sqil")
IMITATION: Final = "imitation.json"
# The random stream of a training's own checks, so that the starts are the same.
_CHECK_STREAM: Final = 3


def configuration_of(run: Path) -> Configuration:
    """Return the config with which a training's run folder was made, set for evaluating it.

    Raises:
        BadInputError: the folder holds no training.
    """
    prepared = prepare("eval", [f"run={run}", "out=unused", "eval.dynamics=false", "eval.baselines=false"])
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


def imitate(method: str, run: Path, folder: Path) -> dict[str, Any]:
    """Learn by a method from a training's demonstrations, measure it, and return the content of ``eval.json``.

    Raises:
        BadInputError: a file of the training is missing or damaged.
    """
    import torch

    from koopdqn.environment.reward import IntentReward
    from koopdqn.evaluation.evaluate import evaluate
    from koopdqn.evaluation.schema import EvaluationFile
    from koopdqn.imitation.cloning import clone
    from koopdqn.imitation.sqil import Sqil

    config = configuration_of(run)
    torch.set_num_threads(config.train.threads)
    workcell = stages.open_scene(config)
    demonstrations = stages.demonstrations_of(config, run)
    intent = read_intent(run / stages.INTENT, config.task)
    trajectories = agent_steps(demonstrations, config.task)
    step_limit = int(read_json(run / "train.json", "the training report")["step_limit"])
    seed, began = config.inputs.seed, monotonic()
    if method == "cloning":
        learned = clone(trajectories, config.task, config.agent, seed)
    else:
        sqil = Sqil(workcell, trajectories, config.agent, seed, step_limit)
        learned = sqil.run(check=checked_by(config, workcell, step_limit), check_every=config.train.check_every)
    seconds = monotonic() - began
    reward = IntentReward(config.task, intent.model, intent.trust, config.reward)
    evaluation = evaluate(workcell, learned.policy, reward, trajectories, config.eval, step_limit).report
    content: dict[str, Any] = EvaluationFile.model_validate({**evaluation, "run": str(run)}).model_dump(mode="json")
    folder.mkdir(parents=True, exist_ok=True)
    about = {
        "method": method,
        "seed": seed,
        "seconds": seconds,
        "updates": learned.updates,
        "env_steps": learned.env_steps,
        "made_from": {"demonstrations": demonstrations.digest()},
    }
    write_json(folder / IMITATION, about)
    # Last: it is the sign that all was made.
    write_json(folder / "eval.json", content)
    return content


def main(arguments: Sequence[str] | None = None) -> int:
    """Learn and measure what the arguments name."""
    parser = argparse.ArgumentParser(description="Learn from a finished training's demonstrations alone.")
    parser.add_argument("method", choices=METHODS)
    parser.add_argument("run", type=lambda text: Path(text.removeprefix("run=")), help="run=DIR, the training")
    parser.add_argument("out", type=lambda text: Path(text.removeprefix("out=")), help="out=DIR, for the results")
    given = parser.parse_args(arguments)

    def work() -> int:
        found = imitate(given.method, given.run, given.out)
        print(f"{given.method}: success {found['success_rate']:.0%}, see {given.out}")
        return 0

    return guard(work, debug=False)


if __name__ == "__main__":
    sys.exit(main())
