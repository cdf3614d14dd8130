"""The replay buffer: experience stored and drawn at random (§3.1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopdqn.tasks.actions import COUNT


@dataclass(frozen=True)
class Transitions:
    """A batch of transitions.

    Attributes:
        observations: (N, inputs).
        actions: (N,) indices in Table 1.
        rewards: (N,).
        next_observations: (N, inputs) observations after the actions.
        terminated: (N,) whether the goal was reached.
        truncated: (N,) whether the episode was cut there; the value beyond still counts.
        undone: (N,) whether the action was wrong and stepped back from.
        poses: (N, 7) before the actions.
        starts: (N, 7) where their episodes began.
        steps: (N,) steps of the episode before them.
        sources: (N,) where the rewards came from (:data:`koopdqn.intent.reward.SOURCES`).
        answers: (N,) number of the answer that the reward rests on, or −1.
    """

    observations: NDArray[np.float32]
    actions: NDArray[np.int64]
    rewards: NDArray[np.float32]
    next_observations: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]
    undone: NDArray[np.bool_]
    poses: NDArray[np.float64]
    starts: NDArray[np.float64]
    steps: NDArray[np.int64]
    sources: NDArray[np.int64]
    answers: NDArray[np.int64]


FIELDS = tuple(Transitions.__dataclass_fields__)


class ReplayBuffer:
    """A ring of transitions.

    Attributes:
        capacity: how many are kept.
        added: how many were added and not removed again, those that fell out of the ring included.
    """

    def __init__(self, capacity: int, inputs: int) -> None:
        """Make an empty buffer for observations of ``inputs`` values."""
        self.capacity = capacity
        self.added = 0
        self._arrays: dict[str, np.ndarray] = {
            "observations": np.zeros((capacity, inputs), np.float32),
            "actions": np.zeros(capacity, np.int64),
            "rewards": np.zeros(capacity, np.float32),
            "next_observations": np.zeros((capacity, inputs), np.float32),
            "terminated": np.zeros(capacity, np.bool_),
            "truncated": np.zeros(capacity, np.bool_),
            "undone": np.zeros(capacity, np.bool_),
            "poses": np.zeros((capacity, 7), np.float64),
            "starts": np.zeros((capacity, 7), np.float64),
            "steps": np.zeros(capacity, np.int64),
            "sources": np.zeros(capacity, np.int64),
            "answers": np.zeros(capacity, np.int64),
        }

    def __len__(self) -> int:
        """Return how many transitions are held."""
        return min(self.added, self.capacity)

    def add(self, transitions: Transitions) -> None:
        """Add transitions, in place of the oldest when the ring is full."""
        count = len(transitions.actions)
        index = (self.added + np.arange(count)) % self.capacity
        for name in FIELDS:
            self._arrays[name][index] = getattr(transitions, name)
        self.added += count

    def sample(self, rng: np.random.Generator, count: int) -> Transitions:
        """Return ``count`` transitions drawn evenly, with replacement."""
        return self.at(self.draw(rng, count))

    def sample_states(self, rng: np.random.Generator, count: int) -> Transitions:
        """Return everything tried from ``count`` states, drawn with replacement by how much was tried there.

        What was tried from a state and stored at the same time lies together, in the buffer as in what is returned.
        """
        held = len(self)
        drawn = self.draw(rng, count)
        width = min(held, 2 * COUNT - 1)
        near = (drawn[:, None] + np.arange(width) - width // 2) % held
        poses = self._arrays["poses"]
        # Few poses share a coordinate without being equal, and one is read faster than seven.
        alike = poses[:, 0].take(near) == poses[drawn, 0][:, None]
        rows, states = near[alike], np.repeat(drawn, alike.sum(axis=1))
        same = (poses.take(rows, axis=0) == poses.take(states, axis=0)).all(axis=1)
        return self.at(rows if same.all() else rows[same])

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return the rows (count,) of transitions drawn evenly, with replacement."""
        return rng.integers(len(self), size=count)

    def at(self, index: np.ndarray) -> Transitions:
        """Return the transitions in rows (M,)."""
        # Half the time that indexing takes.
        return Transitions(**{name: self._arrays[name].take(index, axis=0) for name in FIELDS})

    def held(self) -> Transitions:
        """Return a copy of everything held."""
        return Transitions(**{name: values[: len(self)].copy() for name, values in self._arrays.items()})

    def revalue(self, rows: np.ndarray, rewards: NDArray[np.float32], at_goal: np.ndarray, *, step_back: bool) -> None:
        """Give transitions in ``rows`` (M,) other rewards (M,).

        Args:
            rows: which.
            rewards: their new rewards.
            at_goal: (M,) which reach the goal.
            step_back: whether wrong actions are stepped back from.
        """
        self._arrays["rewards"][rows] = rewards
        self._arrays["terminated"][rows] = at_goal & (rewards >= 0)
        self._arrays["undone"][rows] = (rewards < 0) & step_back

    def remove(self, mask: np.ndarray) -> None:
        """Remove the transitions (len,) that a mask says, keeping the order of the others."""
        first = self.added % self.capacity if self.added > self.capacity else 0
        order = np.roll(np.arange(len(self)), -first)
        kept = order[~mask[order]]
        for values in self._arrays.values():
            values[: len(kept)] = values[kept]
        self.added = len(kept)

    def state(self) -> dict[str, np.ndarray]:
        """Return everything held, as arrays."""
        held = {name: values[: len(self)].copy() for name, values in self._arrays.items()}
        return {**held, "added": np.array(self.added)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Hold what :meth:`state` returned."""
        self.added = int(state["added"])
        for name in FIELDS:
            self._arrays[name][: len(self)] = state[name]
