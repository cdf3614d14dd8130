"""The parts of the DQN that `make parts` measures: the default, and the default with one part changed.

What the default does without lives here, not in the package: a dueling network, prioritised replay, and the like.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from koopdqn.dqn.learner import Learner
from koopdqn.dqn.network import QNetwork, linear
from koopdqn.dqn.observation import observe, size
from koopdqn.dqn.replay import ReplayBuffer, Transitions
from koopdqn.dqn.settings import NetworkSettings
from koopdqn.environment.reward import NO_ANSWER
from koopdqn.pose import Array
from koopdqn.training.experience import Tries
from koopdqn.training.trainer import Trainer

_PRIORITY_EXPONENT: Final = 0.6
_LEAST_PRIORITY: Final = 1e-3
_ANSWERS_WEIGHT: Final = 10.0


class DuelingNetwork(QNetwork):
    """Q = V + A − mean A, with a value of its own (Wang et al. 2016)."""

    def __init__(self, inputs: int, settings: NetworkSettings, rng: np.random.Generator) -> None:
        """Make a network as :class:`QNetwork` does, whose last layer gives the advantages."""
        super().__init__(inputs, settings, rng)
        self.value = linear(settings.hidden[-1], 1, rng)

    def of_features(self, features: Tensor) -> Tensor:
        """Return the values Q (N, 10) of features (N, inputs + features)."""
        hidden = self.layers[:-1](features)
        advantages = self.layers[-1](hidden)
        return cast(Tensor, self.value(hidden) + advantages - advantages.mean(dim=1, keepdim=True))


class PrioritisedReplay(ReplayBuffer):
    """States drawn in proportion to a power of their last error (Schaul et al. 2016, without importance weights)."""

    def __init__(self, capacity: int, inputs: int) -> None:
        """Make an empty buffer; what was never drawn has the largest priority so far."""
        super().__init__(capacity, inputs)
        self.priorities = np.ones(capacity)
        self.rows = np.zeros(0, dtype=np.int64)

    def add(self, transitions: Transitions) -> None:
        """Add transitions, of the largest priority."""
        index = (self.added + np.arange(len(transitions.actions))) % self.capacity
        self.priorities[index] = self.priorities[: max(1, len(self))].max()
        super().add(transitions)

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return rows (count,) drawn by priority."""
        summed = np.cumsum(self.priorities[: len(self)])
        self.rows = np.searchsorted(summed, rng.random(count) * summed[-1])
        return self.rows

    def remove(self, mask: np.ndarray) -> None:
        """Remove transitions; all others are as new then."""
        super().remove(mask)
        self.priorities[:] = 1.0


class PrioritisedLearner(Learner):
    """Tells a :class:`PrioritisedReplay` how wrong it was about what was drawn."""

    replay: PrioritisedReplay

    def update(self, batch: Transitions) -> float:
        """Make one update, and measure the errors it started from."""
        rows = self.replay.rows
        drawn = self.replay.at(rows)
        values = self.online.values(drawn.observations)[np.arange(len(rows)), drawn.actions]
        following = self.target.values(drawn.following).max(axis=1)
        targets = drawn.rewards + self.settings.gamma * np.where(drawn.terminated | drawn.undone, 0.0, following)
        self.replay.priorities[rows] = (np.abs(values - targets) + _LEAST_PRIORITY) ** _PRIORITY_EXPONENT
        return super().update(batch)


class AnswersOftenReplay(ReplayBuffer):
    """States whose rewards rest on an answer are drawn ten times as often."""

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return rows (count,), answered ones more often."""
        answered: NDArray[np.int64] = self._arrays["answers"][: len(self)]
        summed = np.cumsum(np.where(answered == NO_ANSWER, 1.0, _ANSWERS_WEIGHT))
        return np.asarray(np.searchsorted(summed, rng.random(count) * summed[-1]))


def _nothing(trainer: Trainer, trajectories: list[Array]) -> None:
    pass


def _dueling(trainer: Trainer, trajectories: list[Array]) -> None:
    task = trainer.workcell.task
    trainer.learner = Learner(size(task), trainer.agent, np.random.default_rng(0), DuelingNetwork)
    trainer.learner.normalise_to(observe(np.concatenate(trajectories), task))


def _prioritised(trainer: Trainer, trajectories: list[Array]) -> None:
    task = trainer.workcell.task
    learner = PrioritisedLearner(size(task), trainer.agent, np.random.default_rng(0))
    learner.normalise_to(observe(np.concatenate(trajectories), task))
    learner.replay = PrioritisedReplay(trainer.agent.replay, size(task))
    trainer.learner, trainer.replay = learner, learner.replay


def _answers_often(trainer: Trainer, trajectories: list[Array]) -> None:
    trainer.replay = AnswersOftenReplay(trainer.agent.replay, size(trainer.workcell.task))


def _prefilled(trainer: Trainer, trajectories: list[Array]) -> None:
    task = trainer.workcell.task
    for poses in trajectories:
        states = poses[~task.reached(poses)]
        steps = np.arange(len(states))
        judgement = trainer.feedback.judge(states, steps)
        rows, actions = np.nonzero(judgement.known)
        # The states are told as from the nominal start already.
        starts = np.tile(task.nominal_start, (len(rows), 1))
        tries = Tries(judgement, rows, actions, observe(states, task)[rows], states[rows], starts, steps[rows])
        trainer.replay.add(tries.transitions(task, step_back=trainer.agent.step_back))


@dataclass(frozen=True)
class Part:
    """The default config with one part of the DQN changed.

    Attributes:
        name: of the part's results.
        about: in a few words what is changed.
        overrides: what that changes of the config.
        change: what else is done to a new trainer, given the demonstrations (N, 7) at the agent's step.
    """

    name: str
    about: str
    overrides: tuple[str, ...] = ()
    change: Callable[[Trainer, list[Array]], None] = _nothing


DEFAULT: Final = "default"
PARTS: Final = (
    Part(DEFAULT, "the default"),
    Part("gamma-0", "γ = 0", ("agent.gamma=0.0",)),
    Part("gamma-0.25", "γ = 0.25", ("agent.gamma=0.25",)),
    Part("gamma-0.8", "γ = 0.8", ("agent.gamma=0.8",)),
    Part("plain-inputs", "no Fourier features", ("agent.network.fourier_features=0",)),
    Part("fine-features", "Fourier features of 2 cm instead of 5", ("agent.network.length_scale_m=0.02",)),
    Part("transitions", "512 single transitions in an update", ("agent.drawn=transitions", "agent.batch=512")),
    Part("online", "the online network as the policy", ("agent.policy_network=online",)),
    Part("single", "plain max (Eq. 3) instead of double DQN", ("agent.double=false",)),
    Part("dueling", "dueling network", change=_dueling),
    Part("prioritised", "prioritised replay", change=_prioritised),
    Part("prefilled", "the demonstrations in the replay buffer first", change=_prefilled),
    Part("answers-often", "what rests on answers drawn ten times as often", change=_answers_often),
)
