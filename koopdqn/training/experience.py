"""Experience: actions tried and what was judged of them, as transitions to store and as a tally of whom to believe."""

from dataclasses import dataclass

import numpy as np

from koopdqn.dqn.observation import observe
from koopdqn.dqn.replay import Transitions
from koopdqn.environment.compare import within_tolerance
from koopdqn.environment.reward import RULE, SOURCES, Judgement
from koopdqn.feedback.scripted import demonstrator_wishes
from koopdqn.pose import Array
from koopdqn.tasks.task import Task
from koopdqn.training.history import History


@dataclass(frozen=True)
class Trial:
    """An action that is tried in an episode.

    Attributes:
        episode: number of the episode.
        step: steps made in it before.
        pose: (7,) before the action.
        start: (7,) where the episode began.
        action: index in Table 1.
    """

    episode: int
    step: int
    pose: Array
    start: Array
    action: int


@dataclass(frozen=True)
class Tries:
    """M actions that were tried.

    Attributes:
        judgement: what is known of all actions from the poses that they were tried from, among others.
        rows: (M,) which of its poses.
        actions: (M,) indices in Table 1.
        observations: (M, inputs) before the actions.
        poses: (M, 7) before them.
        starts: (M, 7) where their episodes began.
        steps: (M,) steps of the episode before them.
        cut: whether the episode was cut at its step limit after them.
    """

    judgement: Judgement
    rows: np.ndarray
    actions: np.ndarray
    observations: np.ndarray
    poses: Array
    starts: Array
    steps: np.ndarray
    cut: bool = False

    @classmethod
    def of_one(
        cls, trial: Trial, judgement: Judgement, row: int, observation: np.ndarray, *, cut: bool = False
    ) -> "Tries":
        """Return one trial as tries, its pose observed as (inputs,) and judged in a row."""
        each = np.array([row]), np.array([trial.action])
        places = trial.pose[None], trial.start[None]
        return cls(judgement, *each, observation[None], *places, np.array([trial.step]), cut)

    @property
    def rewards(self) -> Array:
        """Their rewards (M,)."""
        return np.asarray(self.judgement.reward[self.rows, self.actions])

    def transitions(self, task: Task, *, step_back: bool) -> Transitions:
        """Return them as transitions of a task in which wrong actions are stepped back from, or are not."""
        judgement, each = self.judgement, (self.rows, self.actions)
        wrong = self.rewards < 0
        return Transitions(
            self.observations,
            self.actions,
            self.rewards.astype(np.float32),
            observe(judgement.placed_reached[each], task),
            terminated=judgement.at_goal[each] & ~wrong,
            truncated=np.full(len(self.rows), self.cut),
            undone=wrong & step_back,
            poses=self.poses,
            starts=self.starts,
            steps=self.steps,
            sources=judgement.source[each],
            answers=judgement.answer[each],
        )

    def tally(self, history: History, task: Task) -> None:
        """Count them in a history: by where their rewards came from, and how many the demonstrator agrees with."""
        each = self.rows, self.actions
        sources = self.judgement.source[each]
        counted = sources != RULE
        if not counted.any():
            return
        # Once a state, of which there are up to ten tries.
        _, first, state = np.unique(self.rows[counted], return_index=True, return_inverse=True)
        wished = demonstrator_wishes(task, self.poses[counted][first], self.starts[counted][first])[state]
        agrees = within_tolerance(self.judgement.reached[self.rows[counted], self.actions[counted]], wished, task)
        same = agrees == (self.rewards[counted] >= 0)
        for source in range(RULE + 1, len(SOURCES)):
            history.judged[source] += int((sources == source).sum())
            history.agreed[source] += int(same[sources[counted] == source].sum())
