"""Learners of Stable-Baselines3 on koopdqn's environment, as the study measures them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imitate import PEERS, main
from imitation.peers import Peer
from small_run import SMALL

import koopdqn.gym
from koopdqn.oracles.base import Answer, Oracle, Question


class Counted(Oracle):
    """Says yes to everything, and counts."""

    asked = 0

    def answer(self, question: Question) -> Answer:
        self.asked += 1
        return Answer(True, "counted")


@pytest.mark.parametrize("name", PEERS)
def test_a_peer_gives_an_action_of_its_kind_for_every_pose_and_the_same_for_the_same_seed(name: str) -> None:
    actions = "continuous" if name == "sb3-sac" else "table1"
    parts = koopdqn.gym.environment_parts("shelf", [*SMALL, "trust=nowhere"], actions=actions)
    starts, _, _ = parts.workcell.reachability.draw_starts(parts.workcell.task, np.random.default_rng(0), 5)
    oracle = Counted()
    first = Peer(name, replace(parts, oracle=oracle), 0, steps=256)
    assert first.questions == oracle.asked > 0
    assert first.env_steps >= 256
    chosen = first(starts, starts)
    assert chosen.shape == ((5, 3) if actions == "continuous" else (5,))
    again = Peer(name, replace(parts, oracle=Counted()), 0, steps=256)
    np.testing.assert_array_equal(again(starts, starts), chosen)


def test_imitating_writes_over_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "eval.json").write_text("{}")
    assert main(["method=dmp", "run=nowhere", f"out={tmp_path}"]) == 2
    assert "out: must name a new or an empty folder" in capsys.readouterr().err
    assert (tmp_path / "eval.json").read_text() == "{}"
