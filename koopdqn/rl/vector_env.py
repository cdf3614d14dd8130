"""Episodes that run side by side: where each arm is, what it has tried there, and how it moves on."""

from dataclasses import dataclass, field

import numpy as np

from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.pose import Array, turned_toward
from koopdqn.tasks.actions import COUNT
from koopdqn.tasks.reachability import Motion, Reachability
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.task import Task

_MOST_DRAWS = 1000
_MOST_REGIONS = 20


@dataclass
class EpisodeBatch:
    """The state of N episodes, as arrays over episodes.

    Attributes:
        poses: (N, 7) flange poses.
        starts: (N, 7) where they began, or would have begun to be here now.
        joints: (N, 6) joint angles [rad].
        steps: (N,) steps made.
        limits: (N,) steps after which each is truncated.
        numbers: (N,) which episode each is, counted from 0 over the whole run.
        rewards: (N,) reward gathered.
        tried: (N, 10) wrong actions already tried from the present pose.
        stored: (N, 10) actions from the present pose whose experience is stored already.
        exploring: (N,) whether it is a short episode for exploring.
    """

    poses: Array
    starts: Array
    joints: Array
    steps: np.ndarray
    limits: np.ndarray
    numbers: np.ndarray
    rewards: Array
    tried: np.ndarray
    stored: np.ndarray
    exploring: np.ndarray

    @classmethod
    def empty(cls, count: int) -> "EpisodeBatch":
        """Return room for ``count`` episodes that have not begun."""
        return cls(
            poses=np.zeros((count, 7)),
            starts=np.zeros((count, 7)),
            joints=np.zeros((count, 6)),
            steps=np.zeros(count, dtype=np.int64),
            limits=np.zeros(count, dtype=np.int64),
            numbers=np.zeros(count, dtype=np.int64),
            rewards=np.zeros(count),
            tried=np.zeros((count, COUNT), dtype=bool),
            stored=np.zeros((count, COUNT), dtype=bool),
            exploring=np.zeros(count, dtype=bool),
        )

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.poses)

    def move(self, index: int, pose: Array, joints: Array) -> None:
        """Take episode ``index`` to a pose (7,) with joints (6,)."""
        self.poses[index] = pose
        self.joints[index] = joints
        self.steps[index] += 1
        self.tried[index] = False
        self.stored[index] = False

    def reopen(self, here: np.ndarray, action: int) -> None:
        """Let those of N episodes that are ``here`` (N,) try an action anew."""
        self.tried[here, action] = False
        self.stored[here, action] = False

    def state(self) -> dict[str, np.ndarray]:
        """Return everything held, as arrays."""
        return {name: getattr(self, name).copy() for name in self.__dataclass_fields__}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Hold what :meth:`state` returned."""
        for name in self.__dataclass_fields__:
            getattr(self, name)[...] = state[name]


@dataclass
class StartSampler:
    """Draws where episodes begin: in and around the task's start region, or somewhere along a demonstration.

    Some episodes are exploring ones, cut after a few steps. Beginning along the demonstrations shows the
    agent the whole tube from the first moment, and what to do a little beside the path, where its own
    mistakes will take it; beginning often in and around the start region shows it that region's corners, and the way
    from farther out.

    Attributes:
        task: gives the start region.
        reachability: refuses what the arm cannot take.
        frame: in which demonstrations are told.
        trajectories: demonstrated poses (N, 7) at the agent's step, placed there.
        share: share of exploring starts.
        region_share: share of the exploring starts that lie in and around the start region, as all others do.
        region_scale: how many times wider than the start region those may lie.
        spread: standard deviation of the other starts' offset from a demonstration [m].
        spread_rad: of how far their turn toward the goal's orientation is ahead [rad].
        exploring_steps: step limit of exploring episodes.
        step_limit: step limit of the others.
        refused: how many draws were drawn again.
    """

    task: Task
    reachability: Reachability
    frame: StartFrame
    trajectories: list[Array]
    share: float
    region_share: float
    region_scale: float
    spread: float
    spread_rad: float
    exploring_steps: int
    step_limit: int
    refused: int = field(default=0)

    def begin(self, batch: EpisodeBatch, index: int, number: int, rng: np.random.Generator) -> None:
        """Begin episode ``number`` at ``index`` of a batch."""
        batch.exploring[index] = rng.random() < self.share
        if batch.exploring[index] and rng.random() >= self.region_share:
            pose, start, motion = self._along_demonstration(rng)
        else:
            pose, motion = self._around_region(rng)
            start = pose
        assert motion.joints is not None  # both ways draw until the arm can
        batch.poses[index], batch.starts[index], batch.joints[index] = pose, start, motion.joints
        batch.steps[index] = 0
        batch.limits[index] = self.exploring_steps if batch.exploring[index] else self.step_limit
        batch.numbers[index] = number
        batch.rewards[index] = 0.0
        batch.tried[index] = False
        batch.stored[index] = False

    def _around_region(self, rng: np.random.Generator) -> tuple[Array, Motion]:
        left = _MOST_REGIONS
        while True:
            # Regions evenly spread over their volumes: far corners are many, and draws crowd the middle all the same.
            scale = (1.0 + (self.region_scale**3 - 1.0) * float(rng.random())) ** (1 / 3)
            region = self.task.with_starts_scaled(scale)
            left -= 1
            try:
                poses, joints, refused = self.reachability.draw_starts(region, rng, 1)
            except BadInputError:
                # Far out there may be little that the arm can take, and more in a narrower region.
                if not left:
                    raise
                continue
            self.refused += refused
            return poses[0], Motion(joints[0])

    def _along_demonstration(self, rng: np.random.Generator) -> tuple[Array, Array, Motion]:
        for _ in range(_MOST_DRAWS):
            trajectory = self.trajectories[rng.integers(len(self.trajectories))]
            index = rng.integers(len(trajectory))
            pose = trajectory[index].copy()
            pose[:3] += rng.normal(scale=self.spread, size=3)
            if self.task.orientation == "learned":
                # A turn that runs ahead of the position or behind it.
                ahead = rng.normal(scale=self.spread_rad)
                pose[3:] = turned_toward(pose[3:], self.task.goal[3:], ahead)
            start = self.task.draw_starts(rng, 1)[0]
            pose = self.frame.unplaced(pose[None], start[None], pose[None])[0]
            motion = self.reachability.enter(pose)
            if motion.joints is not None and not self.task.reached(pose[None])[0]:
                return pose, start, motion
            self.refused += 1
        raise WorkFailedError(
            f"task {self.task.name}: the arm must be able to begin along the demonstrations,"
            f" found {_MOST_DRAWS} draws in a row refused"
        )
