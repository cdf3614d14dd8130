"""The replay buffer and its transitions, made from labelled actions (§3.1)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopdqn.intent.reward import RULE, SOURCES, ActionEvaluation
from koopdqn.pose import Array
from koopdqn.rl.checks import History
from koopdqn.rl.network import observe
from koopdqn.tasks.actions import COUNT, twists_between, within_tolerance
from koopdqn.tasks.task import Task, demonstrator_next_poses


@dataclass(frozen=True)
class Batch:
    """Of transitions what an update learns from.

    Attributes:
        observations: (N, inputs).
        actions: (N,) indices in Table 1.
        rewards: (N,).
        next_observations: (N, inputs) observations after the actions.
        terminated: (N,) whether the goal was reached.
        undone: (N,) whether the action was wrong and undone.
        twists: (N, 3 or 6) the actions as twists; None where Table 1's are all there are.
    """

    observations: NDArray[np.float32]
    actions: NDArray[np.int64]
    rewards: NDArray[np.float32]
    next_observations: NDArray[np.float32]
    terminated: NDArray[np.bool_]
    undone: NDArray[np.bool_]
    twists: NDArray[np.float32] | None = None


@dataclass(frozen=True, kw_only=True)
class Transitions(Batch):
    """Transitions.

    Attributes:
        truncated: (N,) whether the episode was cut there; the value beyond still counts.
        poses: (N, 7) before the actions.
        starts: (N, 7) where their episodes began.
        steps: (N,) steps made before in the episodes.
        sources: (N,) sources of the rewards (:data:`koopdqn.intent.reward.SOURCES`).
        answers: (N,) number of the answer that the reward comes from, or −1.
    """

    truncated: NDArray[np.bool_]
    poses: NDArray[np.float64]
    starts: NDArray[np.float64]
    steps: NDArray[np.int64]
    sources: NDArray[np.int64]
    answers: NDArray[np.int64]


BATCH_FIELDS, FIELDS = (
    tuple(name for name in kind.__dataclass_fields__ if name != "twists") for kind in (Batch, Transitions)
)


@dataclass(frozen=True)
class Labelled:
    """M actions with their rewards.

    Attributes:
        evaluation: of the actions from N poses; gives the rewards.
        rows: (M,) indices of the poses.
        actions: (M,) indices in Table 1.
        truncated: whether the episode was truncated after them.
    """

    evaluation: ActionEvaluation
    rows: np.ndarray
    actions: np.ndarray
    truncated: bool = False

    @classmethod
    def one(cls, evaluation: ActionEvaluation, row: int, action: int, *, truncated: bool = False) -> "Labelled":
        """Return one action from the pose in a row."""
        return cls(evaluation, np.array([row]), np.array([action]), truncated)

    @property
    def rewards(self) -> Array:
        """Their rewards (M,)."""
        return np.asarray(self.evaluation.reward[self.rows, self.actions])

    def transitions(self, task: Task, *, step_back: bool, continuous: bool = False) -> Transitions:
        """Return the transitions of a task in which wrong actions are undone, or are not."""
        evaluation, each = self.evaluation, (self.rows, self.actions)
        undone = (self.rewards < 0) & step_back
        return Transitions(
            observe(evaluation.local[self.rows], task),
            self.actions,
            self.rewards.astype(np.float32),
            observe(evaluation.local_reached[each], task),
            terminated=evaluation.at_goal[each] & ~undone,
            truncated=np.full(len(self.rows), self.truncated),
            undone=undone,
            poses=evaluation.poses[self.rows],
            starts=evaluation.starts[self.rows],
            steps=evaluation.steps[self.rows],
            sources=evaluation.source[each],
            answers=evaluation.answer[each],
            twists=self._twists(task) if continuous else None,
        )

    def _twists(self, task: Task) -> NDArray[np.float32]:
        before, reached = self.evaluation.poses[self.rows], self.evaluation.reached[self.rows, self.actions]
        return twists_between(before, reached, task).astype(np.float32)

    def count(self, history: History, task: Task) -> None:
        """Count the rewards in a history, by source, and those that the demonstrator agrees with."""
        evaluation, each = self.evaluation, (self.rows, self.actions)
        sources = evaluation.source[each]
        counted = sources != RULE
        if not counted.any():
            return
        # Once for each state, which has up to ten actions.
        states, state = np.unique(self.rows[counted], return_inverse=True)
        wished = demonstrator_next_poses(task, evaluation.poses[states], evaluation.starts[states])[state]
        agrees = within_tolerance(evaluation.reached[each][counted], wished, task)
        same = agrees == (self.rewards[counted] >= 0)
        for source in range(RULE + 1, len(SOURCES)):
            history.labelled[source] += int((sources == source).sum())
            history.agreed[source] += int(same[sources[counted] == source].sum())


class ReplayBuffer:
    """A ring of transitions.

    Attributes:
        capacity: largest number of transitions held.
        added: number of transitions added and not removed, overwritten ones included.
    """

    def __init__(self, capacity: int, inputs: int, twist: int = 0, per_state: int = COUNT) -> None:
        """Make an empty buffer of observations of ``inputs`` values.

        A twist has ``twist`` numbers, 0 where Table 1's actions are all there are; at most ``per_state`` transitions of
        a state are stored together.
        """
        self.capacity = capacity
        self._per_state = per_state
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
        if twist:
            self._arrays["twists"] = np.zeros((capacity, twist), np.float32)

    def __len__(self) -> int:
        """Return the number of transitions held."""
        return min(self.added, self.capacity)

    def add(self, transitions: Transitions) -> None:
        """Add transitions; a full ring overwrites the oldest."""
        count = len(transitions.actions)
        index = (self.added + np.arange(count)) % self.capacity
        for name, values in self._arrays.items():
            values[index] = getattr(transitions, name)
        self.added += count

    def sample(self, rng: np.random.Generator, count: int) -> Batch:
        """Return ``count`` transitions drawn uniformly, with replacement."""
        return self._batch(self.draw(rng, count))

    def sample_states(self, rng: np.random.Generator, count: int) -> Batch:
        """Return all transitions of ``count`` states, drawn with replacement in proportion to their transitions.

        Transitions of a state that were stored together are adjacent, in the buffer as in the result.
        """
        held = len(self)
        drawn = self.draw(rng, count)
        width = min(held, 2 * self._per_state - 1)
        near = (drawn[:, None] + np.arange(width) - width // 2) % held
        poses = self._arrays["poses"]
        # Comparing one coordinate first is faster: few poses share it without being equal.
        alike = poses[:, 0].take(near) == poses[drawn, 0][:, None]
        rows, states = near[alike], np.repeat(drawn, alike.sum(axis=1))
        same = (poses.take(rows, axis=0) == poses.take(states, axis=0)).all(axis=1)
        return self._batch(rows if same.all() else rows[same])

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        """Return the rows (count,) of transitions drawn uniformly, with replacement."""
        return rng.integers(len(self), size=count)

    def _batch(self, index: np.ndarray) -> Batch:
        """Return what an update learns from of the transitions in rows (M,)."""
        names = [*BATCH_FIELDS, *self._arrays.keys() & {"twists"}]
        # Twice as fast as indexing.
        return Batch(**{name: self._arrays[name].take(index, axis=0) for name in names})

    def held(self) -> Transitions:
        """Return a copy of all transitions."""
        return Transitions(**{name: values[: len(self)].copy() for name, values in self._arrays.items()})

    def revalue(self, rows: np.ndarray, rewards: NDArray[np.float32], at_goal: np.ndarray, *, step_back: bool) -> None:
        """Set new rewards (M,) of the transitions in ``rows`` (M,), some of which reach the goal (M,).

        With ``step_back`` wrong actions are undone.
        """
        self._arrays["rewards"][rows] = rewards
        undone = (rewards < 0) & step_back
        self._arrays["terminated"][rows] = at_goal & ~undone
        self._arrays["undone"][rows] = undone

    def remove(self, mask: np.ndarray) -> None:
        """Remove the transitions selected by a mask (len,), keeping the order of the others."""
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
        for name, values in self._arrays.items():
            values[: len(self)] = state[name]
