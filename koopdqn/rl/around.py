"""A policy, or a scripted person, along a moved path: each is asked at the straightened pose."""

from dataclasses import dataclass, replace

import numpy as np

from koopdqn import pose
from koopdqn.intent.bend import Bend, BentIntent
from koopdqn.intent.model import IntentModel
from koopdqn.oracles.base import Answer, Oracle, OracleSettings, Question
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy
from koopdqn.tasks.actions import nearest_actions, reached_poses

# Difference in value at which an action counts 1/e of the best.
_SHARPNESS = 0.2


@dataclass(frozen=True)
class PolicyAround:
    """A policy that was trained without obstacles and serves among them: the path alone was moved, not the policy.

    It is asked at the straightened pose. Of the ten actions the one nearest to what it would do there, turned as the
    path is turned, is taken.

    Attributes:
        policy: that was trained without obstacles.
        bend: of the path around the obstacles.
    """

    policy: Policy
    bend: Bend

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions (N,) from poses (N, 7) of episodes that began at ``starts`` (N, 7)."""
        frame, task = self.policy.frame, self.policy.task
        local = frame.to_frame(poses, starts)
        straight = self.bend.straightened(local)
        unmoved = frame.from_frame(straight, starts, straight)
        values = self.policy.values(unmoved, starts).astype(float)
        best = values.argmax(axis=1)
        every = reached_poses(unmoved, task)
        # The mean of the better actions is a direction between the ten: two roundings to one of them would add up.
        weights = np.exp((values - values.max(axis=1, keepdims=True)) / _SHARPNESS)
        weights /= weights.sum(axis=1, keepdims=True)
        position = np.einsum("na,nad->nd", weights, every[..., pose.POSITION])
        reached = pose.make(position, every[np.arange(len(best)), best][:, pose.QUATERNION])
        following = self.bend.bent_next(local, straight, frame.to_frame(reached, starts))
        return nearest_actions(poses, frame.from_frame(following, starts, poses), task)


def around(policy: Policy, model: IntentModel) -> "Policy | PolicyAround":
    """Return a policy made fit for the obstacles that an intent model is bent around, if it was trained without any."""
    bent = isinstance(model, BentIntent) and not policy.task.obstacles
    return PolicyAround(policy, model.bend) if isinstance(model, BentIntent) and bent else policy


@dataclass(frozen=True)
class PersonAround(Oracle):
    """A scripted person who would go around obstacles as the intent is bent around them.

    Attributes:
        person: answers along the path itself.
        model: the bent intent.
    """

    person: Oracle
    model: BentIntent

    def answer(self, question: Question) -> Answer:
        """Return the person's answer about the straightened motion."""
        frame, starts = self.model.start_frame, question.start[None]
        here, there = (frame.to_frame(each[None], starts) for each in (question.pose, question.reached))
        straight, following = (self.model.bend.straightened(each) for each in (here, there))
        pose_, reached = (frame.from_frame(each, starts, each)[0] for each in (straight, following))
        return self.person.answer(replace(question, pose=pose_, reached=reached))


def answering(oracle: Oracle, settings: OracleSettings, model: IntentModel) -> Oracle:
    """Return an oracle made fit for a bent intent, if it stands in for a person and knows nothing of obstacles."""
    return PersonAround(oracle, model) if isinstance(model, BentIntent) and settings.simulated else oracle
