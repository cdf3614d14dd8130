import numpy as np
import pytest
from parts import load_parts

from koopdqn.demonstrations.generate import generate
from koopdqn.errors import BadInputError
from koopdqn.evaluation.baselines import straight_path
from koopdqn.intent.fit import agent_steps, fit
from koopdqn.intent.reward import IntentReward
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.tasks.both_sides import BothSidesTask
from koopdqn.tasks.rollout import SUCCESS, follow, roll_out
from koopdqn.tasks.workcell import COLLISION, Workcell, open_workcell

PARTS = load_parts("task=both_sides")
# Of the compartment, half-way between its side walls [m].
MIDDLE_Y = 0.087


@pytest.fixture(scope="module")
def workcell() -> Workcell:
    return open_workcell(PARTS.task, PARTS.arm)


def task_of(workcell: Workcell) -> BothSidesTask:
    assert isinstance(workcell.task, BothSidesTask)
    return workcell.task


def test_starts_lie_on_either_side_by_their_share_and_demonstrations_on_one(workcell: Workcell) -> None:
    task = task_of(workcell)
    starts = task.draw_starts(np.random.default_rng(0), 2000)
    assert (starts[:, 1] > MIDDLE_Y).mean() == pytest.approx(task.other_share, abs=0.05)
    shown = generate(task, workcell.reachability, PARTS.demo, seed=1).demonstrations
    assert all(item.poses[0, 1] < MIDDLE_Y for item in shown.items)
    # A wider region is wider on both sides.
    wide = task.with_starts_scaled(2.0).draw_starts(np.random.default_rng(0), 2000)
    for side in (starts[:, 1] > MIDDLE_Y, starts[:, 1] < MIDDLE_Y):
        assert np.ptp(wide[side, 2]) > 1.8 * np.ptp(starts[side, 2])


def test_the_person_goes_around_the_wall_that_is_nearer_and_the_straight_line_hits_it(workcell: Workcell) -> None:
    task = task_of(workcell)
    starts, joints, _ = workcell.reachability.draw_starts(task, np.random.default_rng(2), 16)
    edge = task.compartment_corner_m[1], task.compartment_corner_m[1] + task.compartment_size_m[1]
    for start in starts:
        path = task.demonstrator.roll_out(start, 1000)
        assert task.reached(path[-1:])[0]
        assert workcell.reachability.follow(path)[1] == ""
        passed = path[np.argmin(path[:, 0]), 1]
        assert (passed < edge[0] + 0.05) if start[1] < MIDDLE_Y else (passed > edge[1] - 0.05)
    straight = [straight_path(start, task.goal, task) for start in starts]
    assert {episode.outcome for episode in follow(straight, task, workcell.reachability, joints)} == {COLLISION}


def test_the_other_way_must_end_at_the_goal() -> None:
    with pytest.raises(BadInputError, match="other_waypoints must end at the goal"):
        load_parts("task=both_sides", "task.other_waypoints=[[0.5,0.3,0.4],[0.5,0.1,0.4]]")


@pytest.mark.slow
def test_trusting_everywhere_collides_and_asking_rescues(workcell: Workcell) -> None:
    success, questions = {}, {}
    task = workcell.task
    shown = generate(task, workcell.reachability, PARTS.demo, seed=0).demonstrations
    starts, joints, _ = workcell.reachability.draw_starts(task, np.random.default_rng(5), 100)
    for name in ("tube", "everywhere"):
        trust = load_parts("task=both_sides", f"trust={name}").trust
        fitted = fit(shown, task, PARTS.intent, trust, PARTS.reward)
        reward = IntentReward(task, fitted.model, fitted.trust, PARTS.reward)
        trajectories = fitted.model.start_frame.each(agent_steps(shown, task))
        limit = PARTS.train.model_copy(update={"max_steps": 400_000})
        trainer = Trainer(workcell, reward, trajectories, ScriptedOracle(task), PARTS.agent, limit, 0, PARTS.feedback)
        trainer.run()
        found = roll_out(trainer.policy, task, workcell.reachability, starts, joints, trainer.step_limit)
        success[name] = np.mean([episode.outcome == SUCCESS for episode in found])
        questions[name] = trainer.questions
    assert success["tube"] >= 0.95
    assert questions["tube"] <= 60
    assert success["everywhere"] <= 0.5
    assert questions["everywhere"] == 0
