"""Remembered answers by pose and action, and where each still applies."""

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.settings import Settings
from koopdqn.tasks.actions import FIRST_TWIST

Row = tuple[float, ...]

# Poses nearer than this [m, rad] are the same.
_SAME = 1e-6


class FeedbackSettings(Settings):
    """How far an answer applies beyond the action asked about."""

    remember_m: float = Field(
        ge=0,
        le=0.5,
        description="an answer applies to the same action within this distance of its pose; 0: nowhere [m]",
    )
    remember_rad: float = Field(gt=0, le=3.2, description="and within this angle of its orientation [rad]")
    extend: bool = Field(
        description="let a yes extend the trust domain and, where the intent model disagrees, correct the model"
    )
    reach_m: float = Field(gt=0, le=0.5, description="radius of such an extension around the pose [m]")


@dataclass
class RememberedAnswers:
    """Answers by pose and action, in the order in which they were given.

    Attributes:
        settings: how far an answer applies.
        numbers: of the answers, as the journal counts them.
        poses: (7,) of the questions.
        actions: of the questions.
        reached: poses (7,) after the actions.
        right: the answers.
        margins: of the intent model's prediction when asked; at least 0 if the model held the action right.
        expected: whether the model held the action right and no other action better.
        contradictions: how often no action was left that could be right.
        hopeless: poses (7,) where that happened.
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
        """Return the number of answers."""
        return len(self.numbers)

    def add(
        self, number: int, point: Array, action: int, reached: Array, *, right: bool, margin: float, expected: bool
    ) -> None:
        """Remember an answer, by its number, about an action from a pose (7,) and the pose it reached (7,)."""
        # Rows of plain floats: thousands of small arrays would fragment memory.
        row = (number, tuple(point.tolist()), action, tuple(reached.tolist()), right, margin, expected)
        for values, value in zip(self._columns(), row, strict=True):
            values.append(value)
        self._stacked = None

    def recall(self, poses: Array, margins: Array) -> np.ndarray:
        """Return the index (N, K) of the answer that applies to each of K actions from poses (N, 7), or −1.

        The nearest answer counts; of equally near ones, the latest. The model's error in the margin is about the same
        nearby, so a yes applies where the margin (N, K) is at least that of the question, a no where at most that.
        """
        found = np.full(margins.shape, -1)
        if not len(self) or self.settings.remember_m == 0.0:
            return found
        known, actions = self._known, np.array(self.actions)
        moved = pose.position_distance(poses[:, None], known[None])
        turned = pose.rotation_distance(poses[:, None], known[None])
        near = (moved <= self.settings.remember_m) & (turned <= self.settings.remember_rad)
        opinion, then = margins[:, np.minimum(actions, margins.shape[1] - 1)], np.array(self.margins)
        applies = near & np.where(self.right, opinion >= then, opinion <= then)
        applies |= (moved <= _SAME) & (turned <= _SAME)
        # A twist without a name is never the same action again.
        applies &= actions < FIRST_TWIST
        for action in np.unique(actions[applies.any(axis=0)]):
            gap = np.where(applies & (actions == action), moved, np.inf)[:, ::-1]
            place = gap.shape[1] - 1 - gap.argmin(axis=1)
            found[:, action] = np.where(np.isfinite(gap.min(axis=1)), place, -1)
        return found

    def extension(self) -> tuple[Array, Array, Array]:
        """Return the poses (M, 7) of expected yeses, and the poses (D, 7) before and after unexpected ones."""
        yes = [i for i, right in enumerate(self.right) if right]
        expected = [i for i in yes if self.expected[i]]
        unexpected = [i for i in yes if not self.expected[i]]
        return _rows(self.poses, expected), _rows(self.poses, unexpected), _rows(self.reached, unexpected)

    def withdraw(self, numbers: set[int]) -> None:
        """Forget the answers with these numbers, and all contradictions, which may depend on them."""
        self.hopeless.clear()
        self._keep([number not in numbers for number in self.numbers])

    def contradict(self, point: Array) -> bool:
        """Forget the noes around a pose (7,) where no action is left: one must be wrong. Return if there were any."""
        if not len(self):
            return False
        noes = (pose.position_distance(self._known, point) <= self.settings.remember_m) & ~np.array(self.right)
        if noes.any():
            # Where nothing is remembered, answers cannot contradict each other.
            self.contradictions += self.settings.remember_m > 0
            self.hopeless.append(tuple(point.tolist()))
            self._keep((~noes).tolist())
        return bool(noes.any())

    def hopeless_near(self, point: Array, reach: float) -> bool:
        """Return whether no action was left somewhere within a reach [m] of a pose (7,)."""
        places = np.array(self.hopeless).reshape(-1, 7)
        return bool((pose.position_distance(places, point) <= reach).any())

    def state(self) -> dict[str, np.ndarray]:
        """Return the state as arrays."""
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
        """Restore what :meth:`state` returned."""
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
