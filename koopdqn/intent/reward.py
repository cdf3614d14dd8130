"""The reward of Algorithm 1: from the intent model where it is trusted; elsewhere an oracle must be asked."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.correction import corrected
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import TrustDomain, Vouched
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.actions import COUNT, excess, legal_actions, reached_poses
from koopdqn.tasks.task import Task

# Where a reward came from.
RULE: Final = 0
TRUSTED: Final = 1
ASKED: Final = 2
REMEMBERED: Final = 3
CERTIFIED: Final = 4
SOURCES: Final = ("rule", "trusted", "asked", "remembered", "certified")
BY_MODEL: Final = (TRUSTED, CERTIFIED)
"""The intent model's own: where demonstrations vouch for it, and where only an answer nearby does."""

NO_ANSWER: Final = -1
"""Stands for the number of an answer where a reward rests on none."""

# Below this a motion is none: 1e-9 m or rad is far under any tolerance and over rounding.
_NO_MOTION = 1e-9

Prediction = Literal["raw", "rescaled"]
"""What of the intent model a reached pose is compared with: its prediction, or one as long as the agent's step."""


class RewardSettings(Settings):
    """How a comparison becomes a reward."""

    shape: Literal["sign", "margin"] = Field(
        description="plus or minus one (the paper), or how far inside or outside the tolerance, with the same sign"
    )
    prediction: Prediction = Field(
        description="compare with the raw prediction (the paper) or with one as long as the agent's step"
    )
    size: float = Field(gt=0, le=1e3, description="largest absolute reward of a step")
    goal: float = Field(ge=0, le=1e3, description="added when a right action reaches the goal")


@dataclass(frozen=True)
class ActionEvaluation:
    """What is known, without asking, of all ten actions from each of N poses.

    Attributes:
        poses: (N, 7) before the actions.
        starts: (N, 7) where their episodes began.
        steps: (N,) steps that their episodes made before.
        reached: (N, 10, 7) poses the actions reach.
        placed: (N, 7) the poses themselves, as the model's frame tells them.
        placed_reached: (N, 10, 7) the same of those reached.
        predicted: (N, 7) the pose the intent model prefers.
        reward: (N, 10) the reward by rule or intent model; where ``known`` is false, the model's untrusted opinion.
        known: (N, 10) whether the reward stands without asking.
        source: (N, 10) :data:`RULE`, :data:`TRUSTED` or :data:`CERTIFIED` where known, else :data:`ASKED`.
        margin: (N, 10) how far inside its tolerance the comparison with the prediction is, trusted or not, as a
            share of the tolerance; negative outside, −∞ where a rule forbids the action.
        at_goal: (N, 10) whether the reached pose counts as the goal.
        answer: (N, 10) number of the answer that the reward rests on, or −1.
    """

    poses: Array
    starts: Array
    steps: np.ndarray
    reached: Array
    placed: Array
    placed_reached: Array
    predicted: Array
    reward: Array
    known: np.ndarray
    source: np.ndarray
    margin: Array
    at_goal: np.ndarray
    answer: np.ndarray

    def set_label(self, row: int, action: int, reward: float, source: int, answer: int = NO_ANSWER) -> None:
        """Give an action from a pose, by its row, a reward that is known from now on."""
        self.reward[row, action] = reward
        self.source[row, action] = source
        self.answer[row, action] = answer
        self.known[row, action] = True

    def renew(self, rows: np.ndarray, evaluation: "ActionEvaluation") -> None:
        """Put what another evaluation says of M poses in place of what is known of them, by their rows (M,)."""
        for name in self.__dataclass_fields__:
            getattr(self, name)[rows] = getattr(evaluation, name)


