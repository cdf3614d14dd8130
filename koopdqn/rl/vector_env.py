"""The environment of Algorithm 1: parallel episodes, in each of which one action at a time is tried."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from koopdqn.intent.reward import RULE, ActionEvaluation
from koopdqn.oracles.base import Asking, Question
from koopdqn.pose import Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.network import observe
from koopdqn.rl.questions import OpenAttempt, PutOffQuestions, answered, question_about
from koopdqn.rl.replay_buffer import Labelled
from koopdqn.rl.starts import EpisodeStart, StartSampler
from koopdqn.tasks.actions import COUNT, FIRST_TWIST
from koopdqn.tasks.workcell import Motion, Workcell

# Poses that differ by less [m, or in a quaternion's entries] are the same.
_SAME = 1e-12


class Episodes:
    """The state of N episodes, as arrays over episodes.

    Attributes:
        poses: (N, 7) flange poses.
        starts: (N, 7) of the episodes, as :class:`EpisodeStart` gives them, or of their legs
            (:meth:`koopdqn.tasks.task.Task.onward`).
        joints: (N, n) joint angles [rad].
        steps: (N,) steps made.
        limits: (N,) steps after which each is truncated.
        numbers: (N,) number of each episode in the run, from 0.
        rewards: (N,) sum of the rewards so far.
        tried: (N, A) wrong actions tried at the present pose.
        stored: (N, A) actions at the present pose whose transitions are stored.
        exploring: (N,) whether it is a short exploring episode.
    """

    def __init__(self, count: int, joints: int, actions: int = COUNT) -> None:
        """Make ``count`` episodes of an arm with ``joints`` joints that have not begun, with that many actions."""
        self.poses: Array = np.zeros((count, 7))
        self.starts: Array = np.zeros((count, 7))
        self.joints: Array = np.zeros((count, joints))
        self.steps: np.ndarray = np.zeros(count, dtype=np.int64)
        self.limits: np.ndarray = np.zeros(count, dtype=np.int64)
        self.numbers: np.ndarray = np.zeros(count, dtype=np.int64)
        self.rewards: Array = np.zeros(count)
        self.tried: np.ndarray = np.zeros((count, actions), dtype=bool)
        self.stored: np.ndarray = np.zeros((count, actions), dtype=bool)
        self.exploring: np.ndarray = np.zeros(count, dtype=bool)

    def __len__(self) -> int:
        """Return the number of episodes."""
        return len(self.poses)

    def begin(self, index: int, number: int, beginning: EpisodeStart) -> None:
        """Begin episode ``number`` of the run at ``index``."""
        self.poses[index], self.starts[index] = beginning.pose, beginning.start
        self.joints[index] = beginning.joints
        self.steps[index] = 0
        self.limits[index] = beginning.limit
        self.numbers[index] = number
        self.rewards[index] = 0.0
        self.tried[index] = False
        self.stored[index] = False
        self.exploring[index] = beginning.exploring

    def move(self, index: int, pose: Array, joints: Array) -> None:
        """Move episode ``index`` to a pose (7,) with joints (n,)."""
        self.poses[index] = pose
        self.joints[index] = joints
        self.steps[index] += 1
        self.tried[index] = False
        self.stored[index] = False

    def reopen(self, here: np.ndarray, action: int) -> None:
        """Let the episodes of a mask (N,) try an action again."""
        self.tried[here, action] = False
        self.stored[here, action] = False

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as arrays."""
        return {name: values.copy() for name, values in vars(self).items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`state` returned."""
        for name, values in vars(self).items():
            values[...] = state[name]


@dataclass(frozen=True)
class Attempt:
    """The result of an attempted action.

    Attributes:
        reward: its reward; None if the question was skipped or put off.
        asked: whether the oracle was asked.
        new: whether its transition is to be stored: it has a reward and is not stored yet.
        at_goal: whether it reached the goal, which ends the episode.
        truncated: whether the episode ends at its step limit, or at its most questions put off.
    """

    reward: float | None
    asked: bool = False
    new: bool = False
    at_goal: bool = False
    truncated: bool = False

    @property
    def ended(self) -> bool:
        """Whether the episode is over."""
        return self.at_goal or self.truncated


class VectorEnv:
    """N parallel episodes of a task: a right action moves the arm, a wrong one is undone.

    Attributes:
        workcell: task, arm and scene.
        feedback: the reward function, extended by answers.
        episodes: the state of the episodes.
        put_off: questions put off to the end of their episodes.
        begun: number of episodes begun so far.
    """

    def __init__(
        self,
        workcell: Workcell,
        feedback: Feedback,
        starts: StartSampler,
        count: int,
        rng: np.random.Generator,
        asking: Asking = Asking(),  # noqa: B008 (frozen)
        twists: int = 0,
    ) -> None:
        """Begin ``count`` episodes at starts drawn with ``rng``.

        Where actions are continuous, ``twists`` of them are given to :meth:`evaluate_actions` in each.
        """
        self.workcell = workcell
        self.feedback = feedback
        actions = FIRST_TWIST + twists if feedback.reward.continuous else COUNT
        self.episodes = Episodes(count, len(workcell.arm.joint_names), actions)
        self.put_off = PutOffQuestions(asking, feedback, count)
        self.begun = 0
        self._starts = starts
        self._rng = rng
        for index in range(count):
            self.begin(index)

    def begin(self, index: int) -> None:
        """Begin another episode at ``index``."""
        self.episodes.begin(index, self.begun, self._starts.draw(self._rng))
        self.begun += 1

    def observations(self) -> NDArray[np.float32]:
        """Return the agent's observations (N, 5 or 8) at the poses of the episodes."""
        frame = self.feedback.reward.model.start_frame
        return observe(frame.to_frame(self.episodes.poses, self.episodes.starts), self.workcell.task)

    def evaluate_actions(self, rows: np.ndarray | None = None, twists: Array | None = None) -> ActionEvaluation:
        """Return the evaluation of all actions at the poses of the episodes, or of those whose indices are ``rows``.

        ``twists`` (N, S, 3 or 6) are evaluated too, S at each pose.
        """
        here, each = self.episodes, slice(None) if rows is None else rows
        poses, steps, starts = (held[each].copy() for held in (here.poses, here.steps, here.starts))
        return self.feedback.evaluate_actions(poses, steps, starts, twists)

    def try_action(
        self, index: int, action: int, evaluation: ActionEvaluation, motion: Motion | None, *, ask: bool = False
    ) -> Attempt:
        """Try an action in an episode.

        An action that the arm cannot carry out is wrong. If the reward is not known, or with ``ask`` even if it is, the
        oracle is asked. The evaluation takes the attempt's label; the arm's motion is None if not computed yet.

        Raises:
            PauseRequested: whoever answers pauses the run.
        """
        episodes = self.episodes
        motion = motion or self.workcell.reachability.move(evaluation.reached[index, action], episodes.joints[index])
        asked = False
        if motion.joints is None:
            self.forbid(index, action, evaluation)
        elif ask or not evaluation.known[index, action]:
            if self.put_off.on:
                return self._put_off(index, action, evaluation, motion.joints)
            attempt = self._open_attempt(index, action)
            if not self.ask(question_about(attempt, self.feedback.reward, evaluation, index), evaluation, index):
                episodes.tried[index, action] = True
                return Attempt(None, asked=True)
            asked = True
            # A reward of the model may be stored already, or have been removed since; the answer is stored in addition.
            episodes.stored[index, action] = False
        reward = float(evaluation.reward[index, action])
        moves = motion.joints is not None and (reward >= 0 or not self.feedback.step_back)
        at_goal = moves and bool(evaluation.at_goal[index, action])
        truncated = moves and not at_goal and bool(episodes.steps[index] + 1 >= episodes.limits[index])
        new = not episodes.stored[index, action]
        episodes.stored[index, action] = True
        episodes.rewards[index] += reward
        if moves and motion.joints is not None:
            self._move(index, evaluation.reached[index, action], motion.joints)
        else:
            episodes.tried[index, action] = True
        return Attempt(reward, asked, new, at_goal, truncated)

    def forbid(self, index: int, action: int, evaluation: ActionEvaluation) -> None:
        """Label an action of an episode as wrong by rule."""
        evaluation.set_label(index, action, self.feedback.reward.value(False, False), RULE)

    def ask(self, question: Question, evaluation: ActionEvaluation, row: int) -> bool:
        """Ask and label the action in a row of an evaluation; return whether there was an answer (a skip is none)."""
        outcome = self.feedback.ask(question, evaluation, row)
        local = self.feedback.reward.model.start_frame.to_frame(self.episodes.poses, self.episodes.starts)
        for point, action in outcome.reopened:
            # Up to rounding, since local poses are computed anew.
            self.episodes.reopen(np.abs(local - point).max(axis=1) < _SAME, action)
        return outcome.right is not None

    def answer_put_off(self, index: int) -> Iterator[Labelled]:
        """Ask an episode's questions put off, and yield each attempt as soon as it is labelled.

        Raises:
            PauseRequested: whoever answers pauses the run.
        """
        for labelled in answered(self.put_off.take(index), self.feedback, self.ask, int(self.episodes.limits[index])):
            self.episodes.rewards[index] += float(labelled.rewards[0])
            yield labelled

    def _put_off(self, index: int, action: int, evaluation: ActionEvaluation, joints: Array) -> Attempt:
        """Keep a question for the end of its episode; until then its action is provisionally treated as right."""
        full = self.put_off.add(index, self._open_attempt(index, action))
        self._move(index, evaluation.reached[index, action], joints)
        at_goal = bool(evaluation.at_goal[index, action])
        return Attempt(
            None, at_goal=at_goal, truncated=full or bool(self.episodes.steps[index] >= self.episodes.limits[index])
        )

    def _move(self, index: int, pose: Array, joints: Array) -> None:
        episodes, one = self.episodes, slice(index, index + 1)
        episodes.move(index, pose, joints)
        episodes.starts[one] = self.workcell.task.onward(episodes.poses[one], episodes.starts[one])

    def _open_attempt(self, index: int, action: int) -> OpenAttempt:
        here = self.episodes
        places = here.poses[index].copy(), here.starts[index].copy()
        return OpenAttempt(int(here.numbers[index]), int(here.steps[index]), *places, action)
