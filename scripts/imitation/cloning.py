"""Behavioural cloning from observation: the action that a demonstrated step stands for, as a classification."""

from copy import deepcopy
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import nn

from imitation.inferred import demonstrated_steps, labels
from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.rl.network import QNetwork, observe, size
from koopdqn.rl.policy import Policy
from koopdqn.rl.settings import AgentSettings
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import Task

UPDATES: Final = 2000
"""How many suffice."""
# Sets its random numbers apart from those of demonstrations (1), training (2), checks (3) and evaluation (4).
_STREAM: Final = 6
# Share of a batch that an expert's few labels add to it: among a thousand demonstrated steps they would hardly be seen.
_LABELLED: Final = 0.05


@dataclass(frozen=True)
class Noise:
    """How far demonstrated states are strewn before they are labelled anew.

    Attributes:
        position_m: standard deviation along each axis at right angles to the motion [m].
        rotation_rad: of a turn toward the goal's orientation or away from it, where orientation is learned [rad].
    """

    position_m: float
    rotation_rad: float


class Cloning:
    """The agent's network, trained to take the demonstrations' own actions where they were taken.

    Actions are inferred from poses: the nearest of the ten to the next demonstrated pose (cf. Torabi et al. 2018, who
    learn the inverse dynamics that are known here). The ten values are logits, and the loss is their cross-entropy.
    With noise every batch strews its states anew and labels each with the action that leads back nearest to the next
    demonstrated pose (cf. Ke et al. 2021; DART, Laskey et al. 2017, disturbs the person who demonstrates instead).

    Attributes:
        policy: the argmax of the network's average over its last updates, as the default's is.
        updates: made so far.
        labels: actions that an expert said are right, and the observations in which they are.
    """

    def __init__(
        self,
        trajectories: list[Array],
        task: Task,
        agent: AgentSettings,
        seed: int,
        frame: StartFrame = STILL,
        noise: Noise | None = None,
    ) -> None:
        """Begin from demonstrated poses (N, 7) at the agent's step, observed in a frame; the seed fixes everything."""
        weights, self._batches = (np.random.default_rng([seed, _STREAM, part]) for part in range(2))
        self._task, self._frame, self._noise, self._batch = task, frame, noise, agent.batch
        self._before, self._after, self._starts, _ = demonstrated_steps(trajectories, task)
        self._observations = self._observe(self._before, self._starts)
        self._actions = labels(self._before, self._after, task)
        network = QNetwork(size(task), agent.network, weights)
        network.normalise_to(self._observations)
        self._network, self._rate = network, agent.target_rate
        self._optimizer = torch.optim.Adam(network.parameters(), lr=agent.learning_rate)
        self.policy = Policy(deepcopy(network), task, frame)
        self.updates = 0
        self.labels: list[tuple[np.ndarray, int]] = []

    def label(self, poses: Array, starts: Array, action: int) -> None:
        """Learn from now on that an action is right from a pose (1, 7) of an episode that began at a start (1, 7)."""
        self.labels.append((self._observe(poses, starts)[0], action))

    def update(self, count: int) -> None:
        """Make a number of updates."""
        for _ in range(count):
            observations, actions = map(torch.from_numpy, self._drawn())
            loss = nn.functional.cross_entropy(self._network(observations), actions)
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
            self._optimizer.step()
            with torch.no_grad():
                averaged: list[torch.Tensor] = list(self.policy.network.parameters())
                torch._foreach_lerp_(averaged, list(self._network.parameters()), self._rate)
        self.updates += count

    def _observe(self, poses: Array, starts: Array) -> np.ndarray:
        return observe(self._frame.to_frame(poses, starts), self._task)

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        rows = self._batches.integers(len(self._actions), size=self._batch)
        observations, actions = self._observations[rows], self._actions[rows]
        if self._noise:
            strewn = self._strewn(rows, self._noise)
            observations = self._observe(strewn, self._starts[rows])
            actions = labels(strewn, self._after[rows], self._task)
        if self.labels:
            few = self._batches.integers(len(self.labels), size=round(_LABELLED * self._batch))
            said, right = map(np.array, zip(*self.labels, strict=True))
            observations, actions = np.concatenate([observations, said[few]]), np.concatenate([actions, right[few]])
        return observations, actions

    def _strewn(self, rows: np.ndarray, noise: Noise) -> Array:
        """Return the demonstrated states of rows (B,), strewn: poses (B, 7)."""
        poses = self._before[rows]
        motion = self._after[rows, pose.POSITION] - poses[:, pose.POSITION]
        motion /= np.maximum(np.linalg.norm(motion, axis=1, keepdims=True), 1e-12)
        offset = self._batches.normal(scale=noise.position_m, size=motion.shape)
        # Of states strewn ahead on the path the next demonstrated pose lies behind.
        offset -= (offset * motion).sum(axis=1, keepdims=True) * motion
        position = poses[:, pose.POSITION] + offset
        if self._task.orientation == "held":
            return pose.make(position, poses[:, pose.QUATERNION])
        # As the default strews: ahead in its turn, or behind; Table 1 turns no other way.
        turn = self._batches.normal(scale=noise.rotation_rad, size=len(poses))
        goal = np.broadcast_to(self._task.goal[pose.QUATERNION], (len(poses), 4))
        return pose.make(position, pose.turned_toward(poses[:, pose.QUATERNION], goal, turn))
