"""Algorithm 1, the Koopman operator-based knowledge-guided DQN, with parallel episodes.

Beside the paper's listing (reconstructed from §3.1, §3.3, §3.4 and §4; docs/algorithm.md numbers the differences):

    for each step                                                :meth:`Trainer.run`
        choose a_t: random with probability ε, else argmax Q     :meth:`Trainer.collect`
        s_{t+1} = env.step(s_t, a_t)                             :meth:`VectorEnv.try_action`
        if indomain(s_{t+1}): ŝ = humanIntentModel(s_t)          :meth:`IntentReward.evaluate_actions`
            r_t = + if dist(s_{t+1}, ŝ) is within tolerance else −
        else: r_t = getHumanFeedback()                           :meth:`Feedback.ask`
        store (s_t, a_t, r_t, s_{t+1}); if r_t < 0, step back    :meth:`Trainer._store`
        sample a batch and update Q (Eqs. 1, 3)                  :meth:`Trainer.train`
"""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from koopdqn.artifact import below
from koopdqn.intent.reward import ActionEvaluation, IntentReward
from koopdqn.oracles.base import Asking, Oracle
from koopdqn.pose import Array
from koopdqn.rl.actor_critic import ActorCritic
from koopdqn.rl.answers import FeedbackSettings
from koopdqn.rl.checks import Check, Checker, History, Progress
from koopdqn.rl.dqn import Learner, load_arrays
from koopdqn.rl.human_reward import Feedback
from koopdqn.rl.labelling import Choice, Motions, choice_among_known, label_known
from koopdqn.rl.network import QNetwork, observe, size
from koopdqn.rl.policy import Policy, policy_network
from koopdqn.rl.replay_buffer import Labelled, ReplayBuffer
from koopdqn.rl.settings import ActorCriticSettings, Agent, AgentSettings, TrainSettings
from koopdqn.rl.starts import StartSampler
from koopdqn.rl.vector_env import VectorEnv
from koopdqn.tasks.actions import COUNT, FIRST_TWIST, SUGGESTED, tolerances, twist_size
from koopdqn.tasks.moved_goals import trained_in
from koopdqn.tasks.task import Task
from koopdqn.tasks.workcell import Workcell

_COUNTERS = ("env_steps", "rounds")


def learner_of(agent: Agent, task: Task, rng: np.random.Generator) -> Learner | ActorCritic:
    """Return the learner of an agent's settings, with weights drawn from ``rng``."""
    if isinstance(agent, ActorCriticSettings):
        return ActorCritic(size(task), tolerances(task), agent, rng)
    assert isinstance(agent, AgentSettings), "the two kinds of agents"
    return Learner(size(task), agent, rng)


