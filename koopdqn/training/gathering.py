"""Questions gathered while an episode runs, and put to the oracle one after another when it has ended."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from koopdqn.dqn.observation import observe
from koopdqn.environment.reward import IntentReward, Judgement
from koopdqn.feedback.oracle import Place, Question
from koopdqn.pose import Array
from koopdqn.training.experience import Trial, Tries
from koopdqn.training.feedback import Feedback


@dataclass(frozen=True)
class Asking:
    """When questions are put to the oracle.

    Attributes:
        when: where they arise, or together at the end of their episode.
        most: questions gathered in an episode, which ends at so many.
    """

    when: Literal["at_once", "episode"] = "at_once"
    most: int = 10


class Ask(Protocol):
    """Asks about a trial and keeps the answer in its row of a judgement; returns whether there was an answer."""

    def __call__(self, trial: Trial, judgement: Judgement, row: int, place: Place | None = None) -> bool:
        """Ask."""


class Gathering:
    """What N episodes that run side by side have gathered and not asked yet.

    An episode goes on by an action whose worth is not known as if it had been right. Where a yes to an earlier
    question of the episode would extend the trust domain to, its actions are gathered too but are no questions more.
    """

    def __init__(self, asking: Asking, feedback: Feedback, count: int) -> None:
        """Begin with nothing for each of ``count`` episodes, judged by what ``feedback`` knows."""
        self._asking = asking
        self._feedback = feedback
        self._trials: list[list[Trial]] = [[] for _ in range(count)]
        self._questions: list[list[Array]] = [[] for _ in range(count)]

    @property
    def on(self) -> bool:
        """Whether questions are gathered now: with the budget spent there is no person to spare."""
        return self._asking.when == "episode" and not self._feedback.spent

    def add(self, index: int, trial: Trial) -> bool:
        """Gather a trial of episode ``index`` of the batch; return whether that was its last question."""
        self._trials[index].append(trial)
        questions = self._questions[index]
        here = _placed([trial], self._feedback)[0]
        if not self._feedback.covers(_poses(questions), here, trial.step):
            questions.append(here)
        return len(questions) >= self._asking.most

    def take(self, index: int) -> list[Trial]:
        """Return what was gathered in episode ``index`` of the batch, oldest first, and hold it no more."""
        taken, self._trials[index], self._questions[index] = self._trials[index], [], []
        return taken

    def state(self) -> dict[str, np.ndarray]:
        """Return everything held, as arrays over questions."""
        held = [(index, trial) for index, trials in enumerate(self._trials) for trial in trials]
        return {
            "rows": np.array([index for index, _ in held], dtype=np.int64),
            "episodes": np.array([trial.episode for _, trial in held], dtype=np.int64),
            "steps": np.array([trial.step for _, trial in held], dtype=np.int64),
            "poses": _poses([trial.pose for _, trial in held]),
            "starts": _poses([trial.start for _, trial in held]),
            "actions": np.array([trial.action for _, trial in held], dtype=np.int64),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Hold what :meth:`state` returned."""
        for index in range(len(self._trials)):
            self.take(index)
        columns = (state[name].tolist() for name in ("rows", "episodes", "steps", "actions"))
        places = state["poses"], state["starts"]
        for index, episode, step, action, pose, start in zip(*columns, *places, strict=True):
            self.add(index, Trial(episode, step, pose.copy(), start.copy(), action))


def question_about(
    trial: Trial, reward: IntentReward, judgement: Judgement, row: int, place: Place | None = None
) -> Question:
    """Return the question whether a trial was right.

    Args:
        trial: what is asked about.
        reward: says why it must be asked.
        judgement: what is known of the actions from the trial's pose, in its ``row``.
        row: of the judgement.
        place: where the question stands among those of its episode; None if it is asked at once.
    """
    placed, trust = judgement.placed_reached[row, trial.action], reward.trust
    return Question(
        episode=trial.episode,
        step=trial.step,
        pose=trial.pose,
        start=trial.start,
        action=trial.action,
        reached=judgement.reached[row, trial.action].copy(),
        predicted=judgement.predicted[row].copy(),
        reason=trust.outside(placed, trial.step + 1) or trust.outside(judgement.placed[row], trial.step),
        candidates=judgement.reached[row].copy(),
        place=place,
    )


def settled(trials: list[Trial], feedback: Feedback, ask: Ask, limit: int) -> Iterator[Tries]:
    """Ask about an episode's trials in their order, and yield the experience of each as soon as its worth is known.

    What an earlier answer settles already is not asked. After a wrong action, whoever says so, the rest is left out
    where wrong actions are stepped back from: only that action led there.

    Args:
        trials: of one episode, oldest first.
        feedback: says what is known.
        ask: puts a question to the oracle.
        limit: steps after which the episode is cut.

    Raises:
        PauseRequested: who answers wants to go on another time.
    """
    if not trials:
        return
    asked, first = 0, 0
    judgement, changes = _judged(trials, feedback), feedback.changes
    for place, trial in enumerate(trials):
        if feedback.changes > changes:
            judgement, changes, first = _judged(trials[place:], feedback), feedback.changes, place
        row = place - first
        if not judgement.known[row, trial.action]:
            asked += 1
            more = _questions(trials[place:], judgement.known[row:], feedback) - 1
            if not ask(trial, judgement, row, Place(asked, asked + more)):
                continue
        wrong_and_back = bool(judgement.reward[row, trial.action] < 0) and feedback.step_back
        cut = not wrong_and_back and not judgement.at_goal[row, trial.action] and trial.step + 1 >= limit
        observation = observe(judgement.placed[row, None], feedback.reward.task)[0]
        yield Tries.of_one(trial, judgement, row, observation, cut=bool(cut))
        if wrong_and_back:
            return


def _judged(trials: list[Trial], feedback: Feedback) -> Judgement:
    steps = np.array([trial.step for trial in trials], dtype=np.int64)
    poses, starts = _poses([trial.pose for trial in trials]), _poses([trial.start for trial in trials])
    return feedback.judge(poses, steps, starts)


def _questions(trials: list[Trial], known: np.ndarray, feedback: Feedback) -> int:
    """Return how many of the trials will be asked about if all answers are yes, given what is known (N, 10)."""
    questions: list[Array] = []
    for row, (trial, here) in enumerate(zip(trials, _placed(trials, feedback), strict=True)):
        if not known[row, trial.action] and not feedback.covers(_poses(questions), here, trial.step):
            questions.append(here)
    return len(questions)


def _placed(trials: list[Trial], feedback: Feedback) -> Array:
    poses, starts = _poses([trial.pose for trial in trials]), _poses([trial.start for trial in trials])
    return feedback.reward.model.start_frame.placed(poses, starts)


def _poses(poses: list[Array]) -> Array:
    return np.array(poses).reshape(-1, 7)
