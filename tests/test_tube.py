from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from parts import load_parts

from koopdqn import pose
from koopdqn.intent.fit import path_coverage
from koopdqn.intent.tube import Tube, TubeSettings
from koopdqn.pose import Array

HELD = np.array([1.0, 0.0, 0.0, 0.0])
FRAME = np.array([HELD, HELD])


@cache
def default() -> TubeSettings:
    trust = load_parts().trust
    assert isinstance(trust, TubeSettings)
    return trust


def person(rng: np.random.Generator, count: int) -> list[Array]:
    """Demonstrations 0.4 m along x that wander sideways by some millimetres, to one goal."""
    share = np.linspace(0.0, 1.0, 201)
    waves = np.stack([np.cos(0.5 * np.pi * share), np.sin(np.pi * share), np.sin(2 * np.pi * share)])
    sideways = 0.004 * rng.normal(size=(count, 2, 3)) @ waves
    paths = [np.stack([0.4 * share, *rows], axis=1) for rows in sideways]
    return [pose.make(path, HELD) for path in paths]


def all_right(shown: list[Array]) -> list[Array]:
    return [np.ones((len(rows) - 1, len(default().doubts), 2)) for rows in shown]


def tube(shown: list[Array], signs: list[Array] | None = None) -> Tube:
    drawn = default().fit(shown, signs or all_right(shown), FRAME)
    assert isinstance(drawn, Tube)
    return drawn


def test_whole_new_demonstrations_are_held_as_often_as_stated() -> None:
    held, ratios = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        drawn = tube(person(rng, 5))
        held.append(path_coverage(drawn, person(rng, 50)))
        ratios.append(np.median(drawn.radius[:, 0]) / np.median(drawn.spread[:, 0]))
    assert default().nominal(person(np.random.default_rng(0), 5)) == pytest.approx(5 / 6)
    assert np.mean(held) >= 5 / 6 - 0.05
    assert np.median(ratios) <= 3.0


def test_demonstrations_allow_no_more_than_their_number() -> None:
    many = person(np.random.default_rng(0), 40)
    assert [default().nominal(many[:count]) for count in (1, 2, 4)] == [None, None, 4 / 5]
    assert default().nominal(many) == pytest.approx(37 / 41)


def test_a_single_demonstration_has_a_tube_of_fixed_radius() -> None:
    [shown] = person(np.random.default_rng(0), 1)
    drawn = tube([shown])
    np.testing.assert_array_equal(drawn.radius[:, 0], default().fixed_radius_m)
    aside = shown.copy()
    for far, contained in ((0.9, True), (1.2, False)):
        aside[:, 2] = shown[:, 2] + far * default().fixed_radius_m
        assert drawn.contains(aside, np.zeros(len(aside), dtype=int)).all() == contained


@pytest.mark.parametrize(("alike", "aside"), [(5, 0.1), (3, 0.1), (5, 0.02), (8, 0.3)])
def test_one_odd_demonstration_among_many_alike_counts_once(alike: int, aside: float) -> None:
    rng = np.random.default_rng(0)
    [path] = person(rng, 1)
    shown = [path + 2e-4 * np.array([*rng.normal(size=3), 0, 0, 0, 0]) for _ in range(alike)]
    odd = path.copy()
    odd[:, 2] += aside * np.exp(-(((np.linspace(0.0, 1.0, len(path)) - 0.5) / 0.1) ** 2))
    drawn = tube([*shown, odd])
    steps = np.zeros(len(odd), dtype=int)
    assert drawn.contains(odd, steps).all()
    covered = default().nominal([*shown, odd])
    assert covered is not None
    assert covered <= default().rank(alike + 1) / (alike + 2)
    assert drawn.radius[:, 0].max() < 2.0 * aside
    assert not drawn.contains(path + np.array([0.0, 0.0, 2.5 * aside, 0, 0, 0, 0]), steps).any()


def test_an_odd_one_that_is_not_held_whole_is_not_counted_as_covered() -> None:
    rng = np.random.default_rng(0)
    [path] = person(rng, 1)
    shown = [path + 2e-4 * np.array([*rng.normal(size=3), 0, 0, 0, 0]) for _ in range(4)]
    odd = path.copy()
    # Far off over so short a stretch that the spread, averaged along the path, is small there.
    odd[95:106, 2] += 0.3
    assert default().nominal([*shown, odd]) == pytest.approx(4 / 6)


