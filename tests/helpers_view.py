"""Motions of the shelf, greedy in the policy's place, for the tests of what shows them."""

from functools import cache

from helpers_shelf import reward_of, shelf, taught
from parts import as_demonstrations, load_parts

from koopdqn.evaluation.baselines import Greedy
from koopdqn.evaluation.schema import EvaluationSettings
from koopdqn.oracles.scripted import ScriptedOracle
from koopdqn.pose import POSITION
from koopdqn.rl.human_reward import Feedback
from koopdqn.view.motions import Motion, demonstrated_motions, learned_motions
from koopdqn.view.page import Shown

SETTINGS = EvaluationSettings(
    episodes=2,
    seed=2000,
    start_scale=1.0,
    dynamics=False,
    dynamics_episodes=1,
    time_scale=1.0,
    baselines=False,
    video=False,
)


@cache
def motions() -> tuple[Motion, ...]:
    """Two learned motions, each followed by the intent's own, then the demonstrations."""
    known = taught()
    feedback = Feedback(reward_of(known), ScriptedOracle(shelf().task), load_parts().feedback)
    greedy = Greedy(known.model, shelf().task)
    learned = learned_motions(shelf(), greedy, feedback, SETTINGS, 2, 700, referred=True)
    items = as_demonstrations("shelf", known.trajectories).items
    return (*learned, *demonstrated_motions(items, shelf().reachability, shelf().task, 12))


@cache
def shown() -> Shown:
    """The page's content."""
    known = taught()
    tracks = [poses[:, POSITION] for poses in known.trajectories]
    scene, goal = shelf().scene, shelf().task.goal
    return Shown("a </script> title", ("one line",), scene, motions(), tracks, reward_of(known).trust, goal)
