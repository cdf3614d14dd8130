"""The parts of the DQN that only their measurement has, and the table of it."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers_training import small_trainer
from parts import Parts, load_parts
from test_replay import numbered

from koopdqn.dqn.settings import AgentSettings
from koopdqn.environment.reward import IntentReward
from koopdqn.pose import Array
from koopdqn.workcell import Workcell

# The Makefile runs scripts as files, which puts their folder first on the path.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scripts"))

import dqn_parts
from dqn_variants import DEFAULT, PARTS, AnswersOftenReplay, DuelingNetwork, Part, PrioritisedReplay

RESULT = {
    "task": "shelf",
    "seed": 0,
    "part": DEFAULT,
    "learned": True,
    "updates": 1800,
    "success_rate": 0.97,
    "path_deviation_mm": 4.94,
    "p95_of_max_mm": None,
    "questions": 14,
    "seconds": 21.4,
}


@pytest.fixture(scope="module")
def agent(parts: Parts) -> AgentSettings:
    network = parts.agent.network.model_copy(update={"hidden": (16, 8), "fourier_features": 4})
    return parts.agent.model_copy(update={"network": network})


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_a_part_changes_something(part: Part) -> None:
    assert (part.name == DEFAULT) == (load_parts(*part.overrides).agent == load_parts().agent and part is PARTS[0])


@pytest.mark.parametrize("part", [part for part in PARTS if not part.overrides], ids=lambda part: part.name)
def test_what_no_setting_changes_changes_what_is_learned(
    parts: Parts, workcell: Workcell, reward: IntentReward, trajectories: list[Array], part: Part
) -> None:
    learned = []
    for change in (PARTS[0].change, part.change):
        # Trusted nowhere far from the demonstrations, so that answers are among what is drawn.
        trainer = small_trainer(parts, workcell, reward, trajectories, agent={"exploring_spread_m": 0.02})
        change(trainer, [rows[-20:] for rows in trajectories[:3]])
        trainer.run()
        assert trainer.questions > 0
        learned.append(trainer.learner.online.values(trainer.replay.held().observations[:20]))
    assert np.array_equal(*learned) == (part.name == DEFAULT)


def test_dueling_advantages_have_no_mean(agent: AgentSettings) -> None:
    network = DuelingNetwork(5, agent.network, np.random.default_rng(0))
    observations = torch.from_numpy(np.random.default_rng(1).normal(size=(7, 5)).astype(np.float32))
    hidden = network.layers[:-1](network.features(observations))
    torch.testing.assert_close(network(observations).mean(dim=1), network.value(hidden).squeeze(1))
    advantages = network.layers[-1](hidden)
    torch.testing.assert_close(network(observations).argmax(dim=1), advantages.argmax(dim=1))


def test_prioritised_states_are_drawn_in_proportion_to_their_priority() -> None:
    buffer = PrioritisedReplay(20, 2)
    buffer.add(numbered(list(range(10))))
    buffer.priorities[:10] = np.arange(10)
    counts = np.bincount(buffer.draw(np.random.default_rng(0), 45_000), minlength=10)
    np.testing.assert_allclose(counts, 1000 * np.arange(10), atol=350)
    buffer.add(numbered([10]))
    assert buffer.priorities[10] == 9


def test_what_rests_on_answers_is_drawn_ten_times_as_often() -> None:
    buffer = AnswersOftenReplay(20, 2)
    buffer.add(numbered(list(range(10))))
    # numbered() gives answers n − 3, and −1 stands for none.
    counts = np.bincount(buffer.draw(np.random.default_rng(0), 91_000), minlength=10)
    assert counts[2] == pytest.approx(1000, rel=0.2)
    np.testing.assert_allclose(np.delete(counts, 2), 10_000, rtol=0.06)


def test_the_table_says_what_was_found_and_leaves_out_what_was_not() -> None:
    lines = dqn_parts.table([RESULT, {**RESULT, "part": "online", "learned": False}]).splitlines()
    assert lines[2] == "| the default |  | yes | 1,800 | 97 | 4.9 | – | 14 | 21 |"
    assert lines[3].startswith("| the online network as the policy | `agent.policy_network=online` | no |")
    assert len(lines) == 4


def test_the_page_has_a_place_for_every_case(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text((dqn_parts.PAGE.resolve()).read_text(encoding="utf-8"), encoding="utf-8")
    results = [
        {**RESULT, "task": task, "seed": seed, "questions": 777 + case}
        for case, (task, seed) in enumerate(dqn_parts.CASES)
    ]
    dqn_parts.write_page(results, page)
    written = page.read_text(encoding="utf-8")
    for case, (task, seed) in enumerate(dqn_parts.CASES):
        section = written.partition(f"begin: parts, {task} {seed} -->")[2].partition("end: parts")[0]
        assert f"| {777 + case} |" in section