def test_two_that_turn_at_other_times_differ_in_their_turn_alone() -> None:
    [early, late] = [path.copy() for path in person(np.random.default_rng(0), 1) * 2]
    for path, begin in ((early, 0.2), (late, 0.4)):
        angle = np.clip((np.linspace(0.0, 1.0, len(path)) - begin) / 0.4, 0.0, 1.0)
        path[:, 3:] = pose.from_rotation_vector(angle[:, None] * [1.0, 0.0, 0.0])
    early[:, 1] += 0.003
    drawn = tube([early, late])
    assert drawn.radius[:, 0].max() == default().fixed_radius_m
    assert drawn.radius[:, 1].min() > 0.2
    early[:, 1] += 0.04
    assert tube([early, late]).radius[:, 0].min() > 0.04
    [path] = person(np.random.default_rng(0), 1)
    alike = tube([path, path])
    np.testing.assert_array_equal(
        alike.radius, np.tile([default().fixed_radius_m, default().fixed_radius_rad], (len(alike.radius), 1))
    )


@settings(max_examples=30)
@given(seed=st.integers(0, 50), turn=st.floats(0.0, 0.3), error=st.booleans())
def test_distance_reason_and_inside_agree(seed: int, turn: float, error: bool) -> None:
    rng = np.random.default_rng(seed)
    shown = person(rng, 4)
    signs = all_right(shown)
    if error:
        signs[0][50:120, :, 0] = 0.0
    drawn = tube(shown, signs)
    positions = rng.uniform([-0.05, -0.03, -0.03], [0.45, 0.03, 0.03], (40, 3))
    points = pose.make(positions, pose.from_rotation_vector([turn, 0.0, 0.0]))
    steps = np.zeros(40, dtype=int)
    contained, far = drawn.contains(points, steps), drawn.distance(points)
    assert not np.any(contained & (far > 1.0 + 1e-9))
    if not error:
        np.testing.assert_array_equal(contained[np.abs(far - 1) > 1e-9], (far < 1.0)[np.abs(far - 1) > 1e-9])
    for point, trusted in zip(points, contained, strict=True):
        assert (drawn.outside(point, 0) == "") == trusted


def test_where_rewards_are_wrong_it_is_the_nearest_place_that_counts() -> None:
    shown = person(np.random.default_rng(0), 4)
    signs = all_right(shown)
    for each in signs[1:]:
        each[100:120, :, 0] = 0.0
    drawn = tube(shown, signs)
    contained = drawn.contains(shown[2], np.zeros(len(shown[2]), dtype=int))
    assert not contained[102:118].any()
    # The share is that of the places up to 20 mm, ten steps, around.
    assert contained[:85].all()
    assert contained[135:].all()
    assert "rewards here are right" in drawn.outside(shown[2][110], 0)


def test_what_demonstrations_say_goes_before_answers() -> None:
    shown = person(np.random.default_rng(0), 4)
    signs = all_right(shown)
    for each in signs:
        each[100:120, :, 0] = 0.0
    drawn = tube(shown, signs)
    wider = drawn.extended(shown[0][110:111], np.array([0.2]))
    steps = np.zeros(2, dtype=int)
    here, aside = shown[0][[110, 60]], shown[0][[110, 60]] + np.array([0, 0.1, 0, 0, 0, 0, 0])
    assert wider.contains(here, steps).tolist() == [False, True]
    trust = wider.assess(np.concatenate([here, aside]), np.zeros(4, dtype=int))
    assert trust.demonstrated.tolist() == [False, True, False, False]
    assert trust.certified.tolist() == [False, False, True, True]


def test_a_ball_beside_the_tube_is_trusted() -> None:
    shown = person(np.random.default_rng(0), 4)
    drawn = tube(shown)
    step = np.array([0])
    aside = shown[0] + np.array([0, 0, 0.1, 0, 0, 0, 0])
    wider = drawn.extended(aside[50:51], np.array([0.01]))
    assert not drawn.contains(aside[50:51], step)[0]
    assert wider.contains(aside[52:53], step)[0]
    assert not wider.contains(aside[80:81], step)[0]
