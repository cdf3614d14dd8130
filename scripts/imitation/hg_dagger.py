"""HG-DAgger (Kelly et al. 2019): behavioural cloning, corrected by an expert who takes over where it goes wrong."""

from typing import Final

import numpy as np

from imitation.cloning import Cloning
from imitation.imitator import Imitator
from koopdqn.pose import Array
from koopdqn.rl.settings import AgentSettings
from koopdqn.tasks.actions import nearest_actions, reached_poses, within_tolerance
from koopdqn.tasks.rollout import roll_out
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import demonstrator_wishes
from koopdqn.tasks.workcell import Workcell

# Sets its random numbers apart from those of the other methods: 1 to 4, 6 and 7.
_STREAM: Final = 8
# Questions may be left over: where the policy is hardly ever wrong it is not rolled out for ever.
_MOST_EPISODES: Final = 20


class HgDagger:
    """Human-gated DAgger with the scripted person as the expert and a limited number of labels.

    The cloned policy is rolled out from drawn starts. Where its action is wrong by the expert, who judges as the
    scripted oracle does, the expert takes over for that step with the action nearest to their own next pose. That
    action is a label, and each label is one question; the demonstrated steps and all labels so far are learned from
    for some updates, and the episode goes on. Unlike the paper's there is one network instead of an ensemble, as
    nothing is made of its doubt, and it learns after every label instead of every epoch, so that few labels tell most.

    Attributes:
        cloning: the network and what it learns from.
        asked: labels asked for.
        env_steps: actions carried out.
    """

    def __init__(
        self,
        workcell: Workcell,
        trajectories: list[Array],
        agent: AgentSettings,
        seed: int,
        step_limit: int,
        frame: StartFrame = STILL,
    ) -> None:
        """Begin.

        Args:
            workcell: task, arm and scene.
            trajectories: demonstrated poses (N, 7) at the agent's step.
            agent: its network, learning rate and batch.
            seed: fixes everything.
            step_limit: steps after which an episode is cut.
            frame: in which poses are observed.
        """
        self.cloning = Cloning(trajectories, workcell.task, agent, seed, frame)
        self.asked = 0
        self.env_steps = 0
        self._workcell = workcell
        self._rng = np.random.default_rng([seed, _STREAM])
        self._step_limit = step_limit

    def run(self, questions: int, updates: int = 2000, updates_per_label: int = 100) -> Imitator:
        """Clone, then ask for that many labels at most, and return what was learned.

        Args:
            questions: labels.
            updates: of cloning before the first episode.
            updates_per_label: after each.
        """
        reachability, task = self._workcell.reachability, self._workcell.task
        self.cloning.update(updates)

        def act(poses: Array, starts: Array) -> np.ndarray:
            actions = self.cloning.policy(poses, starts)
            if self.asked == questions:
                return actions
            wished = demonstrator_wishes(task, poses, starts)
            if within_tolerance(reached_poses(poses, task)[0, actions], wished, task)[0]:
                return actions
            right = nearest_actions(poses, wished, task)
            self.cloning.label(poses, starts, int(right[0]))
            self.asked += 1
            self.cloning.update(updates_per_label)
            return right

        for _ in range(_MOST_EPISODES):
            if self.asked == questions:
                break
            starts, joints, _ = reachability.draw_starts(task, self._rng, 1)
            self.env_steps += roll_out(act, task, reachability, starts, joints, self._step_limit)[0].steps
        return Imitator(self.cloning.policy, self.cloning.updates, self.env_steps, self.asked)
