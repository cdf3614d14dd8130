"""Feedback in training: what is asked and remembered, what answers teach, and what withdrawing them undoes."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.reward import BY_MODEL, REMEMBERED, IntentReward, Judgement
from koopdqn.oracles.base import Answer, Oracle, Question
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.replay_buffer import ReplayBuffer
from koopdqn.settings import Settings

Row = tuple[float, ...]

# Nearer than this [m, rad] two poses are one and the same.
_SAME = 1e-6


class FeedbackSettings(Settings):
    """What is made of answers beyond the reward of the action asked about."""

    remember_m: float = Field(
        ge=0, le=0.5, description="an answer holds for the same action within this distance of its pose; 0: nowhere [m]"
    )
    remember_rad: float = Field(gt=0, le=3.2, description="and within this angle of its orientation [rad]")
    extend: bool = Field(description="let a yes extend the trust domain and, where it disagrees, the intent model")
    reach_m: float = Field(gt=0, le=0.5, description="radius of such an extension around the pose [m]")


@dataclass
class AnswerMemory:
    """Answers by pose and action, in the order in which they were given.

    Attributes:
        settings: how far an answer holds.
        numbers: of the answers, as the journal counts them.
        poses: (7,) that were asked about.
        actions: that were asked about.
        reached: poses (7,) after them.
        right: what was said.
        margins: of the intent model's own opinion when it was asked; at least 0: it had thought the action right.
        expected: whether the model had thought it right and no other action more so.
        contradictions: how often nothing was left that could have been right.
        hopeless: poses (7,) where that was so.
    """

    settings: FeedbackSettings
    numbers: list[int] = field(default_factory=list)
    poses: list[Row] = field(default_factory=list)
    actions: list[int] = field(default_factory=list)
    reached: list[Row] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    margins: list[float] = field(default_factory=list)
    expected: list[bool] = field(default_factory=list)
    contradictions: int = 0
    hopeless: list[Row] = field(default_factory=list)
    _stacked: Array | None = field(default=None, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        """Return the number of answers held."""
        return len(self.numbers)

    def add(
        self, number: int, point: Array, action: int, reached: Array, *, right: bool, margin: float, expected: bool
    ) -> None:
        """Remember the answer of a number to a question about a pose (7,), an action and the pose it reached (7,)."""
        # Rows of plain floats: thousands of small arrays kept would hold the allocator's larger blocks apart.
        row = (number, tuple(point.tolist()), action, tuple(reached.tolist()), right, margin, expected)
        for values, value in zip(self._columns(), row, strict=True):
            values.append(value)
        self._stacked = None

    def recall(self, poses: Array, margins: Array) -> np.ndarray:
        """Return which answer holds for each of K actions from poses (N, 7): its place (N, K), or −1.

        The nearest decides, of equally near ones the latest. The model may be off by some margin, about the same
        nearby: a yes holds for what it thinks at least as right, a no for what it thinks at most as right.

        Args:
            poses: from which actions are tried.
            margins: (N, K) of the model's opinion of them; at least 0: right.
        """
        found = np.full(margins.shape, -1)
        if not len(self) or self.settings.remember_m == 0.0:
            return found
        known, actions = self._known, np.array(self.actions)
        moved = pose.position_distance(poses[:, None], known[None])
        turned = pose.rotation_distance(poses[:, None], known[None])
        near = (moved <= self.settings.remember_m) & (turned <= self.settings.remember_rad)
        opinion, then = margins[:, actions], np.array(self.margins)
        holds = near & np.where(self.right, opinion >= then, opinion <= then)
        holds |= (moved <= _SAME) & (turned <= _SAME)
        for action in np.unique(actions[holds.any(axis=0)]):
            gap = np.where(holds & (actions == action), moved, np.inf)[:, ::-1]
            place = gap.shape[1] - 1 - gap.argmin(axis=1)
            found[:, action] = np.where(np.isfinite(gap.min(axis=1)), place, -1)
        return found

    def extension(self) -> tuple[Array, Array, Array]:
        """Return the poses (M, 7) of yeses that the model expected, and (D, 7) before and after the others."""
        yes = [i for i, right in enumerate(self.right) if right]
        expected = [i for i in yes if self.expected[i]]
        unexpected = [i for i in yes if not self.expected[i]]
        return _rows(self.poses, expected), _rows(self.poses, unexpected), _rows(self.reached, unexpected)

    def withdraw(self, numbers: set[int]) -> None:
        """Forget the answers of these numbers, and where nothing was right, which may rest on them."""
        self.hopeless.clear()
        self._keep([number not in numbers for number in self.numbers])

    def contradict(self, point: Array) -> bool:
        """Notice that no action is left from a pose (7,), and forget the noes that led there: one must be wrong.

        Returns whether there were any.
        """
        if not len(self):
            return False
        noes = (pose.position_distance(self._known, point) <= self.settings.remember_m) & ~np.array(self.right)
        if noes.any():
            self.contradictions += 1
            self.hopeless.append(tuple(point.tolist()))
            self._keep((~noes).tolist())
        return bool(noes.any())

    def hopeless_near(self, point: Array, reach: float) -> bool:
        """Return whether nothing was right within a reach [m] of a pose (7,)."""
        places = np.array(self.hopeless).reshape(-1, 7)
        return bool((pose.position_distance(places, point) <= reach).any())

    def state(self) -> dict[str, np.ndarray]:
        """Return everything held, as arrays."""
        return {
            "numbers": np.array(self.numbers, dtype=np.int64),
            "poses": _rows(self.poses, range(len(self))),
            "actions": np.array(self.actions, dtype=np.int64),
            "reached": _rows(self.reached, range(len(self))),
            "right": np.array(self.right, dtype=np.bool_),
            "margins": np.array(self.margins, dtype=np.float64),
            "expected": np.array(self.expected, dtype=np.bool_),
            "contradictions": np.array(self.contradictions),
            "hopeless": np.array(self.hopeless).reshape(-1, 7),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Hold what :meth:`state` returned."""
        self.numbers, self.actions = state["numbers"].tolist(), state["actions"].tolist()
        self.right, self.margins = state["right"].tolist(), state["margins"].tolist()
        self.expected = state["expected"].tolist()
        self.poses, self.reached = ([tuple(row) for row in state[name].tolist()] for name in ("poses", "reached"))
        self._stacked = None
        self.hopeless = [tuple(row) for row in state["hopeless"].tolist()]
        self.contradictions = int(state["contradictions"])

    @property
    def _known(self) -> Array:
        if self._stacked is None:
            self._stacked = _rows(self.poses, range(len(self)))
        return self._stacked

    def _columns(self) -> tuple[list, ...]:  # type: ignore[type-arg]  # columns of different types
        return self.numbers, self.poses, self.actions, self.reached, self.right, self.margins, self.expected

    def _keep(self, kept: list[bool]) -> None:
        for values in self._columns():
            values[:] = [value for value, keep in zip(values, kept, strict=True) if keep]
        self._stacked = None


