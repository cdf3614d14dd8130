"""Speed of learning: an update beside its bare matrix products, and whole runs beside Stable-Baselines3's DQN."""

import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median

import numpy as np
import torch

from benchmarks.rows import NOT_INSTALLED, NOT_MEASURED, Row, compared, installed
from koopdqn.app.commands.configuration import Configuration
from koopdqn.app.hydra.compose import composed
from koopdqn.demonstrations.generate import generate
from koopdqn.evaluation.evaluate import evaluate
from koopdqn.intent.fit import agent_steps, fit
from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.dqn import Learner
from koopdqn.rl.replay_buffer import Batch
from koopdqn.tasks.rollout import Controller
from koopdqn.tasks.workcell import Workcell, open_workcell
from koopdqn.threads import in_halves

# Seconds that learning itself, and the whole process, may take.
_BARS = {"shelf": (6.0, 12.0), "knife": (9.0, 16.0)}
_LEAST_RATIO = 8.0
_SEEDS = range(5)


@dataclass(frozen=True)
class Prepared:
    """Everything that learning begins with: the same for us and for a peer.

    Attributes:
        config: the default config of a task.
        workcell: task, arm and scene.
        shown: demonstrated poses (N, 7) at the agent's step.
        reward: with the fitted intent and its trust domain.
    """

    config: Configuration
    workcell: Workcell
    shown: list[Array]
    reward: IntentReward

    def trainer(self) -> Trainer:
        """Return a trainer that has not begun."""
        config = self.config
        trajectories = self.reward.model.start_frame.each(self.shown)
        oracle = ScriptedOracle(config.task)
        agent, settings, seed = config.agent, config.train, config.inputs.seed
        return Trainer(self.workcell, self.reward, trajectories, oracle, agent, settings, seed, config.feedback)

    def measured(self, learn: Callable[["Prepared", int], "Learned"]) -> "Measured":
        """Let somebody learn with a step limit for every episode, and measure the policy on held-out starts."""
        limit = self.trainer().step_limit
        found = learn(self, limit)
        alone = self.config.eval.model_copy(update={"baselines": False, "dynamics": False})
        report = evaluate(self.workcell, found.policy, self.reward, self.shown, alone, limit).report
        deviation, success = float(report["path_deviation_mm"]["mean"]), float(report["success_rate"])
        return Measured(found.learned, found.seconds, found.steps, deviation, success)


@dataclass(frozen=True)
class Learned:
    """What came of learning.

    Attributes:
        policy: chooses actions as :data:`koopdqn.tasks.rollout.Controller` says.
        learned: whether the checks say that the task is learned.
        seconds: how long it took.
        steps: actions tried.
    """

    policy: Controller
    learned: bool
    seconds: float
    steps: int


@dataclass(frozen=True)
class Measured:
    """A learning and its policy.

    Attributes:
        learned: whether the checks say that the task is learned.
        seconds: how long it took.
        steps: actions tried.
        deviation_mm: of the policy's paths from the demonstrator's.
        success_rate: share of the held-out starts from which it succeeds.
    """

    learned: bool
    seconds: float
    steps: int
    deviation_mm: float
    success_rate: float


def prepare(*overrides: str) -> Prepared:
    """Return what a learning of generated demonstrations begins with, by the config with overrides."""
    config = Configuration.load(composed([*overrides, "command=train", "out=unused"]))
    workcell = open_workcell(config.task, config.robot)
    demonstrations = generate(config.task, workcell.reachability, config.demo, config.inputs.seed).demonstrations
    fitted = fit(demonstrations, config.task, config.intent, config.trust, config.reward)
    reward = IntentReward(config.task, fitted.model, fitted.trust, config.reward)
    return Prepared(config, workcell, agent_steps(demonstrations, config.task), reward)


def update_row(prepared: Prepared) -> Row:
    """Return the row of one update beside the matrix products in it, on a batch of a run's first experience."""
    agent, trainer = prepared.config.agent, prepared.trainer()
    while trainer.env_steps < agent.warm_up:
        trainer.collect()
    batch = trainer.replay.sample_states(np.random.default_rng(0), agent.batch)
    learner = trainer.learner
    assert isinstance(learner, Learner)
    mine, theirs = compared(lambda: learner.update(batch), products(learner, batch), repeats=15)
    assert theirs is not None
    note = f"{agent.batch} states; both in halves side by side, one thread each"
    return Row("an update of the network", mine * 1e3, "ms", "its bare matrix products", theirs * 1e3, None, 0.7, note)


