"""Which actions of a state are labelled, and among which an episode chooses."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from koopdqn.intent.reward import ASKED, BY_MODEL, CERTIFIED, RULE, TRUSTED, ActionEvaluation
from koopdqn.pose import Array
from koopdqn.rl.labels import Labelled
from koopdqn.rl.vector_env import VectorEnv
from koopdqn.tasks.reachability import Motion

Motions = dict[tuple[int, int], Motion]
"""What becomes of the arm, by the index of the episode and the action."""


@dataclass(frozen=True)
class Choice:
    """Among which actions an episode chooses.

    Attributes:
        allowed: (10,) booleans; none is true where there is nothing left to try.
        ranking: (10,) what decides among them, in place of Q and of chance; None for these.
        ask: whether the oracle is asked even where the reward is known.
    """

    allowed: np.ndarray
    ranking: Array | None = None
    ask: bool = False


class Labelling(Protocol):
    """Which actions of a state are labelled, and which are tried."""

    def label(self, env: VectorEnv, evaluation: ActionEvaluation) -> tuple[Labelled | None, Motions]:
        """Label actions from where all episodes are, before one of them is tried; None for none of them."""

    def choice(self, env: VectorEnv, evaluation: ActionEvaluation, index: int) -> Choice:
        """Return among which actions an episode chooses."""


class LabelChosen:
    """The paper's: an action is labelled when it is tried, and any action not tried yet may be."""

    def label(self, env: VectorEnv, evaluation: ActionEvaluation) -> tuple[Labelled | None, Motions]:
        """Label nothing."""
        return None, {}

    def choice(self, env: VectorEnv, evaluation: ActionEvaluation, index: int) -> Choice:
        """Return all actions that were not tried."""
        return Choice(~env.episodes.tried[index])


class LabelAllKnown:
    """Every action whose reward is known without asking is labelled, and a right one is tried.

    That is §3.3's stepping back carried out at once: "know from that state what are the right and wrong actions".
    """

    def label(self, env: VectorEnv, evaluation: ActionEvaluation) -> tuple[Labelled | None, Motions]:
        """Label all actions whose reward is known; those that seem right are tried on the arm."""
        episodes = env.episodes
        mask = evaluation.known & ~episodes.stored
        rows, actions = np.nonzero(mask & (evaluation.reward >= 0))
        moved = env.workcell.reachability.move_batch(evaluation.reached[rows, actions], episodes.joints[rows])
        motions = dict(zip(zip(rows.tolist(), actions.tolist(), strict=True), moved, strict=True))
        for (index, action), motion in motions.items():
            if motion.joints is None:
                env.forbid(index, action, evaluation)
        rows, actions = np.nonzero(mask)
        episodes.stored[rows, actions] = True
        return Labelled(evaluation, rows, actions), motions

    def choice(self, env: VectorEnv, evaluation: ActionEvaluation, index: int) -> Choice:
        """Return the actions known to be right; where there is none, those to ask about, the likeliest first."""
        untried = ~env.episodes.tried[index]
        right = untried & evaluation.known[index] & (evaluation.reward[index] >= 0)
        if right.any():
            return Choice(right)
        if _blocked(env, evaluation, index):
            return Choice(np.zeros_like(right))
        # All that neither rules nor demonstrations nor answers about it exclude.
        unsure = (ASKED,) if env.put_off.on else (ASKED, CERTIFIED)
        return Choice(untried & np.isin(evaluation.source[index], unsure), evaluation.margin[index], ask=True)


def _blocked(env: VectorEnv, evaluation: ActionEvaluation, index: int) -> bool:
    """Return whether no person would know better: the arm cannot do what was thought right.

    That is so where demonstrations vouch for it, and near where a person was asked about all else in vain.
    """
    source, right = evaluation.source[index], evaluation.margin[index] >= 0
    refused = env.episodes.tried[index] & right & np.isin(source, (RULE, *BY_MODEL))
    return bool(refused.any() and ((source == TRUSTED).any() or env.feedback.hopeless_near(evaluation.local[index])))
