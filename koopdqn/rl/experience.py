"""Experience: attempts and labels as transitions to store, and questions put off to the end of an episode."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np

from koopdqn.intent.reward import RULE, SOURCES, IntentReward, Judgement
from koopdqn.oracles.base import Place, Question
from koopdqn.pose import Array
from koopdqn.rl.history import History
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.network import observe
from koopdqn.rl.replay_buffer import Transitions
from koopdqn.tasks.actions import within_tolerance
from koopdqn.tasks.task import Task, demonstrator_wishes


@dataclass(frozen=True)
class Trial:
    """An action that is tried in an episode.

    Attributes:
        episode: number of the episode.
        step: steps made in it before.
        pose: (7,) before the action.
        start: (7,) where the episode began.
        action: index in Table 1.
    """

    episode: int
    step: int
    pose: Array
    start: Array
    action: int


@dataclass(frozen=True)
class Tries:
    """M actions that were tried.

    Attributes:
        judgement: what is known of all actions from the poses that they were tried from, among others.
        rows: (M,) which of its poses.
        actions: (M,) indices in Table 1.
        observations: (M, inputs) before the actions.
        poses: (M, 7) before them.
        starts: (M, 7) where their episodes began.
        steps: (M,) steps of the episode before them.
        cut: whether the episode was cut at its step limit after them.
    """

    judgement: Judgement
    rows: np.ndarray
    actions: np.ndarray
    observations: np.ndarray
    poses: Array
    starts: Array
    steps: np.ndarray
    cut: bool = False

    @classmethod
    def of_one(
        cls, trial: Trial, judgement: Judgement, row: int, observation: np.ndarray, *, cut: bool = False
    ) -> "Tries":
        """Return one trial as tries, its pose observed as (inputs,) and judged in a row."""
        each = np.array([row]), np.array([trial.action])
        places = trial.pose[None], trial.start[None]
        return cls(judgement, *each, observation[None], *places, np.array([trial.step]), cut)

    @property
    def rewards(self) -> Array:
        """Their rewards (M,)."""
        return np.asarray(self.judgement.reward[self.rows, self.actions])

    def transitions(self, task: Task, *, step_back: bool) -> Transitions:
        """Return them as transitions of a task in which wrong actions are stepped back from, or are not."""
        judgement, each = self.judgement, (self.rows, self.actions)
        wrong = self.rewards < 0
        return Transitions(
            self.observations,
            self.actions,
            self.rewards.astype(np.float32),
            observe(judgement.placed_reached[each], task),
            terminated=judgement.at_goal[each] & ~wrong,
            truncated=np.full(len(self.rows), self.cut),
            undone=wrong & step_back,
            poses=self.poses,
            starts=self.starts,
            steps=self.steps,
            sources=judgement.source[each],
            answers=judgement.answer[each],
        )

    def tally(self, history: History, task: Task) -> None:
        """Count them in a history: by where their rewards came from, and how many the demonstrator agrees with."""
        each = self.rows, self.actions
        sources = self.judgement.source[each]
        counted = sources != RULE
        if not counted.any():
            return
        # Once a state, of which there are up to ten tries.
        _, first, state = np.unique(self.rows[counted], return_index=True, return_inverse=True)
        wished = demonstrator_wishes(task, self.poses[counted][first], self.starts[counted][first])[state]
        agrees = within_tolerance(self.judgement.reached[self.rows[counted], self.actions[counted]], wished, task)
        same = agrees == (self.rewards[counted] >= 0)
        for source in range(RULE + 1, len(SOURCES)):
            history.judged[source] += int((sources == source).sum())
            history.agreed[source] += int(same[sources[counted] == source].sum())


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
