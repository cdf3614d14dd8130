"""Actions that have a reward, and the transitions that are stored of them."""

from dataclasses import dataclass

import numpy as np

from koopdqn.intent.reward import RULE, SOURCES, ActionEvaluation
from koopdqn.pose import Array
from koopdqn.rl.history import History
from koopdqn.rl.network import observe
from koopdqn.rl.replay_buffer import Transitions
from koopdqn.tasks.actions import within_tolerance
from koopdqn.tasks.task import Task, demonstrator_next_poses


@dataclass(frozen=True)
class Labelled:
    """M actions that have a reward.

    Attributes:
        evaluation: of the actions from N poses; holds the rewards.
        rows: (M,) which of its poses.
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

    def transitions(self, task: Task, *, step_back: bool) -> Transitions:
        """Return them as transitions of a task in which wrong actions are undone, or are not."""
        evaluation, each = self.evaluation, (self.rows, self.actions)
        wrong = self.rewards < 0
        return Transitions(
            observe(evaluation.local[self.rows], task),
            self.actions,
            self.rewards.astype(np.float32),
            observe(evaluation.local_reached[each], task),
            terminated=evaluation.at_goal[each] & ~wrong,
            truncated=np.full(len(self.rows), self.truncated),
            undone=wrong & step_back,
            poses=evaluation.poses[self.rows],
            starts=evaluation.starts[self.rows],
            steps=evaluation.steps[self.rows],
            sources=evaluation.source[each],
            answers=evaluation.answer[each],
        )

    def count(self, history: History, task: Task) -> None:
        """Count them in a history: by where their rewards came from, and how many the demonstrator agrees with."""
        evaluation, each = self.evaluation, (self.rows, self.actions)
        sources = evaluation.source[each]
        counted = sources != RULE
        if not counted.any():
            return
        # Once a state, of which there are up to ten actions.
        states, state = np.unique(self.rows[counted], return_inverse=True)
        wished = demonstrator_next_poses(task, evaluation.poses[states], evaluation.starts[states])[state]
        agrees = within_tolerance(evaluation.reached[each][counted], wished, task)
        same = agrees == (self.rewards[counted] >= 0)
        for source in range(RULE + 1, len(SOURCES)):
            history.labelled[source] += int((sources == source).sum())
            history.agreed[source] += int(same[sources[counted] == source].sum())
