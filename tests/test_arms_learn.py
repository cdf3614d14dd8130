"""Other arms learn the shelf; slow, run by `make learn`."""

from pathlib import Path

import pytest

from koopdqn.app import api

SEVEN = Path(__file__).with_name("seven.xml")
ARMS = {
    "ur3": ["robot=ur3"],
    "ur5e": ["robot=ur5e"],
    "ur10": ["robot=ur10"],
    "seven": ["robot=mjcf", f"robot.path='{SEVEN}'", "robot.site=flange"],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ARMS)
def test_an_arm_learns_the_shelf(name: str) -> None:
    config = api.load_config("task=shelf", *ARMS[name], "eval.baselines=false", "eval.dynamics_episodes=2")
    demonstrations = api.generate(config)
    intent = api.fit(config, demonstrations)
    trained = api.train(config, demonstrations, intent)
    assert trained.learned
    assert api.evaluate(config, demonstrations, intent, trained).report["success_rate"] >= 0.95
