"""Starts of episodes: in and around the start region, or along a demonstration."""

from dataclasses import dataclass

import numpy as np

from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.pose import Array, turned_toward
from koopdqn.rl.settings import AgentSettings
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Reachability, Workcell

_MOST_DRAWS = 1000
_MOST_REGIONS = 20


@dataclass(frozen=True)
class EpisodeStart:
    """The start of an episode.

    Attributes:
        pose: (7,) of the flange.
        start: (7,) where it began; for one that begins along a demonstration, a start of the region.
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
        task: gives the start region.
        reachability: of the arm; unreachable draws are refused.
        frame: the start frame of the demonstrations.
        trajectories: demonstrated poses (N, 7) at the agent's step, in that frame.
        share: share of exploring episodes.
        region_share: share of those that begin in and around the start region, as all others do.
        region_scale: largest scale of the start region.
        spread: standard deviation of the offset from a demonstration [m].
        spread_rad: standard deviation of the turn ahead toward the goal's orientation [rad].
        exploring_steps: step limit of exploring episodes.
        step_limit: step limit of the others.
    """

    task: Task
    reachability: Reachability
    frame: StartFrame
    trajectories: list[Array]
    share: float = 0.0
    region_share: float = 0.0
    region_scale: float = 1.0
    spread: float = 0.0
    spread_rad: float = 0.0
    exploring_steps: int = 1
    step_limit: int = 1

    @classmethod
    def of_agent(
        cls, workcell: Workcell, frame: StartFrame, trajectories: list[Array], agent: AgentSettings, step_limit: int
    ) -> "StartSampler":
        """Return the sampler with an agent's settings."""
        return cls(
            workcell.task,
            workcell.reachability,
            frame,
            trajectories,
            agent.exploring_starts,
            agent.exploring_in_region,
            agent.exploring_scale,
            agent.exploring_spread_m,
            agent.exploring_spread_rad,
            agent.exploring_steps,
            step_limit,
        )

    def draw(self, rng: np.random.Generator) -> EpisodeStart:
        """Return the start of the next episode."""
        exploring = rng.random() < self.share
        if exploring and rng.random() >= self.region_share:
            return self._along_demonstration(rng)
        pose, joints = self._around_region(rng)
        return EpisodeStart(pose, pose, joints, self.exploring_steps if exploring else self.step_limit, exploring)

    def _around_region(self, rng: np.random.Generator) -> tuple[Array, Array]:
        left = _MOST_REGIONS
        while True:
            # Scales uniform in volume; otherwise draws would crowd the middle.
            scale = (1.0 + (self.region_scale**3 - 1.0) * float(rng.random())) ** (1 / 3)
            region = self.task.with_starts_scaled(scale)
            left -= 1
            try:
                poses, joints, _ = self.reachability.draw_starts(region, rng, 1)
            except BadInputError:
                # A narrower region may hold more reachable starts.
                if not left:
                    raise
                continue
            return poses[0], joints[0]

    def _along_demonstration(self, rng: np.random.Generator) -> EpisodeStart:
        for _ in range(_MOST_DRAWS):
            trajectory = self.trajectories[rng.integers(len(self.trajectories))]
            index = rng.integers(len(trajectory))
            pose = trajectory[index].copy()
            pose[:3] += rng.normal(scale=self.spread, size=3)
            if self.task.orientation == "learned":
                # The turn may be ahead of the position or behind it.
                ahead = rng.normal(scale=self.spread_rad)
                pose[3:] = turned_toward(pose[3:], self.task.goal[3:], ahead)
            start = self.task.draw_starts(rng, 1)[0]
            pose = self.frame.from_frame(pose[None], start[None], pose[None])[0]
            motion = self.reachability.enter(pose)
            if motion.joints is not None and not self.task.reached(pose[None])[0]:
                return EpisodeStart(pose, start, motion.joints, self.exploring_steps, True)
        raise WorkFailedError(
            f"task {self.task.name}: the arm must be able to begin along the demonstrations,"
            f" found {_MOST_DRAWS} draws in a row refused"
        )
