"""The learned policy: the argmax of a Q-network, or an actor's twist, on the observation alone."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopdqn import pose
from koopdqn.artifact import Artifact, check_task, described, read_artifact, reading, write_artifact
from koopdqn.errors import BadInputError
from koopdqn.intent.bend import CORRECTED, Bend
from koopdqn.pose import Array
from koopdqn.rl.dqn import load_arrays
from koopdqn.rl.network import QNetwork, observe, size, values_in
from koopdqn.rl.settings import NetworkSettings
from koopdqn.settings import typed, validate
from koopdqn.tasks.actions import COUNT, in_balls, twist_size
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import Task

KIND = "policy"
CONTINUOUS = "continuous"
"""What a policy's metadata say of its actions where they are twists."""
_BEND, _FRAME = "bend/", "frame/"


@dataclass(frozen=True)
class Policy:
    """A policy for a task.

    Attributes:
        network: the Q-network, or the actor.
        task: gives the goal in observations.
        frame: the start frame of observations.
        continuous: whether the network is an actor.
        bend: of its path where a person has corrected it (:mod:`koopdqn.rl.around` follows it); None where nobody has.
    """

    network: QNetwork
    task: Task
    frame: StartFrame = STILL
    continuous: bool = False
    bend: Bend | None = None

    def __call__(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the actions from poses (N, 7) of episodes that began at ``starts`` (N, 7).

        They are the ones (N,) of greatest value, or the actor's twists (N, 3 or 6).

        Raises:
            BadInputError: poses or starts are of another shape or not finite, or a quaternion has not unit length.
        """
        pose.check(poses, "poses")
        pose.check(starts, "starts")
        values = self.values(poses, starts)
        return in_balls(values.astype(np.float64)) if self.continuous else np.asarray(values.argmax(axis=1))

    def values(self, poses: Array, starts: Array) -> np.ndarray:
        """Return the network's outputs at poses (N, 7) of episodes that began at ``starts`` (N, 7).

        They are the values Q (N, 10), or an actor's twists (N, 3 or 6) before they are shortened.
        """
        return self.network.values(observe(self.frame.to_frame(poses, starts), self.task))


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
    regression = {} if frame.regression is None else frame.regression.arrays()
    held = {_FRAME + name: values for name, values in regression.items()}
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
        found = {name.removeprefix(_FRAME): each for name, each in artifact.arrays.items() if name.startswith(_FRAME)}
        frame = StartFrame.restore({**about.get("frame", STILL.described()), **found})
        policy = Policy(network, task, frame, continuous, bend)
        policy(task.nominal_start[None], task.nominal_start[None])
        return policy, about
