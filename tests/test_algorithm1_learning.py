"""Learning a whole task for real; slow, run by `make learn`."""

import numpy as np
import pytest
from parts import Parts

from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.rl.policy import Policy
from koopdqn.tasks.rollout import SUCCESS, roll_out
from koopdqn.tasks.workcell import Workcell


@pytest.mark.slow
def test_the_shelf_is_learned_and_held_on_starts_never_seen(
    parts: Parts, workcell: Workcell, reward: IntentReward, trajectories: list[Array]
) -> None:
    oracle = ScriptedOracle(workcell.task)
    trainer = Trainer(workcell, reward, trajectories, oracle, parts.agent, parts.train, 0, parts.feedback)
    trainer.run()
    assert trainer.learned
    for name in ("trusted", "remembered", "asked"):
        share = trainer.history.agreement()[name]
        assert share is None or share > 0.9
    starts, joints, _ = workcell.reachability.draw_starts(workcell.task, np.random.default_rng(987), 100)
    policy = Policy(trainer.learner.online, workcell.task)
    episodes = roll_out(policy, workcell.task, workcell.reachability, starts, joints, trainer.step_limit)
    assert np.mean([episode.outcome == SUCCESS for episode in episodes]) >= 0.95
