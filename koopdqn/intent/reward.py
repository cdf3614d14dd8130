"""The reward of Algorithm 1: from the intent model where it is trusted, otherwise from the oracle."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.correction import CorrectedIntent
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import Trust, TrustDomain
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.actions import SUGGESTED, excess, legal_actions, moved_by, reached_poses, toward, twists_between
from koopdqn.tasks.task import NO_MOTION, Task

# Where a reward came from.
RULE: Final = 0
TRUSTED: Final = 1
ASKED: Final = 2
REMEMBERED: Final = 3
CERTIFIED: Final = 4
SOURCES: Final = ("rule", "trusted", "asked", "remembered", "certified")
BY_MODEL: Final = (TRUSTED, CERTIFIED)
"""Sources of the intent model's rewards: trusted by demonstrations, or certified by a nearby answer."""

NO_ANSWER: Final = -1
"""The number of the answer of a reward without one."""

_MARGIN_DIGITS = 6

Prediction = Literal["raw", "rescaled"]
"""What a reached pose is compared with: the intent model's prediction, or its fixed-step prediction."""


class RewardSettings(Settings):
    """How a comparison becomes a reward."""

    shape: Literal["sign", "margin"] = Field(
        description="plus or minus one (the paper), or the margin to the tolerance, with the same sign"
    )
    prediction: Prediction = Field(
        description="compare with the raw prediction (the paper) or with the fixed-step prediction"
    )
    size: float = Field(gt=0, le=1e3, description="largest absolute reward of a step")
    goal: float = Field(ge=0, le=1e3, description="added when a right action reaches the goal")


@dataclass(frozen=True)
class ActionEvaluation:
    """What is known, without asking, of all ten actions from each of N poses.

    With continuous actions the model's own suggestion and given twists stand behind the ten: more columns than 10.

    Attributes:
        poses: (N, 7) before the actions.
        starts: (N, 7) where their episodes began, or their legs.
        steps: (N,) steps made before in their episodes.
        reached: (N, 10, 7) poses the actions reach.
        local: (N, 7) the poses in the model's start frame.
        local_reached: (N, 10, 7) the reached poses in that frame.
        predicted: (N, 7) the intent model's prediction.
        reward: (N, 10) by rule or intent model; where ``known`` is false, by the untrusted model.
        known: (N, 10) whether the reward is known without asking.
        source: (N, 10) :data:`RULE`, :data:`TRUSTED` or :data:`CERTIFIED` where known, else :data:`ASKED`.
        margin: (N, 10) 1 minus the distance from the prediction in tolerances, trusted or not: at least 0 within the
            tolerance, −∞ where a rule forbids the action.
        at_goal: (N, 10) whether the reached pose counts as the goal.
        answer: (N, 10) number of the answer that the reward comes from, or −1.
    """

    poses: Array
    starts: Array
    steps: np.ndarray
    reached: Array
    local: Array
    local_reached: Array
    predicted: Array
    reward: Array
    known: np.ndarray
    source: np.ndarray
    margin: Array
    at_goal: np.ndarray
    answer: np.ndarray

    def set_label(self, row: int, action: int, reward: float, source: int, answer: int = NO_ANSWER) -> None:
        """Set the known reward of an action from the pose in a row."""
        self.reward[row, action] = reward
        self.source[row, action] = source
        self.answer[row, action] = answer
        self.known[row, action] = True

    def renew(self, rows: np.ndarray, evaluation: "ActionEvaluation") -> None:
        """Put what another evaluation says of M poses in place of what is known of them, by their rows (M,)."""
        for name in self.__dataclass_fields__:
            getattr(self, name)[rows] = getattr(evaluation, name)


