"""HG-DAgger (Kelly et al. 2019): behavioural cloning, corrected by an expert who takes over where it goes wrong."""

from collections.abc import Callable
from typing import Final

import numpy as np

from imitation.cloning import UPDATES, Cloning
from imitation.inferred import BestOf, Imitator
from koopdqn.pose import Array
from koopdqn.rl.policy import Policy
from koopdqn.tasks.actions import nearest_actions, reached_poses, within_tolerance
from koopdqn.tasks.rollout import roll_out
from koopdqn.tasks.task import demonstrator_next_poses
from koopdqn.tasks.workcell import Workcell

# Sets its random numbers apart from those of the other methods: 1 to 4, 6 and 7.
_STREAM: Final = 8
# Questions may be left over: where the policy is hardly ever wrong it is not rolled out for ever.
_MOST_EPISODES: Final = 20


def corrected(
    cloning: Cloning,
    workcell: Workcell,
    seed: int,
    step_limit: int,
    questions: int,
    updates: int = UPDATES,
    updates_per_label: int = 100,
    check: Callable[[Policy], float] = lambda policy: 0.0,
) -> Imitator:
    """Return what cloning learns from the scripted person as the expert, who labels a limited number of states.

    The cloned policy is rolled out from drawn starts. Where its action is wrong by the expert, who judges as the
    scripted oracle does, the expert takes over for that step with the action nearest to their own next pose. That
    action is a label, and each label is one question; the demonstrated steps and all labels so far are learned from
    for some updates, and the episode goes on. Unlike the paper's there is one network instead of an ensemble, as
    nothing is made of its doubt, and it learns after every label instead of every epoch, so that few labels tell most.

    Args:
        cloning: the network and what it learns from, before its first update.
        workcell: task, arm and scene.
        seed: of the starts.
        step_limit: steps after which an episode is cut.
        questions: labels at most.
        updates: of cloning before the first episode.
        updates_per_label: after each.
        check: says how good a policy is; of those after each label, and before the first, the latest of the best is
            returned.
    """
    reachability, task, rng = workcell.reachability, workcell.task, np.random.default_rng([seed, _STREAM])
    cloning.update(updates)
    best = BestOf(check)
    learned = best.offer(cloning.policy)

    def act(poses: Array, starts: Array) -> np.ndarray:
        nonlocal learned
        actions = cloning.policy(poses, starts)
        if len(cloning.labels) == questions:
            return actions
        wished = demonstrator_next_poses(task, poses, starts)
        if within_tolerance(reached_poses(poses, task)[0, actions], wished, task)[0]:
            return actions
        right = nearest_actions(poses, wished, task)
        cloning.label(poses, starts, int(right[0]))
        cloning.update(updates_per_label)
        learned = best.offer(cloning.policy)
        return right

    env_steps = 0
    for _ in range(_MOST_EPISODES):
        if len(cloning.labels) == questions:
            break
        starts, joints, _ = reachability.draw_starts(task, rng, 1)
        env_steps += roll_out(act, task, reachability, starts, joints, step_limit)[0].steps
    return Imitator(learned, cloning.updates, env_steps, len(cloning.labels))
