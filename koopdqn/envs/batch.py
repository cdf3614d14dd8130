"""Episodes that another library steps, all at once: what every face of the environment shares."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from koopdqn.intent.reward import SOURCES, IntentReward
from koopdqn.oracles.base import Asking, Oracle
from koopdqn.pose import Array
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.network import observe
from koopdqn.rl.starts import StartSampler
from koopdqn.rl.vector_env import VectorEnv
from koopdqn.tasks.actions import FIRST_TWIST, checked_indices, checked_twists, twist_size
from koopdqn.tasks.moved_goals import draw_starts, trained_in
from koopdqn.tasks.rollout import SUCCESS, roll_out
from koopdqn.tasks.workcell import Workcell

NO_REWARD: Final = len(SOURCES)
"""Stands for the source of a reward of 0 that is none: nobody answered."""
SOURCE_NAMES: Final = np.array([*SOURCES, "none"])
"""Names of the sources of rewards, by their numbers."""

ANSWERS_ALONE = FeedbackSettings(remember_m=0.0, remember_rad=0.05, extend=False, reach_m=0.07)
"""An answer is the reward of the action asked about and nothing more."""


@dataclass(frozen=True)
class EnvironmentParts:
    """What an environment consists of.

    Attributes:
        workcell: task, arm and scene.
        reward: the task's reward function.
        oracle: who answers where the intent model is not trusted.
        step_limit: actions tried after which an episode is cut.
        feedback: what is made of answers beyond the reward of the action asked about.
        asking: how many questions may be asked; one more brings reward 0 and moves nothing.
        starts: where episodes begin and how long they may be; None for anywhere in the start region, ``step_limit``.
    """

    workcell: Workcell
    reward: IntentReward
    oracle: Oracle
    step_limit: int
    feedback: FeedbackSettings = ANSWERS_ALONE
    asking: Asking = Asking()  # noqa: RUF009 (frozen)
    starts: StartSampler | None = None

    @property
    def twist(self) -> int:
        """Numbers of a twist, the action; 0 where actions are Table 1's."""
        return twist_size(self.workcell.task) if self.reward.continuous else 0

    def success_rate(
        self, choose: Callable[[NDArray[np.float32]], np.ndarray], episodes: int = 100, seed: int = 2000
    ) -> float:
        """Return the share of starts of the region from which a policy reaches the goal, with no action undone.

        So `koopdqn eval` measures its own: an action that the arm cannot carry out ends the episode as a failure.

        Args:
            choose: returns the actions (N,), or twists (N, 3) or (N, 6), for observations (N, 5) or (N, 8) of the
                environment's kind.
            episodes: how many starts are drawn.
            seed: of their drawing; an environment that is reset with it draws some of them.

        Raises:
            BadInputError: hardly any start of the region can be taken.
            ValueError: what was chosen are no such actions.
        """
        task, frame = self.workcell.task, self.reward.model.start_frame

        def chosen(poses: Array, starts: Array) -> np.ndarray:
            actions = choose(observe(frame.to_frame(poses, starts), task))
            count = len(poses)
            return checked_twists(actions, count, task) if self.twist else checked_indices(actions, count)

        drawn = draw_starts(self.workcell, task, np.random.default_rng(seed), episodes)
        made = roll_out(
            *(chosen, task, self.workcell.reachability, drawn.starts, drawn.joints, self.step_limit), moved=drawn.moved
        )
        return float(np.mean([episode.outcome == SUCCESS for episode in made]))


@dataclass(frozen=True)
class Steps:
    """What came of one action in each of N episodes; of an episode that tried none everything is 0 or false.

    Attributes:
        rewards: (N,) rewards; 0 where a question was skipped.
        terminated: (N,) whether the goal was reached.
        truncated: (N,) whether the episode was cut at its step limit.
        undone: (N,) whether the arm is where it was before: the action was wrong, or nobody answered.
        sources: (N,) where each reward comes from, a number in :data:`SOURCE_NAMES`.
    """

    rewards: Array
    terminated: np.ndarray
    truncated: np.ndarray
    undone: np.ndarray
    sources: np.ndarray


