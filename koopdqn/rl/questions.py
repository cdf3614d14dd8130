"""Questions about attempts, and those put off to the end of their episode."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from koopdqn import pose
from koopdqn.intent.reward import CERTIFIED, ActionEvaluation, IntentReward
from koopdqn.oracles.base import Asking, Place, Question
from koopdqn.pose import Array
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.replay_buffer import Labelled
from koopdqn.tasks.actions import COUNT, FIRST_TWIST, legal_actions
from koopdqn.tasks.task import Task

# Below this [m, rad] an action does nothing.
_NOTHING = 1e-6


@dataclass(frozen=True)
class OpenAttempt:
    """An attempted action without a label.

    Attributes:
        episode: number of the episode.
        step: steps made before in the episode.
        pose: (7,) before the action.
        start: (7,) where the episode began, or its leg.
        action: its index.
    """

    episode: int
    step: int
    pose: Array
    start: Array
    action: int


Ask = Callable[[Question, ActionEvaluation, int], bool]
"""Asks a question, labels the action in a row of an evaluation with the answer, and returns whether there was one."""


class PutOffQuestions:
    """The attempts of N parallel episodes whose questions are put off.

    An attempt that a yes to an earlier question of its episode would certify is kept, but not counted as a question.
    """

    def __init__(self, asking: Asking, feedback: Feedback, count: int) -> None:
        """Begin without attempts for each of ``count`` episodes."""
        self._asking = asking
        self._feedback = feedback
        self._attempts: list[list[OpenAttempt]] = [[] for _ in range(count)]
        self._questions: list[list[Array]] = [[] for _ in range(count)]

    @property
    def on(self) -> bool:
        """Whether questions are put off; with the budget spent they are not."""
        return self._asking.ask == "episode" and not self._feedback.spent

    def add(self, index: int, attempt: OpenAttempt) -> bool:
        """Keep an attempt of episode ``index``; return whether the episode has its most questions."""
        self._attempts[index].append(attempt)
        questions = self._questions[index]
        here = _placed([attempt], self._feedback)[0]
        if not self._feedback.extension_contains(_poses(questions), here, attempt.step):
            questions.append(here)
        return len(questions) >= self._asking.gather_most

    def take(self, index: int) -> list[OpenAttempt]:
        """Return and remove the attempts of episode ``index``, oldest first."""
        taken, self._attempts[index], self._questions[index] = self._attempts[index], [], []
        return taken

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as arrays over attempts."""
        held = [(index, attempt) for index, attempts in enumerate(self._attempts) for attempt in attempts]
        return {
            "rows": np.array([index for index, _ in held], dtype=np.int64),
            "episodes": np.array([attempt.episode for _, attempt in held], dtype=np.int64),
            "steps": np.array([attempt.step for _, attempt in held], dtype=np.int64),
            "poses": _poses([attempt.pose for _, attempt in held]),
            "starts": _poses([attempt.start for _, attempt in held]),
            "actions": np.array([attempt.action for _, attempt in held], dtype=np.int64),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`state` returned."""
        for index in range(len(self._attempts)):
            self.take(index)
        columns = (state[name].tolist() for name in ("rows", "episodes", "steps", "actions"))
        places = state["poses"], state["starts"]
        for index, episode, step, action, here, start in zip(*columns, *places, strict=True):
            self.add(index, OpenAttempt(episode, step, here.copy(), start.copy(), action))


def question_about(
    attempt: OpenAttempt, reward: IntentReward, evaluation: ActionEvaluation, row: int, place: Place | None = None
) -> Question:
    """Return the question whether an attempt was right, whose pose stands in a row of an evaluation.

    The reward function gives the reason for asking. The question has a place among those of its episode unless it is
    asked at once.
    """
    local, trust = evaluation.local_reached[row, attempt.action], reward.trust
    certified = evaluation.source[row, attempt.action] == CERTIFIED
    unsure = "answers nearby leave no other action" if certified else "the prediction is too near the tolerance"
    candidates = evaluation.reached[row, :FIRST_TWIST].copy()
    return Question(
        episode=attempt.episode,
        step=attempt.step,
        pose=attempt.pose,
        start=attempt.start,
        action=attempt.action,
        reached=evaluation.reached[row, attempt.action].copy(),
        predicted=evaluation.predicted[row].copy(),
        reason=trust.outside(local, attempt.step + 1) or trust.outside(evaluation.local[row], attempt.step) or unsure,
        candidates=candidates,
        choosable=_choosable(candidates, attempt.pose, reward.task),
        place=place,
    )


def _choosable(candidates: Array, here: Array, task: Task) -> np.ndarray:
    """Return which named actions (A,), that reach ``candidates`` (A, 7), the task allows and do something."""
    allowed = np.append(legal_actions(task), np.ones(len(candidates) - COUNT, dtype=bool))
    moved = pose.position_distance(candidates, here) > _NOTHING
    return np.asarray(allowed & (moved | (pose.rotation_distance(candidates, here) > _NOTHING)))


def answered(attempts: list[OpenAttempt], feedback: Feedback, ask: Ask, limit: int) -> Iterator[Labelled]:
    """Ask about an episode's attempts in order, and yield each as soon as it is labelled.

    Attempts that an earlier answer has labelled are not asked about. Where wrong actions are undone, attempts after a
    wrong one are dropped, since only it led there. After ``limit`` steps the episode is truncated.

    Raises:
        PauseRequested: whoever answers pauses the run.
    """
    if not attempts:
        return
    asked, first = 0, 0
    evaluation, changes = _evaluated(attempts, feedback), feedback.changes
    for place, attempt in enumerate(attempts):
        if feedback.changes > changes:
            evaluation, changes, first = _evaluated(attempts[place:], feedback), feedback.changes, place
        row = place - first
        if not evaluation.known[row, attempt.action]:
            asked += 1
            more = _count(attempts[place:], evaluation.known[row:], feedback) - 1
            question = question_about(attempt, feedback.reward, evaluation, row, Place(asked, asked + more))
            if not ask(question, evaluation, row):
                continue
        undone = bool(evaluation.reward[row, attempt.action] < 0) and feedback.step_back
        truncated = not undone and not evaluation.at_goal[row, attempt.action] and attempt.step + 1 >= limit
        yield Labelled.one(evaluation, row, attempt.action, truncated=bool(truncated))
        if undone:
            return


def _evaluated(attempts: list[OpenAttempt], feedback: Feedback) -> ActionEvaluation:
    steps = np.array([attempt.step for attempt in attempts], dtype=np.int64)
    poses, starts = (_poses([getattr(attempt, name) for attempt in attempts]) for name in ("pose", "start"))
    return feedback.evaluate_actions(poses, steps, starts)


def _count(attempts: list[OpenAttempt], known: np.ndarray, feedback: Feedback) -> int:
    """Return how many attempts will be asked about if all answers are yes, given ``known`` (N, 10)."""
    questions: list[Array] = []
    for row, (attempt, here) in enumerate(zip(attempts, _placed(attempts, feedback), strict=True)):
        if not known[row, attempt.action] and not feedback.extension_contains(_poses(questions), here, attempt.step):
            questions.append(here)
    return len(questions)


def _placed(attempts: list[OpenAttempt], feedback: Feedback) -> Array:
    poses, starts = (_poses([getattr(attempt, name) for attempt in attempts]) for name in ("pose", "start"))
    return feedback.reward.model.start_frame.to_frame(poses, starts)


def _poses(poses: list[Array]) -> Array:
    return np.array(poses).reshape(-1, 7)
