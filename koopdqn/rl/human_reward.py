"""Human feedback in training: asking, remembering, and learning from answers, also when they are withdrawn."""

from dataclasses import dataclass, replace

import numpy as np

from koopdqn.intent.bend import BentIntent
from koopdqn.intent.model import IntentModel
from koopdqn.intent.reward import ASKED, BY_MODEL, NO_ANSWER, REMEMBERED, ActionEvaluation, IntentReward
from koopdqn.oracles.base import Answer, Asking, Oracle, OracleSettings, Question
from koopdqn.oracles.replay import check_answer, check_said
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.answers import FeedbackSettings, RememberedAnswers
from koopdqn.rl.replay_buffer import ReplayBuffer
from koopdqn.tasks.actions import FIRST_TWIST, excess

_TOGETHER = 1024
# Least reach of the correction by an unexpected yes, in steps.
_LEAST_REACH_STEPS = 14.0


@dataclass(frozen=True)
class Outcome:
    """The result of a question.

    Attributes:
        right: whether the action was right; None if there was no answer.
        reopened: local poses (7,) and actions to try again: their answer was withdrawn, or they were named as right.
    """

    right: bool | None
    reopened: tuple[tuple[Array, int], ...] = ()


@dataclass(frozen=True)
class PersonAround(Oracle):
    """A scripted person who would go around obstacles as the intent is bent around them.

    Attributes:
        person: answers along the path itself.
        model: the bent intent.
    """

    person: Oracle
    model: BentIntent

    def answer(self, question: Question) -> Answer:
        """Return the person's answer about the straightened motion."""
        frame, starts = self.model.start_frame, question.start[None]
        here, there = (frame.to_frame(each[None], starts) for each in (question.pose, question.reached))
        straight, following = (self.model.bend.straightened(each) for each in (here, there))
        pose_, reached = (frame.from_frame(each, starts, each)[0] for each in (straight, following))
        return self.person.answer(replace(question, pose=pose_, reached=reached))


def answering(oracle: Oracle, settings: OracleSettings, model: IntentModel) -> Oracle:
    """Return an oracle made fit for a bent intent, if it stands in for a person and knows nothing of obstacles."""
    return led_around(oracle, model) if settings.simulated else oracle


def led_around(person: Oracle, model: IntentModel) -> Oracle:
    """Return a scripted person who would go as an intent is bent, if it is."""
    return PersonAround(person, model) if isinstance(model, BentIntent) else person