def products(learner: Learner, batch: Batch) -> Callable[[], None]:
    """Return work that does the matrix products of an update with a batch, in halves as it does, and nothing else.

    Both networks' values of what follows, the online one's of the states, and the gradients of its weights and of what
    the layers but the first see.
    """
    states = 1 + int((batch.observations[1:] != batch.observations[:-1]).any(axis=1).sum())
    follows = int((~(batch.terminated | batch.undone)).sum())
    weights = [weight.detach() for weight, _ in learner.online.weights]
    after, before = ([torch.ones(count, weight.shape[1]) for weight in weights] for count in (follows, states))
    slopes = [torch.ones(states, len(weight)) for weight in weights]
    values_after, values = ([torch.empty(count, len(weight)) for weight in weights] for count in (follows, states))
    of_weights, of_inputs = (
        [torch.empty_like(weight) for weight in weights],
        [torch.empty_like(seen) for seen in before],
    )

    def valued(rows: slice) -> None:
        for layer, weight in enumerate(weights):
            for _ in range(2):
                torch.mm(after[layer][rows], weight.t(), out=values_after[layer][rows])

    def sloped(rows: slice) -> None:
        for layer, weight in enumerate(weights):
            torch.mm(before[layer][rows], weight.t(), out=values[layer][rows])
            if layer:
                torch.mm(slopes[layer][rows], weight, out=of_inputs[layer][rows])

    def weighed(layer: int, units: slice) -> None:
        torch.mm(slopes[layer][:, units].t(), before[layer], out=of_weights[layer][units])

    def work() -> None:
        in_halves(follows, valued)
        in_halves(states, sloped)
        for layer, weight in enumerate(weights):
            in_halves(len(weight), partial(weighed, layer))

    return work


def learning_rows(task: str, folder: Path, *, long: bool) -> list[Row]:
    """Return the rows of learning a task: its time and deviation beside a peer's, and that of the whole process.

    All are medians over :data:`_SEEDS`, with demonstrations of their own. With a peer that does not learn with one of
    them the others are left out: what that takes says nothing more.
    """
    itself, whole = _BARS[task]
    peer = "Stable-Baselines3 DQN"
    names = f"{task}: learning itself", f"{task}: deviation of the path", f"{task}: `koopdqn train`, all of it"
    if not long:
        return [
            Row(names[0], None, "s", peer, NOT_MEASURED, itself, _LEAST_RATIO),
            Row(names[1], None, "mm", peer, NOT_MEASURED, None, 1.0),
            Row(names[2], None, "s", "learning itself", NOT_MEASURED, whole),
        ]
    ours: list[Measured] = []
    theirs: list[Measured] = []
    processes = []
    for seed in _SEEDS:
        prepared = prepare(f"task={task}", f"seed={seed}")
        ours.append(prepared.measured(_own))
        # In turn with ours, so that a busy machine slows both alike.
        if installed("stable_baselines3") and installed("gymnasium") and all(each.learned for each in theirs):
            from benchmarks.peer_dqn import learn

            theirs.append(prepared.measured(learn))
        made = folder / f"{task}-{seed}"
        processes.append(_process_seconds(["train", f"task={task}", f"seed={seed}", f"out={made}"]))
    seconds, deviation = (median(getattr(each, name) for each in ours) for name in ("seconds", "deviation_mm"))
    their_seconds: float | str = NOT_INSTALLED
    their_deviation: float | str = NOT_INSTALLED
    if theirs:
        their_deviation = median(each.deviation_mm for each in theirs)
        failed = [each.seconds for each in theirs if not each.learned]
        their_seconds = f"not learned in {failed[0]:.0f} s" if failed else median(each.seconds for each in theirs)
    return [
        Row(names[0], seconds, "s", peer, their_seconds, itself, _LEAST_RATIO, _told(ours, theirs)),
        Row(names[1], deviation, "mm", peer, their_deviation, None, 1.0, "mean, points matched by arc length"),
        Row(
            names[2],
            median(processes),
            "s",
            "learning itself",
            seconds,
            whole,
            note=f"{_range(processes)} s; start-up, demonstrations and fit too",
        ),
    ]


def _own(prepared: Prepared, step_limit: int) -> Learned:
    began = time.perf_counter()
    trainer = prepared.trainer()
    trainer.run()
    seconds = time.perf_counter() - began
    assert trainer.step_limit == step_limit
    return Learned(trainer.best_policy(), trainer.learned, seconds, trainer.env_steps)


def _told(ours: Sequence[Measured], theirs: Sequence[Measured]) -> str:
    """Return what the row of learning tells beside the medians."""
    learned = sum(each.learned for each in ours)
    parts = [
        f"{learned} of {len(ours)} learned, in {_range([each.seconds for each in ours])} s;"
        f" {min(each.success_rate for each in ours):.0%} of held-out starts at least"
    ]
    if theirs:
        parts.append(
            f"theirs {sum(each.learned for each in theirs)} of {len(theirs)},"
            f" {min(each.success_rate for each in theirs):.0%} at least,"
            f" after {median(each.steps for each in theirs):,.0f} actions"
        )
    return "; ".join(parts)


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def _process_seconds(arguments: Sequence[str]) -> float:
    began = time.perf_counter()
    subprocess.run([str(Path(sys.executable).with_name("koopdqn")), *arguments], check=True, capture_output=True)
    return time.perf_counter() - began