class Trainer:
    """Learns a task's path. Construct it, optionally :meth:`restore` a checkpoint, then :meth:`run` it.

    Attributes:
        history: of the training so far.
        learner: the networks.
        replay: the replay buffer.
        best: the policy arrays of the best check: most successes, of equal ones the nearest to the intent.
        feedback: the reward function, extended by answers.
        env_steps: actions tried so far: the number of stored transitions.
        env: the episodes.
        progress: the best check so far, and whether the task is learned.
    """

    def __init__(
        self,
        workcell: Workcell,
        reward: IntentReward,
        trajectories: list[Array],
        oracle: Oracle,
        agent: Agent,
        settings: TrainSettings,
        seed: int,
        feedback: FeedbackSettings,
        asking: Asking = Asking(),  # noqa: B008 (frozen)
    ) -> None:
        """Prepare a run.

        Args:
            workcell: task, arm and scene.
            reward: the task's reward function.
            trajectories: demonstrated poses (N, 7) at the agent's step, in the intent's start frame.
            oracle: answers where the model is not trusted.
            agent: settings of the agent.
            settings: when to check and to stop.
            seed: fixes everything.
            feedback: how far answers apply.
            asking: when questions are asked, and how many at most.
        """
        torch.set_num_threads(settings.threads)
        self.workcell = workcell
        self.agent = agent
        self.settings = settings
        self._task = workcell.task
        weights, self._explore_rng, self._batch_rng = (np.random.default_rng([seed, 2, i]) for i in range(3))
        self.learner = learner_of(agent, self._task, weights)
        self.learner.normalise_to(observe(np.concatenate(trajectories), self._task))
        twist, twists = (twist_size(self._task), agent.twists) if isinstance(agent, ActorCriticSettings) else (0, 0)
        self.replay = ReplayBuffer(agent.replay, size(self._task), twist, FIRST_TWIST + twists if twist else COUNT)
        self.feedback = Feedback(reward, oracle, feedback, asking, step_back=agent.step_back, replay=self.replay)
        self.step_limit = int(settings.step_limit_factor * max(len(trajectory) for trajectory in trajectories))
        known = trained_in(workcell)
        starts = StartSampler(known, reward.model.start_frame, trajectories, self.step_limit, agent)
        parallel = agent.episodes_at_once, self._explore_rng
        self.env = VectorEnv(known, self.feedback, starts, *parallel, asking, twists)
        # The paper's way labels an action when it is tried, and tries any.
        self._all_known = agent.trials == "all"
        self._checker = Checker(workcell, reward.model.fitted, settings, self.step_limit)
        self.history = History()
        self.progress = Progress()
        self.env_steps = 0
        self.rounds = 0
        self.best = self.learner.policy_arrays()
        self._losses: list[float] = []

    @property
    def policy(self) -> Policy:
        """The present policy."""
        return self._policy(self.learner.policy_network)

    def best_policy(self) -> Policy:
        """Return the policy with the arrays of :attr:`best`."""
        network = policy_network(self._task, self.agent.network, continuous=self.agent.continuous)
        load_arrays(network, self.best)
        return self._policy(network)

    def _policy(self, network: QNetwork) -> Policy:
        frame = self.feedback.reward.model.start_frame
        return Policy(network, self._task, frame, continuous=self.agent.continuous)

    @property
    def learned(self) -> bool:
        """Whether enough checks in a row were passed."""
        return self.progress.learned

    @property
    def checked_path(self) -> Array:
        """The poses (T, 7) of the policy of the latest check, from the first of its starts; empty before one."""
        return self._checker.path

    @property
    def questions(self) -> int:
        """Number of questions that reached the oracle so far."""
        return self.feedback.questions

    def run(
        self, on_check: Callable[[Check], None] = lambda check: None, on_round: Callable[[], None] = lambda: None
    ) -> None:
        """Train until learned or at a limit.

        ``on_check`` is called after every check, when the run may be saved, ``on_round`` after every step of all
        episodes.

        Raises:
            PauseRequested: whoever answers pauses the run.
        """
        while not self._finished():
            self.collect()
            due = self.env_steps >= self.agent.warm_up and self.rounds % self.agent.rounds_per_update == 0
            checks = self.train() if due else []
            self.rounds += 1
            # The state is complete between rounds only; a run saved within one could not be resumed.
            for check in checks:
                on_check(check)
            on_round()

    def collect(self) -> None:
        """Label what is known, then let every episode try one action.

        Raises:
            PauseRequested: whoever answers pauses the run.
        """
        twists = self.learner.propose(self.env.observations, self._explore_rng)
        evaluation = self.env.evaluate_actions(twists=twists)
        values = self.learner.ranking(observe(evaluation.local, self._task), evaluation)
        motions: Motions = {}
        if self._all_known:
            labelled, motions = label_known(self.env, evaluation)
            self._store(labelled)
        changes = self.feedback.changes
        for index in range(len(self.env.episodes)):
            again = True
            while again:
                if self.feedback.changes > changes:
                    # An answer, or its withdrawal, counts for the next question already.
                    changes, before = self.feedback.changes, evaluation
                    evaluation = self.env.evaluate_actions(twists=twists)
                    if self.agent.continuous:
                        self._suggest_anew(before, evaluation, motions)
                        values = self.learner.ranking(observe(evaluation.local, self._task), evaluation)
                # After a no the same pose is asked about until an action is right.
                again = self._try_one(index, evaluation, values[index], motions)

    def _suggest_anew(self, before: ActionEvaluation, evaluation: ActionEvaluation, motions: Motions) -> None:
        """Let every episode whose suggestion an answer has changed try the new one, with a motion of its own."""
        changed = (evaluation.reached[:, SUGGESTED] != before.reached[:, SUGGESTED]).any(axis=1)
        self.env.episodes.reopen(changed, SUGGESTED)
        for index in np.flatnonzero(changed):
            motions.pop((int(index), SUGGESTED), None)

    def train(self) -> list[Check]:
        """Make the updates of one round and return the checks made."""
        draw = self.replay.sample_states if self.agent.drawn == "states" else self.replay.sample
        checks = []
        for _ in range(self.agent.updates_per_round):
            self._losses.append(self.learner.update(draw(self._batch_rng, self.agent.batch)))
            if self.learner.updates % self.settings.check_every == 0:
                checks.append(self._check())
        return checks

    def _try_one(self, index: int, evaluation: ActionEvaluation, values: np.ndarray, motions: Motions) -> bool:
        """Let an episode try one action; return whether the answer was no and it should try another at once."""
        action, ask = self._choose(index, evaluation, values)
        if action is None:
            tried = self.env.episodes.tried[index] & ~self.env.episodes.stored[index]
            # Skipped questions may have been about right actions.
            if not tried.any():
                self.feedback.contradict(evaluation.local[index])
            self._end(index)
            return False
        attempt = self.env.try_action(index, action, evaluation, motions.get((index, action)), ask=ask)
        if attempt.new:
            self._store(Labelled.one(evaluation, index, action, truncated=attempt.truncated))
        if attempt.ended:
            self._end(index)
        wrong = attempt.reward is not None and attempt.reward < 0
        return attempt.asked and wrong and self._all_known and not self.feedback.stopped

    def _choose(self, index: int, evaluation: ActionEvaluation, values: np.ndarray) -> tuple[int | None, bool]:
        """Return the action an episode tries, or None if none is left, and whether to ask about it."""
        explore = self._explore_rng.random() < self.agent.epsilon(self.env_steps)
        if self._all_known:
            choice = choice_among_known(self.env, evaluation, index)
        else:
            choice = Choice(~self.env.episodes.tried[index])
        if not choice.allowed.any():
            return None, choice.ask
        if choice.ranking is None and explore:
            return int(self._explore_rng.choice(np.flatnonzero(choice.allowed))), choice.ask
        ranking = values if choice.ranking is None else choice.ranking
        return int(np.where(choice.allowed, ranking, -np.inf).argmax()), choice.ask

    def _store(self, labelled: Labelled) -> None:
        labelled.count(self.history, self._task)
        how = {"step_back": self.agent.step_back, "continuous": self.agent.continuous}
        self.replay.add(labelled.transitions(self._task, **how))
        self.env_steps += len(labelled.actions)

    def _end(self, index: int) -> None:
        """End an episode, ask the questions it put off, and begin another."""
        for labelled in self.env.answer_put_off(index):
            self._store(labelled)
        episodes = self.env.episodes
        self.history.rewards.append(float(episodes.rewards[index]))
        self.history.lengths.append(int(episodes.steps[index]))
        self.history.exploring.append(bool(episodes.exploring[index]))
        self.env.begin(index)

    def _check(self) -> Check:
        success, distance, failures = self._checker.measure(self.policy)
        made = self.learner.updates, self.env_steps, len(self.history.rewards)
        check = Check(*made, success, distance, failures)
        self.history.checks.append(check)
        self.history.losses.append(float(np.mean(self._losses)))
        self._losses.clear()
        if self.progress.astray(check, self.settings):
            return check
        best = self.progress.better(check)
        if best and self.learned:
            # What is learned gives way only to what is confirmed, too.
            rate, another_way = self._confirmed(self.policy)
            best = rate >= self.settings.check_success and not another_way
        self.progress.add(check, self.settings, best=best)
        if best:
            self.best = self.learner.policy_arrays()
        if self.progress.settled(self.settings):
            rate, another_way = self._confirmed(self.best_policy())
            self.progress.confirm(check, self.settings, rate, another_way=another_way)
        return check

    def _confirmed(self, policy: Policy) -> tuple[float, bool]:
        return self._checker.confirm(policy, self.feedback.reward.nearest_actions)

    def _finished(self) -> bool:
        if self.env_steps >= self.settings.max_steps or len(self.history.rewards) >= self.settings.max_episodes:
            return True
        if self.feedback.stopped:
            return True
        if not self.learned:
            return False
        if self.settings.stop == "learned":
            return True
        return self.settings.extend is not None and self.env_steps >= self.settings.extend * self.progress.learned_at

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return everything needed to resume a run: arrays and JSON values."""
        parts = {
            "learner": self.learner.state(),
            "replay": self.replay.state(),
            "episodes": self.env.episodes.state(),
            "put_off": self.env.put_off.state(),
            "best": self.best,
            "feedback": self.feedback.state(),
            "losses": {"recent": np.array(self._losses, dtype=np.float64)},
        }
        arrays = {f"{part}/{name}": values for part, state in parts.items() for name, values in state.items()}
        about = {
            "counters": {name: getattr(self, name) for name in _COUNTERS},
            "begun": self.env.begun,
            "progress": asdict(self.progress),
            "history": self.history.state(),
            "explore_rng": self._explore_rng.bit_generator.state,
            "batch_rng": self._batch_rng.bit_generator.state,
        }
        return arrays, about

    def restore(self, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> None:
        """Resume from what :meth:`state` returned."""
        self.learner.restore(below(arrays, "learner/"))
        self.replay.restore(below(arrays, "replay/"))
        self.env.episodes.restore(below(arrays, "episodes/"))
        self.env.put_off.restore(below(arrays, "put_off/"))
        self.best = below(arrays, "best/")
        self.feedback.restore(below(arrays, "feedback/"))
        self._losses = arrays["losses/recent"].tolist()
        for name in _COUNTERS:
            setattr(self, name, about["counters"][name])
        self.env.begun = about["begun"]
        self.progress = Progress(**about["progress"])
        self.history = History.restored(about["history"])
        self._explore_rng.bit_generator.state = about["explore_rng"]
        self._batch_rng.bit_generator.state = about["batch_rng"]