class Feedback:
    """The reward function, extended by answers.

    Attributes:
        reward: the reward function, extended by the answers so far.
        answers: the remembered answers.
        questions: number of questions that reached the oracle.
        substituted: number of questions that the scripted oracle answered because the budget was spent.
        recomputed: number of recomputed rewards in the replay buffer.
        changes: number of changes of the reward function and of remembered answers.
        step_back: whether wrong actions are undone.
    """

    def __init__(
        self,
        reward: IntentReward,
        oracle: Oracle,
        settings: FeedbackSettings,
        asking: Asking = Asking(),  # noqa: B008 (frozen)
        *,
        step_back: bool = True,
        replay: ReplayBuffer | None = None,
    ) -> None:
        """Begin without answers; stored rewards in ``replay``, if given, follow those to come."""
        self.reward = reward
        self.answers = RememberedAnswers(settings)
        self.questions = 0
        self.substituted = 0
        self.recomputed = 0
        self.changes = 0
        self.step_back = step_back
        # Contradictory answers are forgotten, but may still be withdrawn.
        self._standing: list[int] = []
        self._base = reward
        self._oracle = oracle
        self._settings = settings
        self._asking = asking
        self._substitute = led_around(ScriptedOracle(reward.task), reward.model)
        self._replay = replay

    @property
    def spent(self) -> bool:
        """Whether no further question may be asked."""
        return self._asking.budget is not None and self.questions >= self._asking.budget

    @property
    def stopped(self) -> bool:
        """Whether training ends because the budget is spent."""
        return self.spent and self._asking.when_spent == "stop"

    def evaluate_actions(
        self, poses: Array, steps: np.ndarray, starts: Array | None = None, twists: Array | None = None
    ) -> ActionEvaluation:
        """Return the evaluation of :meth:`IntentReward.evaluate_actions`, with remembered answers."""
        evaluation = self.reward.evaluated(poses, steps, starts, twists)
        # What answers say matters only where something is not known anyway.
        rows = np.flatnonzero(~evaluation.known.all(axis=1))
        places = self.answers.recall(evaluation.local[rows], evaluation.margin[rows])
        recalled = (places >= 0) & ~evaluation.known[rows]
        for index, action in np.argwhere(recalled):
            row, place = rows[index], places[index, action]
            at_goal = bool(evaluation.at_goal[row, action])
            reward = self.reward.value(self.answers.right[place], at_goal)
            evaluation.set_label(row, action, reward, REMEMBERED, self.answers.numbers[place])
        return evaluation

    def contradict(self, point: Array) -> None:
        """Handle a local pose (7,) without any action left; see :meth:`RememberedAnswers.contradict`."""
        self.changes += self.answers.contradict(point)

    def hopeless_near(self, point: Array) -> bool:
        """Return whether no action was left near a local pose (7,)."""
        return self.answers.hopeless_near(point, _LEAST_REACH_STEPS * self._base.task.step_m)

    def extension_contains(self, yeses: Array, point: Array, step: int) -> bool:
        """Return whether yeses at local poses (M, 7) would extend the trust domain to a local pose (7,)."""
        if not self._settings.extend:
            return False
        trust = self._base.trust.extended(yeses, self._radii(yeses))
        return bool(trust.assess(point[None], np.array([step])).certified[0])

    def ask(self, question: Question, evaluation: ActionEvaluation, row: int) -> Outcome:
        """Ask whether an action was right, learn from the answer, and label the action with it in the evaluation's row.

        Raises:
            PauseRequested: whoever answers pauses the run.
        """
        number, outcome = self._substituted(question) if self.spent else self._asked(question, evaluation, row)
        if outcome.right is not None:
            at_goal = bool(evaluation.at_goal[row, question.action])
            evaluation.set_label(row, question.action, self.reward.value(outcome.right, at_goal), ASKED, number)
        return outcome

    def _substituted(self, question: Question) -> tuple[int, Outcome]:
        if self._asking.when_spent != "scripted":
            return NO_ANSWER, Outcome(None)
        self.substituted += 1
        return NO_ANSWER, Outcome(self._substitute.answer(question).right)

    def _asked(self, question: Question, evaluation: ActionEvaluation, row: int) -> tuple[int, Outcome]:
        left = None if self._asking.budget is None else self._asking.budget - self.questions
        number = self.questions
        answer = self._oracle.answer(replace(question, number=number, left=left))
        check_answer(answer, question)
        check_said(answer, len(self._standing), question)
        self.questions += 1
        reopened = self._withdraw(answer.undo) if answer.undo else []
        if answer.better is not None:
            reopened.append((evaluation.local[row].copy(), answer.better))
        self._learn(number, question, answer, evaluation, row)
        return number, Outcome(answer.right, tuple(reopened))

    def _learn(self, number: int, question: Question, answer: Answer, evaluation: ActionEvaluation, row: int) -> None:
        said = [] if answer.right is None else [(question.action, answer.right)]
        if answer.better is not None and answer.better != question.action:
            said.append((answer.better, True))
        if said:
            # Without extension and memory an answer changes no other evaluation.
            self.changes += self._settings.extend or self._settings.remember_m > 0
            self._standing.append(number)
        margins = self._margins(evaluation, row) if answer.undo else evaluation.margin[row]
        for action, right in said:
            margin = float(margins[action])
            # A person who goes another way within the tolerance does not contradict a model that can go any way.
            best = 0.0 if self.reward.continuous else float(margins.max())
            expected = margin >= max(0.0, best)
            here, there = evaluation.local[row].copy(), evaluation.local_reached[row, action].copy()
            self.answers.add(number, here, action, there, right=right, margin=margin, expected=expected)
            if right and self._settings.extend:
                self._extend()
                if not expected:
                    self._recompute(here[None])

    def _margins(self, evaluation: ActionEvaluation, row: int) -> Array:
        """Return the margins (A,) of a row of an evaluation anew: a withdrawn answer no longer corrects the model."""
        one = slice(row, row + 1)
        fresh = self.reward.evaluated(evaluation.poses[one], evaluation.steps[one], evaluation.starts[one])
        margins = 1.0 - excess(evaluation.reached[row], fresh.predicted, self.reward.task)
        return np.where(np.isfinite(evaluation.margin[row]), margins, -np.inf)

    def _extend(self) -> None:
        expected, before, after = self.answers.extension()
        reaches = self._reaches(before)
        radii = np.concatenate([self._radii(expected), np.minimum(0.5 * reaches, self._settings.reach_m)])
        self.reward = self._base.extended(np.concatenate([expected, before]), radii, before, after, reaches)

    def _radii(self, poses: Array) -> Array:
        return np.full(len(poses), self._settings.reach_m)

    def _reaches(self, poses: Array) -> Array:
        """Return the reaches (M,) [m] of unexpected yeses at local poses (M, 7): up to the demonstrated domain."""
        least = _LEAST_REACH_STEPS * self._base.task.step_m
        return np.maximum(self._base.trust.gap(poses), least)

    def _withdraw(self, count: int) -> list[tuple[Array, int]]:
        """Withdraw the latest ``count`` answers; return their local poses (7,) and actions."""
        latest = self._standing[-count:]
        del self._standing[-count:]
        self.changes += 1
        gone = set(latest)
        columns = zip(self.answers.numbers, self.answers.poses, self.answers.actions, strict=True)
        about = [(np.array(point), action) for number, point, action in columns if number in gone]
        self.answers.withdraw(gone)
        if self._replay is not None:
            self._replay.remove(np.isin(self._replay.held().answers, latest))
        if self._settings.extend and about:
            self._extend()
            # What lay within its reach after a step from outside of it was certified too.
            self._recompute(np.array([point for point, _ in about]), self._base.task.step_m)
        return about

    def _recompute(self, poses: Array, beyond: float = 0.0) -> None:
        """Recompute stored rewards of the model near local poses (M, 7); remove those no longer trusted.

        Near is within their reach, and ``beyond`` [m] more.
        """
        replay = self._replay
        if replay is None:
            return
        held = replay.held()
        far = np.maximum(self._radii(poses), self._reaches(poses)) + beyond
        local = self.reward.model.start_frame.to_frame(held.poses, held.starts)
        moved = np.linalg.norm(local[:, None, :3] - poses[None, :, :3], axis=2)
        rows = np.flatnonzero(np.isin(held.sources, BY_MODEL) & (moved <= far).any(axis=1))
        lost = np.zeros(len(replay), dtype=bool)
        for begin in range(0, len(rows), _TOGETHER):
            part = rows[begin : begin + _TOGETHER]
            twists = None if held.twists is None else held.twists[part, None].astype(np.float64)
            evaluation = self.reward.evaluated(held.poses[part], held.steps[part], held.starts[part], twists)
            # What the model suggests may have changed since.
            each = np.arange(len(part)), held.actions[part] if twists is None else np.full(len(part), FIRST_TWIST)
            rewards = evaluation.reward[each].astype(np.float32)
            replay.revalue(part, rewards, evaluation.at_goal[each], step_back=self.step_back)
            lost[part] = ~evaluation.known[each]
        self.recomputed += len(rows)
        if lost.any():
            replay.remove(lost)

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as arrays."""
        counters = {name: np.array(getattr(self, name)) for name in _COUNTERS}
        return {**self.answers.state(), **counters, "standing": np.array(self._standing, dtype=np.int64)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Restore what :meth:`state` returned."""
        self.answers.restore(state)
        for name in _COUNTERS:
            setattr(self, name, int(state[name]))
        self._standing = state["standing"].tolist()
        if self._settings.extend:
            self._extend()


_COUNTERS = ("questions", "substituted", "recomputed")
