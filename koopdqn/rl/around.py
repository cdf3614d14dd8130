"""A policy, or a scripted person, along a moved path: each is asked at the straightened pose."""

from dataclasses import dataclass, replace

import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.intent.bend import Bend, BentIntent, BentTrust
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import TrustDomain
from koopdqn.oracles.base import Answer, Oracle, OracleSettings, Question
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy
from koopdqn.tasks.actions import ROTATING, excess, in_balls, legal_actions, moved_by, reached_poses, twists_between
from koopdqn.tasks.rollout import Controller
from koopdqn.tasks.step import IN_PLACE

# A pose moved by less [m] is not moved.
_UNMOVED_M = 1e-6
# An action comes forward if it does by this share of a step.
_FORWARD = 0.1
# Table 1's actions along the three axes, forth and back.
_FORTH, _BACK = slice(4, None, 2), slice(5, None, 2)


@dataclass(frozen=True)
class PolicyAround:
    """A policy that was trained without obstacles and serves among them: the path alone was moved, not the policy.

    It is asked at the straightened pose, for a direction between its ten actions: rounding once to the ten and, turned
    as the path is turned, once more would add up. The action nearest to that motion from the moved path is taken, so
    that what the ten directions stray is made good at once; of the ten those alone that come forward, or two that make
    good what the other strays could follow each other for ever. A twist needs no rounding: it is turned itself.

    Attributes:
        policy: that was trained without obstacles.
        bend: of the path around the obstacles.
    """

    policy: Policy
    bend: Bend

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions (N,), or twists (N, 3 or 6), from poses (N, 7) of episodes that began there (N, 7)."""
        frame, task = self.policy.frame, self.policy.task
        local = frame.to_frame(poses, starts)
        straight = self.bend.straightened(local)
        unmoved = frame.from_frame(straight, starts, straight)
        moved = pose.position_distance(straight, local) > _UNMOVED_M
        values = self.policy.values(unmoved, starts).astype(float)
        own = in_balls(values) if self.policy.continuous else np.asarray(values.argmax(axis=1))
        if not moved.any():
            return own
        reached = moved_by(unmoved, own, task) if self.policy.continuous else self._between(unmoved, values, own)
        following = self.bend.bent_next(local, straight, frame.to_frame(reached, starts))
        following[:, pose.POSITION] -= self.bend.beside(local)
        wished = frame.from_frame(following, starts, poses)
        # Where the path is not moved, nor is the policy.
        if self.policy.continuous:
            return np.where(moved[:, None], twists_between(poses, wished, task), own)
        return np.where(moved, self._forward(poses, starts, wished), own)

    def _forward(self, poses: Array, starts: Array, wished: Array) -> np.ndarray:
        """Return the actions (N,) nearest to wished poses (N, 7) of those that come forward from poses (N, 7)."""
        frame, task = self.policy.frame, self.policy.task

        def come(places: Array, begun: Array) -> Array:
            # Coming nearer to the goal's orientation is coming forward, too: a step as far as one turn.
            left = pose.rotation_distance(places, task.goal) / (IN_PLACE * task.rotation_tolerance_rad)
            return self.bend.come(frame.to_frame(places, begun)) - task.step_m * left

        reached = reached_poses(poses, task)
        count = reached.shape[1]
        after = come(reached.reshape(-1, reached.shape[-1]), np.repeat(starts, count, axis=0)).reshape(-1, count)
        forward = after - come(poses, starts)[:, None] > _FORWARD * task.step_m
        far = np.where(legal_actions(task), excess(reached, wished[:, None], task), np.inf)
        among = np.where(forward, far, np.inf)
        return np.asarray(np.where(np.isfinite(among).any(axis=1, keepdims=True), among, far).argmin(axis=1))

    def _between(self, unmoved: Array, values: Array, best: np.ndarray) -> Array:
        """Return the poses (N, 7) that the direction between the ten actions, of values (N, 10), reaches."""
        task = self.policy.task
        reached = reached_poses(unmoved, task)[np.arange(len(best)), best]
        # Between the ten actions: along each axis by how much more the way there is worth than the way back. Of an
        # action that turns nothing is known between it and others.
        slope = values[:, _FORTH] - values[:, _BACK]
        slope /= np.maximum(pose.norm(slope, keepdims=True), 1e-12)
        distance = np.minimum(task.step_m, pose.position_distance(unmoved, task.goal))[:, None]
        between = unmoved[:, pose.POSITION] + distance * slope
        position = np.where(np.isin(best, ROTATING)[:, None], reached[:, pose.POSITION], between)
        return pose.make(position, reached[:, pose.QUATERNION])


def around(policy: Policy, model: IntentModel) -> "Policy | PolicyAround":
    """Return a policy made fit for the obstacles that an intent model is bent around, if it was trained without any.

    A corrected policy is made to follow its correction.

    Raises:
        BadInputError: it was corrected where nothing stood, and is to serve among obstacles.
    """
    moved = model.bend if isinstance(model, BentIntent) and not policy.task.obstacles else None
    if moved is not None and policy.bend is not None:
        raise BadInputError("obstacles: a corrected run serves the scene in which it was corrected, found others in it")
    bend = policy.bend if moved is None else moved
    return policy if bend is None else PolicyAround(policy, bend)


def tube_of(policy: Controller, trust: TrustDomain) -> TrustDomain:
    """Return the trust domain along the path that a policy takes: an intent's goes with a person's correction."""
    if not isinstance(policy, PolicyAround) or policy.policy.bend is None:
        return trust
    return BentTrust.of(trust, policy.bend)


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
    return led_around(oracle, model) if settings.simulated else oracle


def led_around(person: Oracle, model: IntentModel) -> Oracle:
    """Return a scripted person who would go as an intent is bent, if it is."""
    return PersonAround(person, model) if isinstance(model, BentIntent) else person
