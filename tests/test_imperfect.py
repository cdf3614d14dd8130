from dataclasses import replace

import pytest
from parts import Clerk
from questions import question

from koopdqn.oracles.scripted import ImperfectOracle

COUNT = 400


def answers(wrong: float, silent: float, seed: int = 0) -> list[bool | None]:
    oracle = ImperfectOracle(Clerk(), wrong, silent, seed)
    return [oracle.answer(replace(question(0), number=number)).right for number in range(COUNT)]


@pytest.mark.parametrize(("wrong", "silent"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.1, 0.3), (0.3, 0.0)])
def test_it_errs_and_skips_as_often_as_it_should(wrong: float, silent: float) -> None:
    said = answers(wrong, silent)
    spoken = [right for right in said if right is not None]
    # Three standard deviations of a share of some hundreds are under 0.08.
    assert said.count(None) / COUNT == pytest.approx(silent, abs=0.08)
    assert not spoken or spoken.count(False) / len(spoken) == pytest.approx(wrong, abs=0.08)


def test_what_it_does_depends_on_seed_and_number_alone() -> None:
    whole = answers(0.5, 0.2)
    oracle = ImperfectOracle(Clerk(), 0.5, 0.2, 0)
    late = [oracle.answer(replace(question(1), number=number)).right for number in range(200, COUNT)]
    assert late == whole[200:]
    assert answers(0.5, 0.2, seed=1) != whole


def test_its_answers_can_be_written_down() -> None:
    """A journal takes Python's booleans alone."""
    assert {type(right) for right in answers(0.5, 0.2)} == {bool, type(None)}