@dataclass(frozen=True, eq=False, repr=False)
class IntentReward:
    """The reward function of a task with a fitted intent.

    Attributes:
        task: the task.
        model: the intent model.
        trust: its trust domain.
        settings: how a comparison becomes a reward.
        continuous: whether actions are continuous.
    """

    task: Task
    model: IntentModel
    trust: TrustDomain
    settings: RewardSettings
    continuous: bool = field(default=False, kw_only=True)

    @cached_property
    def _illegal(self) -> np.ndarray:
        return ~legal_actions(self.task)

    def extended(self, yeses: Array, radii: Array, before: Array, after: Array, reaches: Array) -> "IntentReward":
        """Return the reward function extended by answers, all in the model's start frame.

        Args:
            yeses: (M, 7) poses around which the model is certified.
            radii: (M,) [m] within which it is.
            before: (D, 7) poses at which the model did not expect the answer.
            after: (D, 7) poses that the person wants reached from them.
            reaches: (D,) [m] within which these answers correct the model.
        """
        model = CorrectedIntent(self.model, before, after, reaches) if len(before) else self.model
        trust = self.trust if not len(yeses) else self.trust.extended(yeses, radii)
        return replace(self, model=model, trust=trust)

    def value(self, right: bool, at_goal: bool) -> float:
        """Return the reward of an answer."""
        return self.settings.size * (1.0 if right else -1.0) + (self.settings.goal if right and at_goal else 0.0)

    def evaluate_actions(
        self, poses: Array, steps: np.ndarray, starts: Array | None = None, twists: Array | None = None
    ) -> ActionEvaluation:
        """Return the evaluation of all ten actions from poses (N, 7) after ``steps`` (N,) steps.

        Args:
            poses: where the episodes are.
            steps: how many steps each has made.
            starts: (N, 7) where they began; None if poses are in the start frame already.
            twists: (N, S, 3 or 6) to evaluate behind the named actions, where actions are continuous; None for none.

        Raises:
            BadInputError: poses or starts are of another shape or not finite, or a quaternion has not unit length.
        """
        poses = pose.checked(poses, "poses")
        starts = None if starts is None else pose.checked(starts, "starts")
        return self.evaluated(poses, np.asarray(steps), starts, twists)

    def evaluated(
        self, poses: Array, steps: np.ndarray, starts: Array | None = None, twists: Array | None = None
    ) -> ActionEvaluation:
        """Return what :meth:`evaluate_actions` does, of poses that need no check: training asks at every step."""
        local = poses if starts is None else self.model.start_frame.to_frame(poses, starts)
        here = self.trust.assess(local, steps)
        fitted = self.model.fitted.predict(local)
        # Answers correct it where demonstrations do not decide.
        predicted = np.where(here.demonstrated[:, None], fitted, self.model.correct(local, fitted))
        if starts is not None:
            predicted = self.model.start_frame.from_frame(predicted, starts, poses)
        if self.settings.prediction == "rescaled":
            predicted = self.model.to_step(poses, predicted, self.task.step_m, starts)
        reached = self._reached(poses, predicted, twists)
        local_reached = reached if starts is None else self.model.start_frame.to_frame(reached, starts[:, None])
        margin = 1.0 - excess(reached, predicted[:, None], self.task)
        if self.continuous:
            # Without rounding errors, so that an answer about the suggestion also applies nearby.
            margin[:, SUGGESTED] = margin[:, SUGGESTED].round(_MARGIN_DIGITS)
        reward = np.clip(margin, -1.0, 1.0) if self.settings.shape == "margin" else np.where(margin >= 0, 1.0, -1.0)
        demonstrated, certified, doubt = self._trust(here, local_reached, steps)
        unchanged = pose.position_distance(reached, poses[:, None]) < NO_MOTION
        rows, actions = np.nonzero(unchanged)
        unchanged[rows, actions] = pose.rotation_distance(reached[rows, actions], poses[rows]) < NO_MOTION
        wrong = unchanged
        wrong[:, : self._illegal.size] |= self._illegal
        certain = certain_signs(np.where(wrong, -np.inf, margin), doubt)
        reward = self.settings.size * np.where(wrong, -1.0, reward)
        at_goal = self.task.arrived(reached, starts)
        reward = np.where(at_goal & (reward >= 0), reward + self.settings.goal, reward)
        source = np.select([wrong, demonstrated & certain, certified & certain], [RULE, TRUSTED, CERTIFIED], ASKED)
        margin = np.where(wrong, -np.inf, margin)
        return ActionEvaluation(
            poses,
            np.broadcast_to(self.task.nominal_start, poses.shape) if starts is None else starts,
            steps,
            reached,
            local,
            local_reached,
            predicted,
            reward,
            source != ASKED,
            source,
            margin,
            at_goal,
            np.full_like(source, NO_ANSWER),
        )

    def nearest_actions(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions nearest to the prediction from poses (N, 7) of episodes that began at starts (N, 7).

        They are indices (N,), or twists (N, 3 or 6) where actions are continuous.
        """
        evaluation = self.evaluated(poses, np.zeros(len(poses), dtype=np.int64), starts)
        return self.taken(evaluation, evaluation.margin)

    def taken(self, evaluation: ActionEvaluation, ranking: Array) -> np.ndarray:
        """Return of every pose the action of the highest rank (N, A), as a controller returns actions."""
        best = ranking.argmax(axis=1)
        if not self.continuous:
            return np.asarray(best)
        return twists_between(evaluation.poses, evaluation.reached[np.arange(len(best)), best], self.task)

    def _reached(self, poses: Array, predicted: Array, twists: Array | None) -> Array:
        """Return the poses (N, A, 7) that all actions reach from poses (N, 7), given the prediction (N, 7)."""
        reached = [reached_poses(poses, self.task)]
        if self.continuous:
            reached.append(toward(poses, predicted, self.task)[:, None])
        if twists is not None:
            reached.append(moved_by(poses[:, None], twists, self.task))
        return reached[0] if len(reached) == 1 else np.concatenate(reached, axis=1)

    def _trust(self, here: Trust, reached: Array, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray, Array]:
        """Return which actions (N, 10) demonstrations trust, which only an answer certifies, and the doubt of each."""
        count = reached.shape[1]
        after = self.trust.assess(reached.reshape(-1, 7), np.repeat(steps + 1, count))
        demonstrated, certified = after.demonstrated.reshape(-1, count), after.certified.reshape(-1, count)
        doubt = after.doubt.reshape(-1, count)
        if self.trust.settings.needs == "reached":
            return demonstrated, certified, doubt
        both = (demonstrated | certified) & (here.demonstrated | here.certified)[:, None]
        demonstrated = demonstrated & here.demonstrated[:, None]
        return demonstrated, both & ~demonstrated, np.maximum(doubt, here.doubt[:, None])


def certain_signs(margin: Array, doubt: float | Array) -> np.ndarray:
    """Return which comparisons (N, 10) lie outside the guard band around the tolerance.

    Within it a small error of the model would turn the sign. The best action is always certain, since some action is
    always right (``Task`` limits the step so). Margins (N, 10) are those of :attr:`ActionEvaluation.margin`, the doubt,
    one or (N, 10), is the band's width as a share of the tolerance.
    """
    best = margin == margin.max(axis=1, keepdims=True)
    return np.asarray(best | (np.abs(margin) >= doubt))
