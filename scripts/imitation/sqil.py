"""SQIL (Reddy et al. 2019) on the agent's DQN: demonstrated steps are rewarded, its own are not."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from imitation.inferred import BestOf, Imitator, demonstrated_transitions
from koopdqn.intent.reward import NO_ANSWER, RULE
from koopdqn.pose import Array
from koopdqn.rl.dqn import Learner
from koopdqn.rl.network import observe, size
from koopdqn.rl.policy import Policy
from koopdqn.rl.replay_buffer import BATCH_FIELDS, Batch, ReplayBuffer, Transitions
from koopdqn.rl.settings import AgentSettings
from koopdqn.rl.starts import StartSampler
from koopdqn.rl.vector_env import Episodes
from koopdqn.tasks.actions import COUNT, reached_poses
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.workcell import Workcell

# Its rewards say little each, so that targets have to be handed on over many steps; the agent's own pace is too fast.
_SLOWER: Final = {"learning_rate": 1e-3, "target_rate": 0.01}
# Sets its random numbers apart from those of demonstrations (1), training (2), checks (3) and evaluation (4).
_STREAM: Final = 7


class Sqil:
    """Soft Q imitation learning with this project's network, double DQN, exploration and starts.

    A demonstrated step is worth 1 and a step of the agent's own 0, all times 1 − γ, which changes no policy and
    keeps every value within 0…1. Half of a batch is demonstrated. The goal is an absorbing state in which the
    demonstrator would stay (Kostrikov et al. 2019): else, as all rewards are 0 or more, it would pay never to arrive.
    Instead of the paper's soft maximum the target is the agent's own, and exploring is ε-greedy. No intent model and no
    oracle take part; nothing is undone, and an action that the arm cannot take leaves it where it is.

    Attributes:
        learner: the networks.
        env_steps: actions tried.
    """

    def __init__(
        self,
        workcell: Workcell,
        trajectories: list[Array],
        agent: AgentSettings,
        seed: int,
        step_limit: int,
        gamma: float = 0.8,
        frame: StartFrame = STILL,
    ) -> None:
        """Begin from demonstrated poses (N, 7) at the agent's step; the seed fixes everything.

        The agent's γ and pace do not count: γ is larger, since only demonstrated steps are rewarded.
        """
        task, shown = workcell.task, demonstrated_transitions(trajectories, workcell.task, frame)
        self._workcell, self._frame = workcell, frame
        self._agent = agent.model_copy(update={"gamma": gamma, **_SLOWER})
        self._shown = replace(shown, rewards=np.where(shown.terminated, 1.0, 1.0 - gamma).astype(np.float32))
        weights, self._explore, self._draw = (np.random.default_rng([seed, _STREAM, part]) for part in range(3))
        self.learner = Learner(size(task), self._agent, weights)
        self.learner.normalise_to(self._shown.observations)
        self._replay = ReplayBuffer(agent.replay, size(task))
        self._starts = StartSampler(workcell, frame, frame.each(trajectories), step_limit, agent)
        self._batch = Episodes(agent.episodes_at_once, len(workcell.arm.joint_names))
        self._begun = 0
        for index in range(len(self._batch)):
            self._begin(index)
        self.env_steps = 0

    def run(
        self,
        actions: int = 64_000,
        check: Callable[[Policy], float] = lambda policy: 0.0,
        check_every: int = 400,
    ) -> Imitator:
        """Try at least that many actions, updating meanwhile as the agent does, and return what was learned.

        Args:
            actions: how many.
            check: says how good a policy is; of the best the latest is returned.
            check_every: updates between two checks; there is one more at the end.
        """
        agent, rounds, best = self._agent, 0, BestOf(check)
        while self.env_steps < actions:
            self._round()
            due = self.env_steps >= agent.warm_up and rounds % agent.rounds_per_update == 0
            for _ in range(agent.updates_per_round if due else 0):
                self.learner.update(self.batch())
                if self.learner.updates % check_every == 0:
                    best.offer(self._policy())
            rounds += 1
        return Imitator(best.offer(self._policy()), self.learner.updates, self.env_steps)

    def _policy(self) -> Policy:
        return Policy(self.learner.policy_network, self._workcell.task, self._frame)

    def batch(self) -> Batch:
        """Return a batch for an update: as many demonstrated steps as the agent's batch, then as many of its own."""
        half = self._agent.batch
        rows = self._draw.integers(len(self._shown.actions), size=half)
        own = self._replay.sample(self._draw, half)
        return Batch(
            **{name: np.concatenate([getattr(self._shown, name)[rows], getattr(own, name)]) for name in BATCH_FIELDS}
        )

    def _begin(self, index: int) -> None:
        self._batch.begin(index, self._begun, self._starts.draw(self._explore))
        self._begun += 1

    def _round(self) -> None:
        """Let every episode try one action."""
        batch, task = self._batch, self._workcell.task
        count = len(batch)
        before, steps = batch.poses.copy(), batch.steps.copy()
        explore = self._explore.random(count) < self._agent.epsilon(self.env_steps)
        observations = observe(self._frame.to_frame(before, batch.starts), task)
        greedy = self.learner.online.values(observations).argmax(axis=1)
        actions = np.where(explore, self._explore.integers(COUNT, size=count), greedy)
        reached = reached_poses(before, task)[np.arange(count), actions]
        motions = self._workcell.reachability.move_batch(reached, batch.joints)
        moved = np.array([motion.joints is not None for motion in motions])
        after = np.where(moved[:, None], reached, before)
        arrived = moved & task.reached(after)
        cut = ~arrived & (steps + 1 >= batch.limits)
        self._replay.add(
            Transitions(
                observations,
                actions,
                # Nothing for the step itself; from then on it stays where the demonstrator would.
                np.where(arrived, self._agent.gamma, 0.0).astype(np.float32),
                observe(self._frame.to_frame(after, batch.starts), task),
                terminated=arrived,
                truncated=cut,
                undone=np.zeros(count, dtype=bool),
                poses=before,
                starts=batch.starts.copy(),
                steps=steps,
                sources=np.full(count, RULE),
                answers=np.full(count, NO_ANSWER),
            )
        )
        self.env_steps += count
        for index, motion in enumerate(motions):
            batch.move(index, after[index], batch.joints[index] if motion.joints is None else motion.joints)
            if arrived[index] or cut[index]:
                self._begin(index)