class Batch:
    """N episodes of :class:`~koopdqn.rl.vector_env.VectorEnv`, which training uses, with an action tried in each."""

    def __init__(self, parts: EnvironmentParts, count: int, rng: np.random.Generator) -> None:
        """Begin ``count`` episodes, their starts drawn from ``rng``; no answer is known."""
        workcell, reward = trained_in(parts.workcell), parts.reward
        self._task = workcell.task
        self._tries = np.zeros(count, dtype=np.int64)
        starts = parts.starts or StartSampler(workcell, reward.model.start_frame, [], parts.step_limit)
        feedback = Feedback(reward, parts.oracle, parts.feedback, parts.asking)
        self._env = VectorEnv(workcell, feedback, starts, count, rng, twists=1)

    @property
    def poses(self) -> Array:
        """The flange's present poses (N, 7)."""
        return self._env.episodes.poses.copy()

    @property
    def joints(self) -> Array:
        """The arm's present joint angles (N, 6) [rad]; where the goal moves, some that lead to the flange's pose.

        Where there are none, they are the posture's.
        """
        held = self._env.episodes.joints.copy()
        if self._task.goal_half_range_m is None:
            return held
        found = self._env.workcell.arm.inverse_batch(self._env.episodes.poses, held)
        return np.where(np.isnan(found), held, found)

    def begin(self, index: int) -> None:
        """Begin another episode at ``index``."""
        self._env.begin(index)
        self._tries[index] = 0

    def observations(self) -> NDArray[np.float32]:
        """Return the agent's observations, (N, 5) with orientation held and (N, 8) otherwise."""
        return self._env.observations()

    def step_only(self, action: Any) -> Steps:
        """Try an action in the only episode: an index in Table 1, also in an array of one, or a twist (3,) or (6,).

        Raises:
            ValueError: see :meth:`step`.
            PauseRequested: who answers wants to go on another time.
        """
        given = np.asarray(action)
        return self.step(given.reshape(1) if given.size == 1 else np.atleast_2d(given))

    def step(self, actions: np.ndarray, active: np.ndarray | None = None) -> Steps:
        """Try an action in each episode: labels, inverse kinematics and collisions of all at once.

        Args:
            actions: (N,) indices in Table 1, from 0; where actions are continuous, twists (N, 3 or 6).
            active: (N,) which episodes try theirs; None for all.

        Raises:
            ValueError: the actions are of another shape or type, one is none of the ten, or a twist is not finite.
            PauseRequested: who answers wants to go on another time.
        """
        env, count = self._env, len(self._tries)
        twists = None
        if env.feedback.reward.continuous:
            twists = checked_twists(actions, count, self._task)[:, None]
            actions = np.full(count, FIRST_TWIST)
        else:
            actions = checked_indices(actions, count)
        terminated, truncated, undone = np.zeros((3, count), dtype=bool)
        steps = Steps(np.zeros(count), terminated, truncated, undone, np.full(count, NO_REWARD))
        rows = np.arange(count) if active is None else np.flatnonzero(active)
        evaluation, changes = env.evaluate_actions(twists=twists), env.feedback.changes
        reached = evaluation.reached[rows, actions[rows]]
        motions = env.workcell.reachability.move_batch(reached, env.episodes.joints[rows])
        before = env.episodes.steps.copy()
        for place, (row, action, motion) in enumerate(zip(rows.tolist(), actions[rows].tolist(), motions, strict=True)):
            if env.feedback.changes > changes and not evaluation.known[row, action]:
                # What an answer has taught already may settle what is still to be asked; the rest stands as it was.
                left = rows[place:]
                open_rows = left[~evaluation.known[left, actions[left]]]
                again = None if twists is None else twists[open_rows]
                evaluation.renew(open_rows, env.evaluate_actions(open_rows, again))
                changes = env.feedback.changes
            attempt = env.try_action(row, action, evaluation, motion)
            if attempt.reward is not None:
                steps.rewards[row] = attempt.reward
                steps.sources[row] = evaluation.source[row, action]
            steps.terminated[row], steps.truncated[row] = attempt.at_goal, attempt.truncated
        self._tries[rows] += 1
        steps.undone[rows] = env.episodes.steps[rows] == before[rows]
        steps.truncated[rows] |= ~steps.terminated[rows] & (self._tries[rows] >= env.episodes.limits[rows])
        return steps
