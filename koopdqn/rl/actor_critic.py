"""TD3 over labelled twists: twin critics, target policy smoothing and a delayed actor (Fujimoto et al. 2018).

All actions of a state that are labelled share its features, as those of the double DQN do (:mod:`koopdqn.rl.dqn`).
"""

from collections.abc import Callable
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from koopdqn.intent.reward import ActionEvaluation
from koopdqn.pose import Array
from koopdqn.rl.dqn import Adam, Networks, distinct
from koopdqn.rl.network import QNetwork, linear
from koopdqn.rl.replay_buffer import Batch
from koopdqn.rl.settings import ActorCriticSettings
from koopdqn.tasks.actions import FIRST_TWIST, in_balls

_MOTION: Final = 3
# Preferred to any margin, which is 1 at most.
_FIRST_CHOICE: Final = 2.0


def shortened(raw: Tensor) -> Tensor:
    """Return twists (N, 3 or 6) with motion and turn each shortened to length 1 where it is longer."""
    return torch.cat([part / part.norm(dim=1, keepdim=True).clamp(min=1.0) for part in _parts(raw)], dim=1)


def _parts(raw: Tensor) -> list[Tensor]:
    """Return the motions (N, 3) and, where there are any, the turns (N, 3)."""
    return [raw[:, first : first + _MOTION] for first in range(0, raw.shape[1], _MOTION)]


def smoothed_targets(rewards: Tensor, first: Tensor, second: Tensor, gamma: float) -> Tensor:
    """Return the targets (N,) of both critics where something follows: r + γ min(Q'₁(s', ã), Q'₂(s', ã)).

    ã is the target policy's action with clipped noise; rewards and values are (N,).
    """
    return rewards + gamma * torch.minimum(first, second)


class TwinCritics(nn.Module):
    """Two multilayer perceptrons Q(s, a) beside each other; features of a state are passed once for all its actions."""

    weight1: Tensor
    bias1: Tensor
    weight2: Tensor
    bias2: Tensor
    weight3: Tensor
    bias3: Tensor

    def __init__(self, features: int, twist: int, hidden: tuple[int, ...], rng: np.random.Generator) -> None:
        """Make critics of features (B, features) and twists (N, twist), every weight drawn from ``rng``."""
        super().__init__()
        first, second = hidden
        drawn = [
            [linear(n, m, rng) for n, m in ((features + twist, first), (first, second), (second, 1))] for _ in "12"
        ]
        for index, pair in enumerate(zip(*drawn, strict=True), start=1):
            self.register_parameter(
                f"weight{index}", nn.Parameter(torch.stack([each.weight.detach().t() for each in pair]))
            )
            self.register_parameter(
                f"bias{index}", nn.Parameter(torch.stack([each.bias.detach()[None] for each in pair]))
            )
        self._features = features

    def forward(self, features: Tensor, state_of: Tensor, twists: Tensor) -> Tensor:
        """Return the values (2, N) of twists (N, twist) in states ``state_of`` (N,), of features (B, features)."""
        weight, bias = self.weight1, self.bias1
        states = torch.matmul(features, weight[:, : self._features]) + bias
        hidden = (states[:, state_of] + torch.matmul(twists, weight[:, self._features :])).relu()
        hidden = torch.baddbmm(self.bias2, hidden, self.weight2).relu()
        return torch.baddbmm(self.bias3, hidden, self.weight3)[..., 0]


