"""The trainer: Algorithm 1, the Koopman operator-based knowledge-guided DQN, over many episodes at once."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from koopdqn.intent.reward import ASKED, BY_MODEL, CERTIFIED, RULE, TRUSTED, IntentReward, Judgement
from koopdqn.oracles.base import Oracle, Place
from koopdqn.pose import Array
from koopdqn.rl.dqn import Learner
from koopdqn.rl.experience import Asking, Gathering, Trial, Tries, question_about, settled
from koopdqn.rl.exploring import start_sampler
from koopdqn.rl.history import Check, Checker, History
from koopdqn.rl.human_reward import Budget, Feedback, FeedbackSettings
from koopdqn.rl.network import observe, size
from koopdqn.rl.policy import Policy
from koopdqn.rl.replay_buffer import ReplayBuffer
from koopdqn.rl.settings import AgentSettings, TrainSettings
from koopdqn.rl.vector_env import EpisodeBatch
from koopdqn.tasks.reachability import Motion
from koopdqn.tasks.workcell import Workcell

# Below this [m, or of a quaternion's entries] two poses are one.
_SAME = 1e-12
_BEST = ("best_success", "best_distance", "best_update")
_COUNTERS = ("env_steps", "next_episode", "rounds", "learned_at", "passed", "settled", *_BEST)


class Trainer:
    """Learns a task's path. Make it, perhaps :meth:`restore` it, then :meth:`run` it.

    Attributes:
        history: what happened so far.
        learner: the networks.
        replay: the experience they learn from.
        best: the policy arrays of the best check so far: most successes, of equal ones the nearest to the intent.
        feedback: the reward function and what answers have taught.
        env_steps: actions tried so far: each transition that was stored.
        learned_at: ``env_steps`` when learned, or −1.
    """

    def __init__(
        self,
        workcell: Workcell,
        reward: IntentReward,
        trajectories: list[Array],
        oracle: Oracle,
        agent: AgentSettings,
        settings: TrainSettings,
        seed: int,
        feedback: FeedbackSettings,
        budget: Budget = Budget(),  # noqa: B008 (frozen)
        asking: Asking = Asking(),  # noqa: B008 (frozen)
    ) -> None:
        """Prepare a run.

        Args:
            workcell: task, arm and scene.
            reward: the task's reward function.
            trajectories: demonstrated poses (N, 7) at the agent's step, placed in the intent's frame.
            oracle: who answers where the model is not trusted.
            agent: how it learns.
            settings: when it stops.
            seed: fixes everything.
            feedback: what is made of answers.
            budget: how many questions may be asked.
            asking: when they are asked.
        """
        torch.set_num_threads(settings.threads)
        self.workcell = workcell
        self.feedback = Feedback(reward, oracle, feedback, budget, step_back=agent.step_back)
        self.agent = agent
        self.settings = settings
        self._task = workcell.task
        weights, self._explore_rng, self._batch_rng = (np.random.default_rng([seed, 2, i]) for i in range(3))
        self.learner = Learner(size(self._task), agent, weights)
        self.learner.normalise_to(observe(np.concatenate(trajectories), self._task))
        self.replay = ReplayBuffer(agent.replay, size(self._task))
        self.step_limit = int(settings.step_limit_factor * max(len(trajectory) for trajectory in trajectories))
        self._starts = start_sampler(workcell, reward.model.start_frame, trajectories, agent, self.step_limit)
        self._batch = EpisodeBatch.empty(agent.episodes_at_once)
        self._gathering = Gathering(asking, self.feedback, len(self._batch))
        self.next_episode = 0
        for index in range(len(self._batch)):
            self._begin(index)
        self._checker = Checker(workcell, reward.model.fitted, settings, self.step_limit)
        self.history = History()
        self.env_steps = 0
        self.rounds = 0
        self.learned_at = -1
        self.passed = 0
        self.settled = 0.0
        self.best_success = -1.0
        self.best_distance = 0.0
        self.best_update = 0
        self.best = self.learner.policy_arrays()
        self._losses: list[float] = []

    @property
    def policy(self) -> Policy:
        """The policy as it is now."""
        return Policy(self.learner.policy_network, self._task, self.feedback.reward.model.start_frame)

    @property
    def learned(self) -> bool:
        """Whether enough checks in a row were passed."""
        return self.learned_at >= 0

    @property
    def questions(self) -> int:
        """Questions that reached the oracle so far."""
        return self.feedback.questions

    def run(
        self,
        on_check: Callable[[Check], None] = lambda check: None,
        on_round: Callable[[], None] = lambda: None,
    ) -> None:
        """Train until learned or at a limit.

        Args:
            on_check: called after every check, when the run may be saved.
            on_round: called after every step of all episodes.
        """
        draw = self.replay.sample_states if self.agent.drawn == "states" else self.replay.sample
        while not self._finished():
            self._round()
            checks = []
            due = self.env_steps >= self.agent.warm_up and self.rounds % self.agent.rounds_per_update == 0
            for _ in range(self.agent.updates_per_round if due else 0):
                self._losses.append(self.learner.update(draw(self._batch_rng, self.agent.batch)))
                if self.learner.updates % self.settings.check_every == 0:
                    checks.append(self._check())
            self.rounds += 1
            # Only between rounds is the state whole: a run saved within one could not go on with its rest.
            for check in checks:
                on_check(check)
            on_round()

    def _finished(self) -> bool:
        if self.env_steps >= self.settings.max_steps or len(self.history.rewards) >= self.settings.max_episodes:
            return True
        if self.feedback.stopped:
            return True
        if not self.learned:
            return False
        return self.settings.stop == "learned" or self.env_steps >= self.settings.extend * self.learned_at

    def _begin(self, index: int) -> None:
        self._starts.begin(self._batch, index, self.next_episode, self._explore_rng)
        self.next_episode += 1

    def _round(self) -> None:
        """Let every episode try one action, after all that is known anyway where ``trials`` says so."""
        judgement = self._judge()
        observations = observe(judgement.placed, self._task)
        values = self.learner.online.values(observations)
        motions = self._try_known(judgement, observations) if self.agent.trials == "all" else {}
        changes = self.feedback.changes
        for index in range(len(self._batch)):
            refused = True
            while refused:
                if self.feedback.changes > changes:
                    # What an answer has taught, or an undo has taken back, holds for the next question already.
                    changes = self.feedback.changes
                    judgement = self._judge()
                # A no alone says little: the same place is asked about until something is right there.
                refused = self._act(index, judgement, values[index], observations[index], motions)

    def _judge(self) -> Judgement:
        return self.feedback.judge(self._batch.poses, self._batch.steps, self._batch.starts)

    def _try_known(self, judgement: Judgement, observations: np.ndarray) -> dict[tuple[int, int], Motion]:
        """Try whatever is known of every episode; return what became of the motions, by episode and action."""
        batch = self._batch
        mask = judgement.known & ~batch.stored
        rows, actions = np.nonzero(mask & (judgement.reward >= 0))
        moved = self.workcell.reachability.move_batch(judgement.reached[rows, actions], batch.joints[rows])
        motions = dict(zip(zip(rows.tolist(), actions.tolist(), strict=True), moved, strict=True))
        for (index, action), motion in motions.items():
            if motion.joints is None:
                self._refuse(judgement, index, action)
        rows, actions = np.nonzero(mask)
        places = batch.poses[rows], batch.starts[rows], batch.steps[rows]
        self._keep(Tries(judgement, rows, actions, observations[rows], *places))
        batch.stored[rows, actions] = True
        return motions

    def _refuse(self, judgement: Judgement, index: int, action: int) -> None:
        judgement.reward[index, action] = self.feedback.reward.value(False, False)
        judgement.known[index, action] = True
        judgement.source[index, action] = RULE

    def _act(
        self,
        index: int,
        judgement: Judgement,
        values: np.ndarray,
        observation: np.ndarray,
        motions: dict[tuple[int, int], Motion],
    ) -> bool:
        """Let an episode try one action; return whether it asked, was told no and has others to ask about."""
        batch = self._batch
        asked = False
        action = self._choose(judgement, index, values)
        if action is None:
            # A question without an answer may have been about what is right.
            if not (batch.tried[index] & ~batch.stored[index]).any():
                self.feedback.contradict(judgement.placed[index])
            self._end(index)
            return False
        places = batch.poses[index].copy(), batch.starts[index].copy()
        trial = Trial(int(batch.numbers[index]), int(batch.steps[index]), *places, action)
        motion = motions.get((index, action)) or self.workcell.reachability.move(
            judgement.reached[index, action], batch.joints[index]
        )
        if motion.joints is None:
            self._refuse(judgement, index, action)
        elif not judgement.known[index, action] or self._contested(judgement, index, action):
            if self._gathering.on:
                self._gather(index, trial, judgement, motion.joints)
                return False
            if not self._ask(trial, judgement, index):
                batch.tried[index, action] = True
                return False
            asked = True
            if judgement.source[index, action] != ASKED:
                # It was stored as the model's own opinion; what a person says is stored beside it.
                judgement.source[index, action] = ASKED
                batch.stored[index, action] = False
        reward = float(judgement.reward[index, action])
        right = reward >= 0
        moves = motion.joints is not None and (right or not self.agent.step_back)
        at_goal = moves and bool(judgement.at_goal[index, action])
        cut = moves and not at_goal and batch.steps[index] + 1 >= batch.limits[index]
        if not batch.stored[index, action] or self.agent.trials == "chosen":
            self._keep(Tries.of_one(trial, judgement, index, observation, cut=bool(cut)))
            batch.stored[index, action] = True
        batch.rewards[index] += reward
        if motion.joints is None or not moves:
            batch.tried[index, action] = True
            return asked and self.agent.trials == "all" and not self.feedback.stopped
        batch.move(index, judgement.reached[index, action], motion.joints)
        if at_goal or cut:
            self._end(index)
        return False

    def _choose(self, judgement: Judgement, index: int, values: np.ndarray) -> int | None:
        untried = ~self._batch.tried[index]
        explore = self._explore_rng.random() < self.agent.epsilon(self.env_steps)
        candidates = untried
        if self.agent.trials == "all":
            known_right = untried & judgement.known[index] & (judgement.reward[index] >= 0)
            if known_right.any():
                candidates = known_right
            elif self._blocked(judgement, index):
                return None
            else:
                # Nothing is known to be right here: ask, the likeliest by the model's opinion first, about all that
                # neither rules nor demonstrations nor answers about it exclude.
                unsure = (ASKED,) if self._gathering.on else (ASKED, CERTIFIED)
                candidates = untried & np.isin(judgement.source[index], unsure)
                values, explore = judgement.margin[index], False
        if not candidates.any():
            return None
        if explore:
            return int(self._explore_rng.choice(np.flatnonzero(candidates)))
        return int(np.where(candidates, values, -np.inf).argmax())

    def _blocked(self, judgement: Judgement, index: int) -> bool:
        """Return whether no person would know better: the arm cannot do what was thought right.

        That is so where demonstrations vouch for it, and near where a person was asked about all else in vain.
        """
        source, right = judgement.source[index], judgement.margin[index] >= 0
        refused = self._batch.tried[index] & right & np.isin(source, (RULE, *BY_MODEL))
        return bool(
            refused.any() and ((source == TRUSTED).any() or self.feedback.hopeless_near(judgement.placed[index]))
        )

    def _contested(self, judgement: Judgement, index: int, action: int) -> bool:
        """Return whether an action that only an answer elsewhere speaks against was chosen: nothing else is left."""
        certified = judgement.source[index, action] == CERTIFIED and judgement.reward[index, action] < 0
        return self.agent.trials == "all" and bool(certified)

    def _ask(self, trial: Trial, judgement: Judgement, row: int, place: Place | None = None) -> bool:
        """Ask the oracle; return whether it answered (a skip is not a no)."""
        question = question_about(trial, self.feedback.reward, judgement, row, place)
        outcome = self.feedback.ask(question, judgement, row, self.replay)
        placed = self.feedback.reward.model.start_frame.placed(self._batch.poses, self._batch.starts)
        for point, other in outcome.reopened:
            # To rounding: places that are told from another start are computed anew.
            self._batch.reopen(np.abs(placed - point).max(axis=1) < _SAME, other)
        return outcome.right is not None

    def _gather(self, index: int, trial: Trial, judgement: Judgement, joints: Array) -> None:
        """Put a question off to the end of its episode, and go on as if the action had been right."""
        batch = self._batch
        full = self._gathering.add(index, trial)
        batch.move(index, judgement.reached[index, trial.action], joints)
        if full or judgement.at_goal[index, trial.action] or batch.steps[index] >= batch.limits[index]:
            self._end(index)

    def _keep(self, tries: Tries) -> None:
        tries.tally(self.history, self._task)
        self.replay.add(tries.transitions(self._task, step_back=self.agent.step_back))
        self.env_steps += len(tries.actions)

    def _end(self, index: int) -> None:
        """End an episode, ask what it has gathered, and begin another."""
        batch = self._batch
        for tries in settled(self._gathering.take(index), self.feedback, self._ask, int(batch.limits[index])):
            self._keep(tries)
            batch.rewards[index] += float(tries.rewards[0])
        self.history.rewards.append(float(batch.rewards[index]))
        self.history.lengths.append(int(batch.steps[index]))
        self.history.exploring.append(bool(batch.exploring[index]))
        self._begin(index)

    def _check(self) -> Check:
        success, distance, failures = self._checker.measure(self.policy)
        made = self.learner.updates, self.env_steps, len(self.history.rewards)
        check = Check(*made, success, distance, failures)
        self.history.checks.append(check)
        self.history.losses.append(float(np.mean(self._losses)))
        self._losses.clear()
        if success < self.settings.check_success:
            self.passed = 0
        elif self.passed and distance >= (1.0 - self.settings.gain) * self.settled:
            self.passed += 1
        else:
            self.passed, self.settled = 1, distance
        if (success, -distance) >= (self.best_success, -self.best_distance):
            self.best_success, self.best_distance, self.best_update = success, distance, self.learner.updates
            self.best = self.learner.policy_arrays()
        if not self.learned and self.passed >= self.settings.checks_to_learn:
            self.learned_at = self.env_steps
        return check

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return everything a run needs to go on: arrays and JSON values."""
        parts = {
            "learner": self.learner.state(),
            "replay": self.replay.state(),
            "episodes": self._batch.state(),
            "gathered": self._gathering.state(),
            "best": self.best,
            "feedback": self.feedback.state(),
            "losses": {"recent": np.array(self._losses, dtype=np.float64)},
        }
        arrays = {f"{part}/{name}": values for part, state in parts.items() for name, values in state.items()}
        about = {
            "counters": {name: getattr(self, name) for name in _COUNTERS},
            "history": self.history.state(),
            "explore_rng": self._explore_rng.bit_generator.state,
            "batch_rng": self._batch_rng.bit_generator.state,
        }
        return arrays, about

    def restore(self, arrays: dict[str, np.ndarray], about: dict[str, Any]) -> None:
        """Go on from what :meth:`state` returned."""

        def part(name: str) -> dict[str, np.ndarray]:
            prefix = f"{name}/"
            return {key.removeprefix(prefix): values for key, values in arrays.items() if key.startswith(prefix)}

        self.learner.restore(part("learner"))
        self.replay.restore(part("replay"))
        self._batch.restore(part("episodes"))
        self._gathering.restore(part("gathered"))
        self.best = part("best")
        self.feedback.restore(part("feedback"))
        self._losses = part("losses")["recent"].tolist()
        for name in _COUNTERS:
            setattr(self, name, about["counters"][name])
        self.history = History.restored(about["history"])
        self._explore_rng.bit_generator.state = about["explore_rng"]
        self._batch_rng.bit_generator.state = about["batch_rng"]
