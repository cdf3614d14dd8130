import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import Parts, load_parts

from koopdqn.artifact import described
from koopdqn.errors import BadInputError
from koopdqn.intent.box import BoxSettings
from koopdqn.rl.settings import AgentSettings, TrainSettings
from koopdqn.settings import load_settings


@given(steps=st.integers(0, 10**7), more=st.integers(0, 10**6))
def test_epsilon_falls_from_start_to_end_and_stays(parts: Parts, steps: int, more: int) -> None:
    agent = parts.agent
    low, high = sorted((agent.epsilon_start, agent.epsilon_end))
    assert low <= agent.epsilon(steps) <= high
    assert agent.epsilon(steps + more) <= agent.epsilon(steps) + 1e-12


def test_epsilon_at_its_ends_and_half_way(parts: Parts) -> None:
    agent = parts.agent.model_copy(update={"epsilon_start": 0.9, "epsilon_end": 0.1, "epsilon_steps": 1000})
    assert agent.epsilon(0) == pytest.approx(0.9)
    assert agent.epsilon(500) == pytest.approx(0.5)
    assert agent.epsilon(1000) == agent.epsilon(10**9) == pytest.approx(0.1)


def test_the_paper_preset_is_table_a1(paper: Parts) -> None:
    agent = paper.agent
    assert agent.network.hidden == (1024, 1024)
    assert agent.network.fourier_features == 0
    assert (agent.learning_rate, agent.replay, agent.batch, agent.double) == (1e-5, 10_000, 1000, False)
    assert paper.train.max_episodes == 1500
    assert (paper.reward.shape, paper.reward.prediction) == ("sign", "raw")
    assert isinstance(paper.trust, BoxSettings)
    assert (paper.trust.matching, paper.trust.needs) == ("step", "reached")
    assert paper.task.goal_tolerance_m == 0.005
    assert paper.task.position_tolerance_m == 0.002


@pytest.mark.parametrize(
    ("field", "value"),
    [("gamma", 1.0), ("batch", 0), ("target_rate", 0.0), ("trials", "some"), ("epsilon_start", 1.2)],
)
def test_settings_of_the_agent_outside_their_range_are_refused(parts: Parts, field: str, value: object) -> None:
    with pytest.raises(BadInputError, match=f"agent.{field}"):
        load_settings(described(parts.agent) | {field: value}, AgentSettings, "agent")


@pytest.mark.parametrize(
    ("field", "value"), [("check_starts", 19), ("step_limit_factor", 2.9), ("extend", 0.5), ("stop", "now")]
)
def test_settings_of_training_outside_their_range_are_refused(parts: Parts, field: str, value: object) -> None:
    with pytest.raises(BadInputError, match=f"train.{field}"):
        load_settings(described(parts.train) | {field: value}, TrainSettings, "train")


def test_trying_all_actions_without_stepping_back_is_refused() -> None:
    with pytest.raises(BadInputError, match="trials=all must go with step_back=true"):
        load_parts("agent.trials=all", "agent.step_back=false")