class IntentReward:
    """The reward function of a task with a fitted intent.

    Attributes:
        task: the task.
        model: the intent model.
        trust: its trust domain.
        settings: how a comparison becomes a reward.
    """

    def __init__(self, task: Task, model: IntentModel, trust: TrustDomain, settings: RewardSettings) -> None:
        """Make the reward function."""
        self.task = task
        self.model = model
        self.trust = trust
        self.settings = settings
        self._illegal = ~legal_actions(task)

    def extended(self, yeses: Array, radii: Array, before: Array, after: Array, reaches: Array) -> "IntentReward":
        """Return the reward function with a model and a trust domain extended by answers.

        Args:
            yeses: poses (M, 7) around which the model is now trusted.
            radii: (M,) [m].
            before: poses (D, 7) at which the model did not expect the answer.
            after: poses (D, 7) that the person wants reached from them.
            reaches: (D,) [m] how far from them that moves the model.
        """
        model = corrected(self.model, before, after, reaches)
        trust = self.trust if not len(yeses) else self.trust.extended(yeses, radii)
        return IntentReward(self.task, model, trust, self.settings)

    def value(self, right: bool, at_goal: bool) -> float:
        """Return the reward of an answer."""
        return self.settings.size * (1.0 if right else -1.0) + (self.settings.goal if right and at_goal else 0.0)

    def evaluate_actions(self, poses: Array, steps: np.ndarray, starts: Array | None = None) -> ActionEvaluation:
        """Return what is known of all ten actions from poses (N, 7) after ``steps`` (N,) steps.

        Args:
            poses: where the episodes are.
            steps: how many steps each has made.
            starts: (N, 7) where they began; None where poses are told as from the nominal start.
        """
        count = len(poses)
        reached = reached_poses(poses, self.task)
        placed, placed_reached = poses, reached
        if starts is not None:
            placed = self.model.start_frame.placed(poses, starts)
            placed_reached = self.model.start_frame.placed(reached, starts[:, None])
        here = self.trust.vouched(placed, steps)
        predicted = self._predicted(placed, here.shown)
        if starts is not None:
            predicted = self.model.start_frame.unplaced(predicted, starts, poses)
        if self.settings.prediction == "rescaled":
            predicted = self.model.to_step(poses, predicted, self.task.step_m)
        margin = 1.0 - excess(reached, predicted[:, None], self.task)
        reward = np.clip(margin, -1.0, 1.0) if self.settings.shape == "margin" else np.where(margin >= 0, 1.0, -1.0)
        shown, answered, doubt = self._vouched(here, placed_reached, steps)
        certain = certain_signs(margin, doubt)
        unchanged = pose.position_distance(reached, poses[:, None]) < _NO_MOTION
        rows, actions = np.nonzero(unchanged)
        unchanged[rows, actions] = pose.rotation_distance(reached[rows, actions], poses[rows]) < _NO_MOTION
        wrong = unchanged | self._illegal
        reward = self.settings.size * np.where(wrong, -1.0, reward)
        at_goal = self.task.reached(reached.reshape(-1, 7)).reshape(count, COUNT)
        reward = np.where(at_goal & (reward >= 0), reward + self.settings.goal, reward)
        source = np.select([wrong, shown & certain, answered & certain], [RULE, TRUSTED, CERTIFIED], ASKED)
        margin = np.where(wrong, -np.inf, margin)
        return ActionEvaluation(
            poses,
            np.broadcast_to(self.task.nominal_start, poses.shape) if starts is None else starts,
            steps,
            reached,
            placed,
            placed_reached,
            predicted,
            reward,
            source != ASKED,
            source,
            margin,
            at_goal,
            np.full_like(source, NO_ANSWER),
        )

    def _predicted(self, poses: Array, shown: np.ndarray) -> Array:
        """Return the predicted next poses (N, 7) of placed poses; where demonstrations vouch, answers move nothing."""
        fitted = self.model.fitted.predict(poses)
        return np.where(shown[:, None], fitted, self.model.moved(poses, fitted))

    def _vouched(self, here: Vouched, reached: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray, Array]:
        """Return for which actions (N, 10) demonstrations vouch, for which an answer must, and the doubt of each."""
        after = self.trust.vouched(reached.reshape(-1, 7), np.repeat(steps + 1, COUNT))
        shown, answered = after.shown.reshape(-1, COUNT), after.answered.reshape(-1, COUNT)
        doubt = after.doubt.reshape(-1, COUNT)
        if self.trust.settings.needs == "reached":
            return shown, answered, doubt
        both = (shown | answered) & (here.shown | here.answered)[:, None]
        shown = shown & here.shown[:, None]
        return shown, both & ~shown, np.maximum(doubt, here.doubt[:, None])


def certain_signs(margin: Array, doubt: float | Array) -> np.ndarray:
    """Return which comparisons (N, 10), given by their margins, are clear of the tolerance by a share of it.

    A comparison that a small error of the model would turn over is no knowledge; but some action is always right
    (``Task`` limits the step so), so the best one needs no certainty.

    Args:
        margin: (N, 10) as :attr:`ActionEvaluation.margin`.
        doubt: the share, one or (N, 10).
    """
    best = margin == margin.max(axis=1, keepdims=True)
    return np.asarray(best | (np.abs(margin) >= doubt))
