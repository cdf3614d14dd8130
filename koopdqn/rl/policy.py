"""The learned policy, the argmax of a Q-network or an actor's twist on the observation alone, also on a moved path."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.artifact import Artifact, below, check_task, described, read_artifact, reading, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.intent.bend import CORRECTED, Bend, BentIntent, BentTrust
from koopdqn.intent.model import IntentModel
from koopdqn.intent.trust import TrustDomain
from koopdqn.pose import Array
from koopdqn.rl.dqn import load_arrays
from koopdqn.rl.network import QNetwork, observe, size, values_in
from koopdqn.rl.settings import NetworkSettings
from koopdqn.settings import typed, validate
from koopdqn.tasks.actions import (
    COUNT,
    ROTATING,
    excess,
    in_balls,
    legal_actions,
    moved_by,
    reached_poses,
    twist_size,
    twists_between,
)
from koopdqn.tasks.rollout import Controller
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.step import IN_PLACE
from koopdqn.tasks.task import Task

KIND = "policy"
CONTINUOUS = "continuous"
"""What a policy's metadata say of its actions where they are twists."""
_BEND, _FRAME = "bend/", "frame/"
# A pose moved by less [m] is not moved.
_UNMOVED_M = 1e-6
# An action comes forward if it does by this share of a step.
_FORWARD = 0.1
# Table 1's actions along the three axes, forth and back.
_FORTH, _BACK = slice(4, None, 2), slice(5, None, 2)


@dataclass(frozen=True)
class Policy:
    """A policy for a task.

    Attributes:
        network: the Q-network, or the actor.
        task: gives the goal in observations.
        frame: the start frame of observations.
        continuous: whether the network is an actor.
        bend: of its path where a person has corrected it; None where nobody has.
    """

    network: QNetwork
    task: Task
    frame: StartFrame = STILL
    continuous: bool = False
    bend: Bend | None = None

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions from poses (N, 7) of episodes that began at ``starts`` (N, 7).

        They are the ones (N,) of greatest value, or the actor's twists (N, 3 or 6); of a corrected policy those that
        lead along its correction. Where a path passes itself starts change on the way: ``frame.onward`` gives those
        that count from a pose on.

        Raises:
            BadInputError: poses or starts are of another shape or not finite, or a quaternion has not unit length.
        """
        poses, starts = pose.checked(poses, "poses"), pose.checked(starts, "starts")
        if self.bend is not None:
            return PolicyAround(self, self.bend)(poses, starts)
        values = self.values(poses, starts)
        return in_balls(values.astype(np.float64)) if self.continuous else np.asarray(values.argmax(axis=1))

    def values(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the network's outputs at poses (N, 7) of episodes that began at ``starts`` (N, 7).

        They are the values Q (N, 10), or an actor's twists (N, 3 or 6) before they are shortened.
        """
        return self.network.values(observe(self.frame.to_frame(poses, starts), self.task))


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

    A corrected policy follows its correction, whatever stands there.
    """
    moved = model.bend if isinstance(model, BentIntent) and not policy.task.obstacles else None
    bend = moved if policy.bend is None else policy.bend
    return policy if bend is None else PolicyAround(policy, bend)


def tube_of(policy: Controller, trust: TrustDomain) -> TrustDomain:
    """Return the trust domain along the path that a policy takes: an intent's goes with a person's correction."""
    if not isinstance(policy, PolicyAround) or policy.policy.bend is None:
        return trust
    # A correction made where nothing stood goes before what leads the intent around obstacles.
    own = trust.base if isinstance(trust, BentTrust) and not policy.policy.task.obstacles else trust
    return BentTrust.of(own, policy.bend)


def policy_network(task: Task, settings: NetworkSettings, *, continuous: bool) -> QNetwork:
    """Return a policy's network, whose arrays are still to be set."""
    outputs = twist_size(task) if continuous else COUNT
    return QNetwork(size(task), settings, np.random.default_rng(0), outputs=outputs)


def write_policy(
    path: Path,
    arrays: dict[str, np.ndarray],
    network: NetworkSettings,
    frame: StartFrame,
    about: dict[str, Any],
    *,
    continuous: bool = False,
) -> None:
    """Write a policy: the network's arrays and settings, its frame, and further metadata ``about``."""
    kind = {"actions": CONTINUOUS} if continuous else {}
    about = {**about, **kind, "network": described(network), "frame": frame.described()}
    held = {_FRAME + name: values for name, values in frame.learned().items()}
    write_artifact(path, Artifact(KIND, {**arrays, **held}, about))


def write_corrected(path: Path, source: Path, bend: Bend) -> None:
    """Write the policy of the file ``source`` with another bend of its path.

    Raises:
        BadInputError: the source is missing or damaged.
    """
    held = read_artifact(source, KIND)
    arrays = {**held.arrays, CORRECTED: bend.path, f"{_BEND}offsets": bend.offsets}
    write_artifact(path, Artifact(KIND, arrays, held.about))


@typed
def read_policy(path: str | Path, task: Task, *, anywhere: bool = False) -> tuple[Policy, dict[str, Any]]:
    """Read a policy for a task, and its metadata.

    With ``anywhere`` the task may have obstacles that the policy was trained without.

    Raises:
        BadInputError: the file is missing, damaged, of another task, or its arrays do not fit its settings.
    """
    path = Path(path)
    artifact = read_artifact(path, KIND)
    about = dict(artifact.about)
    trained = about.get("task")
    if anywhere and isinstance(trained, dict) and not trained.get("obstacles"):
        task = task.without_obstacles()
    check_task(f"policy {path}", about.get("task"), task)
    with reading(f"policy {path}"):
        node = {key: value for key, value in about["network"].items() if key != "target"}
        settings = validate(node, NetworkSettings, "policy.network")
        continuous = about.get("actions") == CONTINUOUS
        outputs = twist_size(task) if continuous else COUNT
        arrays = {name: values for name, values in artifact.arrays.items() if not name.startswith((_BEND, _FRAME))}
        bend = None
        if CORRECTED in artifact.arrays:
            bend = Bend(*(artifact.arrays[_BEND + name].astype(float) for name in ("path", "offsets")))
            bend.straightened(task.nominal_start[None])
        held, wanted = sum(values.size for values in arrays.values()), values_in(size(task), settings, outputs)
        # Before a network is made that the settings alone make large.
        if held != wanted:
            raise BadInputError(
                f"policy {path} must hold the arrays of its own settings, {wanted} numbers, found {held}"
            )
        network = policy_network(task, settings, continuous=continuous)
        load_arrays(network, arrays)
        frame = StartFrame.restore({**about.get("frame", STILL.described()), **below(artifact.arrays, _FRAME)})
        policy = Policy(network, task, frame, continuous, bend)
        policy(task.nominal_start[None], task.nominal_start[None])
        return policy, about
