"""The reward of Algorithm 1: from the intent model where it is trusted; elsewhere an oracle must be asked."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.config.settings import Settings
from koopdqn.environment.actions import COUNT, legal_actions, reached_poses
from koopdqn.environment.compare import excess
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import TrustDomain
from koopdqn.pose import Array
from koopdqn.tasks.path import PathSet
from koopdqn.tasks.task import Task

# Where a reward came from.
RULE: Final = 0
TRUSTED: Final = 1
ASKED: Final = 2
REMEMBERED: Final = 3
SOURCES: Final = ("rule", "trusted", "asked", "remembered")

NO_ANSWER: Final = -1
"""Stands for the number of an answer where a reward rests on none."""

# Below this a motion is none: 1e-9 m or rad is far under any tolerance and over rounding.
_NO_MOTION = 1e-9
# So far before the goal leading back to a path begins to fade.
_END_M = 0.02


class RewardSettings(Settings):
    """How a comparison becomes a reward."""

    shape: Literal["sign", "margin"] = Field(
        description="plus or minus one (the paper), or how far inside or outside the tolerance, with the same sign"
    )
    prediction: Literal["raw", "rescaled"] = Field(
        description="compare with the raw prediction (the paper) or with one as long as the agent's step"
    )
    doubt: float = Field(
        ge=0,
        lt=1,
        description="share of the tolerance by which a comparison must be clear to be trusted; 0 trusts all",
    )
    centring: float = Field(
        ge=0,
        le=1,
        description="share of a right action's reward that says how much nearer it comes to the demonstrated path"
        " rather than to the prediction; 0 for none (the paper)",
    )
    centring_path: Literal["mean", "nearest"] = Field(
        description="that path: the mean of the demonstrations, or whichever of them is nearest"
    )
    centring_within_m: float = Field(
        gt=0,
        le=10,
        description="distance from that path, and distance of the demonstrations from their mean path, over which"
        " centring and leading back fade, a standard deviation [m]",
    )
    lead_back_m: float = Field(
        ge=0,
        le=10,
        description="distance from that path at which a prediction is turned to lead back to it as much as along it,"
        " but for what has faded there [m]; 0 leaves the prediction to the intent model (the paper)",
    )
    size: float = Field(gt=0, le=1e3, description="largest absolute reward of a step")
    goal: float = Field(ge=0, le=1e3, description="added when a right action reaches the goal")


@dataclass(frozen=True)
class Judgement:
    """What is known, without asking, of all ten actions from each of N poses.

    Attributes:
        reached: (N, 10, 7) poses the actions reach.
        predicted: (N, 7) the pose the intent model prefers.
        reward: (N, 10) the reward by rule or intent model; where ``known`` is false, the model's untrusted opinion.
        known: (N, 10) whether the reward stands without asking.
        source: (N, 10) :data:`RULE` or :data:`TRUSTED` where known, else :data:`ASKED`.
        margin: (N, 10) how far inside its tolerance the comparison with the prediction is, trusted or not, as a
            share of the tolerance; negative outside, −∞ where a rule forbids the action.
        at_goal: (N, 10) whether the reached pose counts as the goal.
        answer: (N, 10) number of the answer that the reward rests on, or −1.
    """

    reached: Array
    predicted: Array
    reward: Array
    known: np.ndarray
    source: np.ndarray
    margin: Array
    at_goal: np.ndarray
    answer: np.ndarray


class IntentReward:
    """The reward function of a task with a fitted intent.

    Attributes:
        task: the task.
        model: the intent model.
        trust: its trust domain.
        settings: how a comparison becomes a reward.
        path: what rewards are centred on and predictions led back to, see
            :func:`koopdqn.demonstrations.resample.shown_paths`.
    """

    def __init__(
        self, task: Task, model: IntentModel, trust: TrustDomain, settings: RewardSettings, path: PathSet
    ) -> None:
        """Make the reward function."""
        self.task = task
        self.model = model
        self.trust = trust
        self.settings = settings
        self.path = path
        self._illegal = ~legal_actions(task)

    def predicted(self, poses: Array) -> Array:
        """Return the poses (N, 7) that reached poses are compared with, from poses (N, 7)."""
        raw = self.settings.prediction == "raw"
        predicted = self.model.predict(poses) if raw else self.model.preferred(poses, self.task.step_m)
        return self._led_back(poses, predicted) if self.settings.lead_back_m > 0 else predicted

    def _led_back(self, poses: Array, predicted: Array) -> Array:
        """Return predicted poses (N, 7) turned toward the path, as long a motion from poses (N, 7) as before.

        Ten coarse actions leave a path by up to the distance over which the model leads back to it, and where
        demonstrations lie side by side the model leads along their bundle. At the goal, where paths end, the model
        alone leads.
        """
        position = poses[:, pose.POSITION]
        motion = predicted[:, pose.POSITION] - position
        length = np.linalg.norm(motion, axis=1, keepdims=True)
        along = motion / np.where(length > 0, length, 1.0)
        _, nearest, spread = self.path.foot(position)
        aside = nearest - position
        near = self._nearness(np.linalg.norm(aside, axis=1), spread)[:, None]
        left = pose.position_distance(poses, self.task.goal)[:, None]
        across = aside - (aside * along).sum(axis=1, keepdims=True) * along
        turned = along + near * np.minimum(1.0, left / _END_M) * across / self.settings.lead_back_m
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), _NO_MOTION)
        return pose.make(position + length * turned, predicted[:, pose.QUATERNION])

    def _nearness(self, aside: Array, spread: Array) -> Array:
        """Return from 0 to 1 how much the path counts (N,) that far ``aside`` (N,) of it, by its ``spread`` (N,) there.

        It counts nearby only, since from afar a person comes back to it in a way of their own, and only where the
        demonstrations agree: while they still come together, their mean is nobody's path.
        """
        return np.asarray(np.exp(-0.5 * (aside**2 + spread**2) / self.settings.centring_within_m**2))

    def extended(self, yeses: Array, radii: Array, before: Array, after: Array) -> "IntentReward":
        """Return the reward function with a model and a trust domain extended by answers.

        Args:
            yeses: poses (M, 7) around which the model is now trusted.
            radii: (M,) [m].
            before: poses (D, 7) at which the model did not expect the answer.
            after: poses (D, 7) that the person wants reached from them.
        """
        model = self.model if not len(before) else self.model.extended(before, after)
        trust = self.trust if not len(yeses) else self.trust.extended(yeses, radii)
        return IntentReward(self.task, model, trust, self.settings, self.path)

    def value(self, right: bool, at_goal: bool) -> float:
        """Return the reward of an answer."""
        return self.settings.size * (1.0 if right else -1.0) + (self.settings.goal if right and at_goal else 0.0)

    def judge(self, poses: Array, steps: np.ndarray) -> Judgement:
        """Return what is known of all ten actions from poses (N, 7) after ``steps`` (N,) steps."""
        count = len(poses)
        reached = reached_poses(poses, self.task)
        predicted = self.predicted(poses)
        margin = 1.0 - excess(reached, predicted[:, None], self.task)
        reward = np.clip(margin, -1.0, 1.0) if self.settings.shape == "margin" else np.where(margin >= 0, 1.0, -1.0)
        if self.settings.centring > 0:
            share, nearing = self._centring(poses, reached)
            reward = np.where(margin >= 0, (1.0 - share) * reward + share * nearing, reward)
        trusted = self._trusted(poses, reached, steps) & self._certain(margin)
        unchanged = (pose.position_distance(reached, poses[:, None]) < _NO_MOTION) & (
            pose.rotation_distance(reached, poses[:, None]) < _NO_MOTION
        )
        wrong = unchanged | self._illegal
        reward = self.settings.size * np.where(wrong, -1.0, reward)
        at_goal = self.task.reached(reached.reshape(-1, 7)).reshape(count, COUNT)
        reward = np.where(at_goal & (reward >= 0), reward + self.settings.goal, reward)
        source = np.where(wrong, RULE, np.where(trusted, TRUSTED, ASKED))
        margin = np.where(wrong, -np.inf, margin)
        return Judgement(
            reached, predicted, reward, source != ASKED, source, margin, at_goal, np.full_like(source, NO_ANSWER)
        )

    def _centring(self, poses: Array, reached: Array) -> tuple[Array, Array]:
        """Return how much coming nearer to the path counts (N, 1), and how much nearer each comes (N, 10): 0 to 1."""
        aside, _, spread = self.path.foot(poses[:, pose.POSITION])
        after = self.path.distance(reached[..., pose.POSITION].reshape(-1, 3)).reshape(reached.shape[:2])
        share = self.settings.centring * self._nearness(aside, spread)
        return share[:, None], 0.5 + 0.5 * np.clip((aside[:, None] - after) / self.task.step_m, -1.0, 1.0)

    def _certain(self, margin: Array) -> np.ndarray:
        # A comparison that a small error of the model would turn over is no knowledge; but some action is
        # always right (design, row 9), so the best one needs no certainty.
        best = margin == margin.max(axis=1, keepdims=True)
        return np.asarray(best | (np.abs(margin) >= self.settings.doubt))

    def _trusted(self, poses: Array, reached: Array, steps: np.ndarray) -> np.ndarray:
        count = len(poses)
        after = self.trust.inside(reached.reshape(-1, 7), np.repeat(steps + 1, COUNT)).reshape(count, COUNT)
        if self.trust.settings.needs == "reached":
            return after
        return np.asarray(after & self.trust.inside(poses, steps)[:, None])
