"""Behavioural cloning from observation: the action that a demonstrated step stands for, as a classification."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import nn

from imitation.imitator import Imitator
from imitation.inferred import demonstrated_steps
from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.rl.network import QNetwork, observe, size
from koopdqn.rl.policy import Policy
from koopdqn.rl.settings import AgentSettings
from koopdqn.tasks.actions import nearest_actions
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import Task

# Sets its random numbers apart from those of demonstrations (1), training (2), checks (3) and evaluation (4).
_STREAM: Final = 6
# Share of a batch that an expert's few labels add to it: among a thousand demonstrated steps they would hardly be seen.
_LABELLED: Final = 0.05


@dataclass(frozen=True)
class Noise:
    """How far demonstrated states are strewn before they are labelled anew.

    Attributes:
        position_m: standard deviation along each axis at right angles to the motion [m].
        rotation_rad: of a turn about each axis, where orientation is learned [rad].
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
        policy: the argmax of the network as it is now.
        updates: made so far.
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
        """Begin.

        Args:
            trajectories: demonstrated poses (N, 7) at the agent's step.
            task: gives actions and observations.
            agent: its network, learning rate and batch.
            seed: fixes everything.
            frame: in which poses are observed.
            noise: by which states are strewn; None for none.
        """
        weights, self._batches = (np.random.default_rng([seed, _STREAM, part]) for part in range(2))
        self._task, self._frame, self._noise, self._batch = task, frame, noise, agent.batch
        self._before, self._after, self._starts, _ = demonstrated_steps(trajectories, task)
        self._observations = observe(frame.placed(self._before, self._starts), task)
        self._actions = nearest_actions(self._before, self._after, task)
        self._labelled: list[tuple[np.ndarray, int]] = []
        network = QNetwork(size(task), agent.network, weights)
        network.normalise_to(self._observations)
        self._optimizer = torch.optim.Adam(network.parameters(), lr=agent.learning_rate)
        self.policy = Policy(network, task, frame)
        self.updates = 0

    def label(self, poses: Array, starts: Array, action: int) -> None:
        """Learn from now on that an action is right from a pose (1, 7) of an episode that began at a start (1, 7)."""
        self._labelled.append((observe(self._frame.placed(poses, starts), self._task)[0], action))

    @property
    def labels(self) -> tuple[np.ndarray, np.ndarray]:
        """What was labelled: observations (L, 5) or (L, 8) and actions (L,), at least one."""
        observations, actions = zip(*self._labelled, strict=True)
        return np.array(observations), np.array(actions)

    def update(self, count: int) -> None:
        """Make a number of updates."""
        network = self.policy.network
        for _ in range(count):
            observations, actions = self._drawn()
            loss = nn.functional.cross_entropy(network(torch.from_numpy(observations)), torch.from_numpy(actions))
            self._optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
            self._optimizer.step()
        self.updates += count

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        rows = self._batches.integers(len(self._actions), size=self._batch)
        observations, actions = self._observations[rows], self._actions[rows]
        if self._noise:
            strewn = self._strewn(rows, self._noise)
            observations = observe(self._frame.placed(strewn, self._starts[rows]), self._task)
            actions = nearest_actions(strewn, self._after[rows], self._task)
        if self._labelled:
            few = self._batches.integers(len(self._labelled), size=round(_LABELLED * self._batch))
            said, right = self.labels
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
        turn = pose.from_rotation_vector(self._batches.normal(scale=noise.rotation_rad, size=motion.shape))
        return pose.make(position, pose.multiply(poses[:, pose.QUATERNION], turn))


def clone(
    trajectories: list[Array],
    task: Task,
    agent: AgentSettings,
    seed: int,
    updates: int = 2000,
    frame: StartFrame = STILL,
    noise: Noise | None = None,
) -> Imitator:
    """Return what :class:`Cloning` learns in a number of updates; it takes the same arguments."""
    cloning = Cloning(trajectories, task, agent, seed, frame, noise)
    cloning.update(updates)
    return Imitator(cloning.policy, updates, env_steps=0)