class ActorCritic(Networks):
    """Actor and critics, their targets and the optimisers; an actor's raw outputs are shortened to a twist."""

    settings: ActorCriticSettings

    def __init__(self, inputs: int, tolerances: Array, settings: ActorCriticSettings, rng: np.random.Generator) -> None:
        """Make the networks for observations of ``inputs`` values, with weights drawn from ``rng``.

        Critics see twists in the tolerances (3,) or (6,) of :func:`koopdqn.tasks.actions.tolerances`, and noise is told
        in them.
        """
        self.settings = settings
        twist = len(tolerances)
        self.online, self.target = (QNetwork(inputs, settings.network, rng, settings.device, twist) for _ in range(2))
        self.target.load_state_dict(self.online.state_dict())
        self._device = self.online.device
        features = inputs + settings.network.fourier_features
        self._critics, self._target_critics = (
            TwinCritics(features, twist, settings.critic_hidden, rng).to(self._device) for _ in range(2)
        )
        self._target_critics.load_state_dict(self._critics.state_dict())
        self.updates = 0
        self._tolerances = tolerances
        self._unit = self._tensor(tolerances.astype(np.float32))
        self._actor_adam = Adam(list(self.online.parameters()), settings.actor_rate)
        self._critic_adam = Adam(list(self._critics.parameters()), settings.learning_rate)
        self._seed = int(rng.integers(2**32))

    def propose(self, observe: Callable[[], NDArray[np.float32]], rng: np.random.Generator) -> Array:
        """Return the twists (N, S, 3 or 6) to attempt at observations: the actor's own, then ones around it."""
        own = in_balls(self.online.values(observe()).astype(np.float64))[:, None]
        near = own + self.settings.near_spread * self._tolerances * rng.normal(
            size=(len(own), self.settings.near, own.shape[2])
        )
        return in_balls(np.concatenate([own, near], axis=1))

    def ranking(self, observations: NDArray[np.float32], evaluation: ActionEvaluation) -> np.ndarray:
        """Return by what (N, A) a right action is chosen: the actor's own, else the nearest to the prediction."""
        ranking = evaluation.margin.copy()
        ranking[:, FIRST_TWIST] = _FIRST_CHOICE
        return ranking

    def update(self, batch: Batch) -> float:
        """Make one update of the critics and, when it is due, of actor and targets; return the critics' loss."""
        assert batch.twists is not None, "transitions of continuous actions"
        states, state_of = distinct(batch.observations)
        features = self.online.features(self._tensor(states))
        count = int(np.searchsorted(state_of, self.settings.critic_states))
        rows, twists = self._tensor(state_of[:count]), self._tensor(batch.twists[:count]) / self._unit
        values = self._critics(features[: int(state_of[count - 1]) + 1], rows, twists)
        loss = nn.functional.mse_loss(values, self._targets(batch, count).expand_as(values))
        self._critic_adam.descend(loss)
        self.updates += 1
        if self.updates % self.settings.actor_every == 0:
            self._update_actor(features, batch, state_of)
        if self.updates % self.settings.target_every == 0:
            for online, target in ((self.online, self.target), (self._critics, self._target_critics)):
                averaged, now = ([each.detach() for each in network.parameters()] for network in (target, online))
                torch._foreach_lerp_(averaged, now, self.settings.target_rate)
        return float(loss.detach())

    def _targets(self, batch: Batch, count: int) -> Tensor:
        """Return the targets (count,) of a batch's first transitions."""
        settings = self.settings
        stop = (batch.terminated if settings.bootstrap_undone else batch.terminated | batch.undone)[:count]
        follows = np.flatnonzero(~stop)
        with torch.no_grad():
            features = self.online.features(self._tensor(batch.next_observations[follows]))
            own = shortened(self.target.activations(features)[-1])
            # By the update's number, so that a run resumes exactly without further state.
            rng = np.random.default_rng([self._seed, self.updates])
            noise = rng.normal(scale=settings.smoothing, size=tuple(own.shape)).astype(np.float32)
            noise = noise.clip(-settings.smoothing_most, settings.smoothing_most)
            action = shortened(own + self._unit * self._tensor(noise))
            first, second = self._target_critics(features, self._each(features), action / self._unit)
            targets = self._tensor(batch.rewards[:count].copy())
            rows = self._tensor(follows)
            targets[rows] = smoothed_targets(targets[rows], first, second, settings.gamma)
        return targets

    def _update_actor(self, features: Tensor, batch: Batch, state_of: np.ndarray) -> None:
        """Move the actor up the first critic's gradient and, by ``imitation``, toward each state's best action."""
        raw = self.online.activations(features)[-1]
        action = shortened(raw)
        loss = -self._critics(features, self._each(features), action / self._unit)[0].mean()
        # Outside the balls the length has no gradient; it must not run away.
        over = torch.stack([part.norm(dim=1) for part in _parts(raw)])
        loss = loss + (over - 1.0).clamp(min=0.0).square().mean()
        if self.settings.imitation:
            best, known = best_actions(batch, state_of)
            wished = self._tensor(best)
            missed = (raw - wished).square().sum(dim=1) * self._tensor(known.astype(np.float32))
            loss = loss + self.settings.imitation * missed.mean()
        self._actor_adam.descend(loss)

    def _each(self, features: Tensor) -> Tensor:
        """Return the states (B,) of one action in each."""
        return torch.arange(len(features), device=self._device)

    def _parts(self) -> dict[str, nn.Module | Adam]:
        return {
            "online": self.online,
            "target": self.target,
            "critics": self._critics,
            "target_critics": self._target_critics,
            "adam": self._actor_adam,
            "critic_adam": self._critic_adam,
        }


def best_actions(batch: Batch, state_of: np.ndarray) -> tuple[NDArray[np.float32], np.ndarray]:
    """Return the right action (B, 3 or 6) of greatest reward in each state, and whether (B,) the state has a right one.

    Of a batch's transitions those of a state are adjacent; ``state_of`` (N,) numbers their states from 0.
    """
    assert batch.twists is not None, "transitions of continuous actions"
    order = np.lexsort((batch.rewards, state_of))
    last = np.append(np.flatnonzero(np.diff(state_of[order])), len(order) - 1)
    rows = order[last]
    return batch.twists[rows], batch.rewards[rows] >= 0
