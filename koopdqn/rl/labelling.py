"""What is labelled before an action is tried, and which actions may be tried."""

from dataclasses import dataclass

import numpy as np

from koopdqn.intent.reward import ASKED, BY_MODEL, CERTIFIED, RULE, TRUSTED, ActionEvaluation
from koopdqn.pose import Array
from koopdqn.rl.replay_buffer import Labelled
from koopdqn.rl.vector_env import VectorEnv
from koopdqn.tasks.actions import FIRST_TWIST
from koopdqn.tasks.workcell import Motion

Motions = dict[tuple[int, int], Motion]
"""Motions of the arm, by the index of the episode and the action."""


@dataclass(frozen=True)
class Choice:
    """The actions among which an episode chooses.

    Attributes:
        allowed: (A,) booleans; all false if no action is left.
        ranking: (A,) values to choose by in place of Q and of ε; None for those.
        ask: whether the oracle is asked even where the reward is known.
    """

    allowed: np.ndarray
    ranking: Array | None = None
    ask: bool = False


def label_known(env: VectorEnv, evaluation: ActionEvaluation) -> tuple[Labelled, Motions]:
    """Label every action whose reward is known without asking; right ones are checked for reachability first.

    This is §3.3's stepping back done at once: "know from that state what are the right and wrong actions".
    """
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


def choice_among_known(env: VectorEnv, evaluation: ActionEvaluation, index: int) -> Choice:
    """Return an episode's actions known to be right; if there are none, those to ask about, the likeliest first."""
    untried = ~env.episodes.tried[index]
    right = untried & evaluation.known[index] & (evaluation.reward[index] >= 0)
    if right.any():
        return Choice(right)
    if _blocked(env, evaluation, index):
        return Choice(np.zeros_like(right))
    # A person is asked about actions that have a name.
    untried[FIRST_TWIST:] = False
    # Actions not excluded by rules, demonstrations or their own answers.
    unsure = (ASKED,) if env.put_off.on else (ASKED, CERTIFIED)
    return Choice(untried & np.isin(evaluation.source[index], unsure), evaluation.margin[index], ask=True)


def _blocked(env: VectorEnv, evaluation: ActionEvaluation, index: int) -> bool:
    """Return whether asking is useless because the arm cannot carry out the right action.

    That is so where demonstrations are trusted, and near poses where all other actions were asked about in vain.
    """
    source, right = evaluation.source[index], evaluation.margin[index] >= 0
    refused = env.episodes.tried[index] & right & np.isin(source, (RULE, *BY_MODEL))
    return bool(refused.any() and ((source == TRUSTED).any() or env.feedback.hopeless_near(evaluation.local[index])))
