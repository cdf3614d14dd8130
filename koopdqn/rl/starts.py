"""Starts of episodes: in and around the start region, or along a demonstration."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.pose import Array, from_rotation_vector, multiply, turned_toward
from koopdqn.rl.settings import Agent
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Workcell

_MOST_DRAWS = 1000
_MOST_REGIONS = 20


@dataclass(frozen=True)
class EpisodeStart:
    """The start of an episode.

    Attributes:
        pose: (7,) of the flange.
        start: (7,) where it began; for one that begins along a demonstration, a start of the region, or of its leg.
        joints: (6,) joint angles [rad].
        limit: steps after which it is truncated.
        exploring: whether it is a short episode for exploring.
    """

    pose: Array
    start: Array
    joints: Array
    limit: int
    exploring: bool


@dataclass(frozen=True)
class StartSampler:
    """Draws starts of episodes: in and around the task's start region, or along a demonstration.

    Exploring episodes end after a few steps. Those along the demonstrations show the agent the whole tube from the
    first moment, and its surroundings, where its own mistakes will take it. Those in and around the start region show
    its corners, and the way from farther out.

    Attributes:
        workcell: gives the start region; unreachable draws are refused.
        frame: the start frame of the demonstrations.
        trajectories: demonstrated poses (N, 7) at the agent's step, in that frame.
        step_limit: of all but exploring episodes.
        agent: how it explores; None for no exploring.
    """

    workcell: Workcell
    frame: StartFrame
    trajectories: list[Array]
    step_limit: int
    agent: Agent | None = None

    def draw(self, rng: np.random.Generator) -> EpisodeStart:
        """Return the start of the next episode."""
        agent, drawn = self.agent, rng.random()
        if agent is None or drawn >= agent.exploring_starts:
            pose, joints = self._around_region(rng)
            return EpisodeStart(pose, pose, joints, self.step_limit, False)
        if rng.random() >= agent.exploring_in_region:
            return self._along_demonstration(rng, agent)
        pose, joints = self._around_region(rng)
        return EpisodeStart(pose, pose, joints, agent.exploring_steps, True)

    def _around_region(self, rng: np.random.Generator) -> tuple[Array, Array]:
        largest = 1.0 if self.agent is None else self.agent.exploring_scale
        for left in reversed(range(_MOST_REGIONS)):
            # Scales uniform in volume; otherwise draws would crowd the middle.
            scale = (1.0 + (largest**3 - 1.0) * float(rng.random())) ** (1 / 3)
            region = self.workcell.task.with_starts_scaled(scale)
            try:
                poses, joints, _ = self.workcell.reachability.draw_starts(region, rng, 1)
            except BadInputError:
                # A narrower region may hold more reachable starts.
                if not left:
                    raise
                continue
            break
        return poses[0], joints[0]

    def _along_demonstration(self, rng: np.random.Generator, agent: Agent) -> EpisodeStart:
        task, reachability = self.workcell.task, self.workcell.reachability
        for _ in range(_MOST_DRAWS):
            which = int(rng.integers(len(self.trajectories)))
            index = int(rng.integers(len(self.trajectories[which])))
            pose = self.trajectories[which][index].copy()
            pose[:3] += rng.normal(scale=agent.exploring_spread_m, size=3)
            if task.orientation == "learned":
                # Where an agent can turn anywhere, so can its mistakes.
                aside = task.turns_in_full or agent.continuous
                pose[3:] = _turned(pose[3:], task, agent.exploring_spread_rad, rng, aside=aside)
            start, begun = task.draw_starts(rng, 1)[0], self._begun[which]
            if begun is not None and (begun[index] != begun[0]).any():
                start = begun[index]
            pose = self.frame.from_frame(pose[None], start[None], pose[None])[0]
            motion = reachability.enter(pose)
            if motion.joints is not None and not task.arrived(pose[None], start[None])[0]:
                return EpisodeStart(pose, start, motion.joints, agent.exploring_steps, True)
        raise WorkFailedError(
            f"task {task.name}: the arm must be able to begin along the demonstrations,"
            f" found {_MOST_DRAWS} draws in a row refused"
        )

    @cached_property
    def _begun(self) -> list[Array | None]:
        """The starts (N, 7) that count at the poses of each demonstration; None where the path has no legs."""
        task = self.workcell.task
        if not task.unfolds:
            return [None] * len(self.trajectories)
        return [task.begun(self.frame.from_frame(rows, rows[:1], rows), hindsight=True) for rows in self.trajectories]


def _turned(quaternion: Array, task: Task, spread: float, rng: np.random.Generator, *, aside: bool) -> Array:
    """Return a quaternion (4,) turned at random, by ``spread`` [rad]: ahead of the position, behind it, or aside."""
    if aside:
        return multiply(quaternion, from_rotation_vector(rng.normal(scale=spread, size=3)))
    return turned_toward(quaternion, task.goal[3:], rng.normal(scale=spread))