def _rows(values: list[Row], index: list[int] | range) -> Array:
    return np.array([values[i] for i in index]).reshape(-1, 7)


_TOGETHER = 1024
# A yes that the model did not expect moves it at least as far around as this.
_LEAST_REACH_STEPS = 14.0


@dataclass(frozen=True)
class Budget:
    """How many questions may be asked, and what happens then.

    Attributes:
        most: questions; None for no limit.
        when_spent: stop training, give no reward where the model is not trusted, or ask the scripted oracle.
    """

    most: int | None = None
    when_spent: Literal["stop", "distrust", "scripted"] = "stop"


@dataclass(frozen=True)
class Outcome:
    """What came of a question.

    Attributes:
        right: whether the action was right; None if there was no answer.
        reopened: placed poses (7,) and actions of which other things are known than when they were last tried: their
            answer was withdrawn, or they are what would have been right.
    """

    right: bool | None
    reopened: tuple[tuple[Array, int], ...] = ()


class Feedback:
    """The reward function together with what answers have taught.

    Attributes:
        reward: the reward function, extended by the answers so far.
        memory: the answers.
        questions: questions that reached the oracle.
        substituted: questions that the scripted oracle answered because the budget was spent.
        recomputed: rewards in the replay buffer that were recomputed.
        changes: how often what is known has changed since this object was made.
        step_back: whether wrong actions are stepped back from.
    """

    def __init__(
        self, reward: IntentReward, oracle: Oracle, settings: FeedbackSettings, budget: Budget, *, step_back: bool
    ) -> None:
        """Begin without answers.

        Args:
            reward: the reward function.
            oracle: who answers.
            settings: what is made of answers.
            budget: how many questions may be asked.
            step_back: whether wrong actions are stepped back from.
        """
        self.reward = reward
        self.memory = AnswerMemory(settings)
        self.questions = 0
        self.substituted = 0
        self.recomputed = 0
        self.changes = 0
        self.step_back = step_back
        # Memory forgets contradictory answers, but who answers may withdraw them still.
        self._standing: list[int] = []
        self._base = reward
        self._oracle = oracle
        self._settings = settings
        self._budget = budget
        self._substitute = ScriptedOracle(reward.task)

    @property
    def spent(self) -> bool:
        """Whether no further question may be asked."""
        return self._budget.most is not None and self.questions >= self._budget.most

    @property
    def stopped(self) -> bool:
        """Whether training is over because the budget is spent."""
        return self.spent and self._budget.when_spent == "stop"

    def judge(self, poses: Array, steps: np.ndarray, starts: Array | None = None) -> Judgement:
        """Return what is known without asking, answers included; see :meth:`IntentReward.judge`."""
        judgement = self.reward.judge(poses, steps, starts)
        places = self.memory.recall(judgement.placed, judgement.margin)
        recalled = (places >= 0) & ~judgement.known
        for index, action in np.argwhere(recalled):
            place = places[index, action]
            at_goal = bool(judgement.at_goal[index, action])
            judgement.reward[index, action] = self.reward.value(self.memory.right[place], at_goal)
            judgement.source[index, action] = REMEMBERED
            judgement.answer[index, action] = self.memory.numbers[place]
        judgement.known[recalled] = True
        return judgement

    def contradict(self, point: Array) -> None:
        """Notice that no action is left from a placed pose (7,); see :meth:`AnswerMemory.contradict`."""
        self.changes += self.memory.contradict(point)

    def hopeless_near(self, point: Array) -> bool:
        """Return whether nothing at all was right near a placed pose (7,)."""
        return self.memory.hopeless_near(point, _LEAST_REACH_STEPS * self._base.task.step_m)

    def covers(self, yeses: Array, point: Array, step: int) -> bool:
        """Return whether a yes at one of poses (M, 7) would extend the trust domain to a pose (7,), all placed."""
        if not self._settings.extend:
            return False
        trust = self._base.trust.extended(yeses, self._radii(yeses))
        return bool(trust.vouched(point[None], np.array([step])).answered[0])

    def ask(self, question: Question, judgement: Judgement, index: int, replay: ReplayBuffer) -> Outcome:
        """Ask whether an action was right, learn from the answer, and put its reward into a row of a judgement.

        Raises:
            PauseRequested: who answers wants to go on another time.
        """
        outcome = self._instead(question) if self.spent else self._answer(question, judgement, index, replay)
        if outcome.right is not None:
            at_goal = bool(judgement.at_goal[index, question.action])
            judgement.reward[index, question.action] = self.reward.value(outcome.right, at_goal)
        return outcome

    def _instead(self, question: Question) -> Outcome:
        if self._budget.when_spent != "scripted":
            return Outcome(None)
        self.substituted += 1
        return Outcome(self._substitute.answer(question).right)

    def _answer(self, question: Question, judgement: Judgement, index: int, replay: ReplayBuffer) -> Outcome:
        left = None if self._budget.most is None else self._budget.most - self.questions
        number = self.questions
        answer = self._oracle.answer(replace(question, left=left))
        self.questions += 1
        reopened = self._withdraw(answer.undo, replay) if answer.undo else []
        if answer.better is not None:
            reopened.append((judgement.placed[index].copy(), answer.better))
        self._learn(number, question, answer, judgement, index, replay)
        judgement.answer[index, question.action] = number
        return Outcome(answer.right, tuple(reopened))

    def _learn(
        self, number: int, question: Question, answer: Answer, judgement: Judgement, index: int, replay: ReplayBuffer
    ) -> None:
        said = [] if answer.right is None else [(question.action, answer.right)]
        if answer.better is not None and answer.better != question.action:
            said.append((answer.better, True))
        if said:
            # Where answers teach nothing beyond themselves, nobody else need be judged anew.
            self.changes += self._settings.extend or self._settings.remember_m > 0
            self._standing.append(number)
        for action, right in said:
            margins = judgement.margin[index]
            margin = float(margins[action])
            expected = margin >= max(0.0, float(margins.max()))
            here, there = judgement.placed[index].copy(), judgement.placed_reached[index, action].copy()
            self.memory.add(number, here, action, there, right=right, margin=margin, expected=expected)
            if right and self._settings.extend:
                self._extend()
                if not expected:
                    self._recompute(here[None], replay)

    def _extend(self) -> None:
        expected, before, after = self.memory.extension()
        reaches = self._reaches(before)
        radii = np.concatenate([self._radii(expected), np.minimum(0.5 * reaches, self._settings.reach_m)])
        self.reward = self._base.extended(np.concatenate([expected, before]), radii, before, after, reaches)

    def _radii(self, poses: Array) -> Array:
        return np.full(len(poses), self._settings.reach_m)

    def _reaches(self, poses: Array) -> Array:
        """Return how far unexpected yeses at placed poses (M, 7) move the model [m]: not into what was demonstrated."""
        least = _LEAST_REACH_STEPS * self._base.task.step_m
        return np.maximum(self._base.trust.gap(poses), least)

    def _withdraw(self, count: int, replay: ReplayBuffer) -> list[tuple[Array, int]]:
        """Withdraw the latest answers; return the placed poses (7,) and actions that they were about."""
        latest = self._standing[-count:]
        del self._standing[-count:]
        self.changes += 1
        gone = set(latest)
        columns = zip(self.memory.numbers, self.memory.poses, self.memory.actions, strict=True)
        about = [(np.array(point), action) for number, point, action in columns if number in gone]
        self.memory.withdraw(gone)
        replay.remove(np.isin(replay.held().answers, latest))
        if self._settings.extend and about:
            self._extend()
            self._recompute(np.array([point for point, _ in about]), replay)
        return about

    def _recompute(self, poses: Array, replay: ReplayBuffer) -> None:
        """Give the model's rewards near placed poses (M, 7) their present values; what is no more trusted goes."""
        held = replay.held()
        far = np.maximum(self._radii(poses), self._reaches(poses))
        placed = self.reward.model.start_frame.placed(held.poses, held.starts)
        moved = np.linalg.norm(placed[:, None, :3] - poses[None, :, :3], axis=2)
        rows = np.flatnonzero(np.isin(held.sources, BY_MODEL) & (moved <= far).any(axis=1))
        lost = np.zeros(len(replay), dtype=bool)
        for begin in range(0, len(rows), _TOGETHER):
            part = rows[begin : begin + _TOGETHER]
            judged = self.reward.judge(held.poses[part], held.steps[part], held.starts[part])
            each = np.arange(len(part)), held.actions[part]
            rewards = judged.reward[each].astype(np.float32)
            replay.revalue(part, rewards, judged.at_goal[each], step_back=self.step_back)
            lost[part] = ~judged.known[each]
        self.recomputed += len(rows)
        if lost.any():
            replay.remove(lost)

    def state(self) -> dict[str, np.ndarray]:
        """Return everything held, as arrays."""
        counters = {name: np.array(getattr(self, name)) for name in _COUNTERS}
        return {**self.memory.state(), **counters, "standing": np.array(self._standing, dtype=np.int64)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Hold what :meth:`state` returned."""
        self.memory.restore(state)
        for name in _COUNTERS:
            setattr(self, name, int(state[name]))
        self._standing = state["standing"].tolist()
        if self._settings.extend:
            self._extend()


_COUNTERS = ("questions", "substituted", "recomputed")
