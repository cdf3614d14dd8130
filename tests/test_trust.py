from functools import cache
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from parts import load_parts

from koopdqn import pose
from koopdqn.intent.box import Box, BoxSettings
from koopdqn.intent.fit import Fitted, path_coverage
from koopdqn.intent.trust import COMPONENTS, calibrate
from koopdqn.pose import Array
from koopdqn.tasks.shelf import ShelfTask

Matching = Literal["step", "any"]
FRAME = np.array([[1.0, 0, 0, 0], [1.0, 0, 0, 0]])
MATCHINGS: list[Matching] = ["step", "any"]


@cache
def _default() -> BoxSettings:
    trust = load_parts("trust=box").trust
    assert isinstance(trust, BoxSettings)
    return trust


def settings(matching: Matching, sigmas: float = 3.0, floor: float = 0.002) -> BoxSettings:
    changes = {
        "matching": matching,
        "sigmas": sigmas,
        "position_floor_m": floor,
        "rotation_floor_rad": 5 * floor,
    }
    return _default().model_copy(update=changes)


def lines(offsets: list[float], count: int = 11) -> list[Array]:
    """Parallel straight trajectories along x, a sample a centimetre, at offsets [m] along y."""
    x = 0.01 * np.arange(count)
    return [pose.make(np.stack([x, np.full(count, y), np.zeros(count)], axis=1), FRAME[0]) for y in offsets]


def all_right(trajectories: list[Array]) -> list[Array]:
    return [np.ones((len(trajectory) - 1, len(_default().doubts), 2)) for trajectory in trajectories]


def domain(matching: Matching, sigmas: float = 3.0, signs: list[Array] | None = None) -> Box:
    return drawn_around(lines([-0.004, 0.0, 0.004]), settings(matching, sigmas), signs)


def drawn_around(shown: list[Array], chosen: BoxSettings, signs: list[Array] | None = None) -> Box:
    box = chosen.fit(shown, signs or all_right(shown), FRAME)
    assert isinstance(box, Box)
    return box


def test_whole_paths_are_covered_as_the_domain_matches_steps() -> None:
    shown = lines([-0.004, 0.0, 0.004])
    # The same way, but later: at each step elsewhere than the demonstrations were.
    late = np.concatenate([np.repeat(shown[1][:1], 5, axis=0), shown[1][:-5]])
    assert path_coverage(domain("any"), [shown[1], late]) == 1.0
    assert path_coverage(domain("step"), [shown[1], late]) == 0.5


def at(x: float, y: float = 0.0, z: float = 0.0, turn: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
    return pose.make([x, y, z], pose.from_roll_pitch_yaw(turn))[None]


@pytest.mark.parametrize("matching", MATCHINGS)
def test_mean_and_deviation_are_those_of_each_step(matching: Matching) -> None:
    drawn = domain(matching)
    np.testing.assert_allclose(drawn.mean[:, 0], 0.01 * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(drawn.mean[:, 1:], 0.0, atol=1e-12)
    np.testing.assert_allclose(drawn.deviation[:, 1], np.std([-0.004, 0.0, 0.004]), atol=1e-9)
    np.testing.assert_allclose(drawn.deviation[:, [0, 2]], 0.002)
    np.testing.assert_allclose(drawn.deviation[:, 3:], 0.01)


@pytest.mark.parametrize("matching", MATCHINGS)
def test_demonstrated_states_are_inside(matching: Matching) -> None:
    drawn = domain(matching)
    for trajectory in lines([-0.004, 0.0, 0.004]):
        assert drawn.contains(trajectory, np.arange(11)).all()


def test_nearly_every_demonstrated_state_of_the_shelf_is_inside(
    fitted: Fitted, trajectories: list[Array], shelf_task: ShelfTask
) -> None:
    contained = [fitted.trust.contains(rows, np.arange(len(rows))).mean() for rows in trajectories]
    assert np.mean(contained) > 0.95
    far = shelf_task.draw_starts(np.random.default_rng(0), 50)
    far[:, 2] += 0.3
    assert not fitted.trust.contains(far, np.zeros(50, dtype=int)).any()


@pytest.mark.parametrize("matching", MATCHINGS)
@pytest.mark.parametrize(
    ("point", "name"),
    [
        (at(0.05, 0.05), "y"),
        (at(0.05, 0.0, -0.019), "z"),
        (at(0.5), "x"),
        (at(0.05, turn=(0.09, 0.0, 0.0)), "roll"),
        (at(0.05, turn=(0.0, -0.09, 0.0)), "pitch"),
        (at(0.05, turn=(0.0, 0.0, 0.09)), "yaw"),
    ],
)
def test_states_far_off_in_any_component_are_outside_and_the_component_is_named(
    matching: Matching, point: Array, name: str
) -> None:
    drawn = domain(matching)
    assert not drawn.contains(point, np.array([5]))[0]
    assert drawn.outside(point[0], 5).startswith(f"{name} is ")
    assert "limit 3" in drawn.outside(point[0], 5)


@given(
    matching=st.sampled_from(MATCHINGS),
    sigmas=st.floats(0.1, 5),
    more=st.floats(1.0, 3),
    seed=st.integers(0, 1000),
)
def test_more_sigmas_never_trust_less(matching: Matching, sigmas: float, more: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = pose.make(
        rng.uniform([-0.02, -0.02, -0.02], [0.12, 0.02, 0.02], (50, 3)),
        pose.from_rotation_vector(0.02 * rng.normal(size=(50, 3))),
    )
    steps = rng.integers(0, 14, 50)
    narrow, wide = (domain(matching, k).contains(points, steps) for k in (sigmas, sigmas * more))
    assert np.all(wide | ~narrow)


@given(x=st.floats(-0.03, 0.13), step=st.integers(0, 20))
def test_matching_by_step_asks_for_that_step_and_matching_any_for_none(x: float, step: int) -> None:
    point, steps = at(x), np.array([step])
    # A floor of 2 mm, three times, at means a centimetre apart.
    mean = 0.01 * min(step, 10)
    if abs(abs(x - mean) - 0.006) > 1e-9:
        assert domain("step").contains(point, steps)[0] == (abs(x - mean) <= 0.006)
    nearest = np.abs(x - 0.01 * np.arange(11)).min()
    if abs(nearest - 0.006) > 1e-9:
        assert domain("any").contains(point, steps)[0] == (nearest <= 0.006)


def test_matching_by_step_takes_the_demonstrations_that_have_the_step() -> None:
    short, long = lines([0.0], 6)[0], lines([0.01], 11)[0]
    drawn = drawn_around([short, long], settings("step"))
    np.testing.assert_allclose(drawn.mean[:6, 1], 0.005)
    np.testing.assert_allclose(drawn.mean[6:, 1], 0.01)
    np.testing.assert_allclose(drawn.deviation[:6, 1], 0.005)


def test_matching_any_aligns_demonstrations_of_different_length() -> None:
    slow, fast = lines([0.0], 11)[0], lines([0.0], 11)[0][::2]
    drawn = drawn_around([slow, fast], settings("any"))
    np.testing.assert_allclose(drawn.mean[:, 0], 0.01 * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(drawn.deviation[:, 0], 0.002)


@pytest.mark.parametrize("matching", MATCHINGS)
def test_where_rewards_are_clearly_wrong_too_often_nothing_is_trusted(matching: Matching) -> None:
    signs = all_right(lines([0, 0, 0]))
    for each in signs:
        each[5, :, 0] = 0.5
    drawn = domain(matching, 2.0, signs)
    np.testing.assert_allclose(drawn.right, [0.5 if t == 5 else 1.0 for t in range(11)])
    assert drawn.known.tolist() == [t != 5 for t in range(11)]
    point = at(0.05)
    assert not drawn.contains(point, np.array([5]))[0]
    assert "only 50% of the rewards here are right (least 90%)" in drawn.outside(point[0], 5)
    assert drawn.contains(at(0.08), np.array([8]))[0]


@pytest.mark.parametrize("matching", MATCHINGS)
def test_what_chance_makes_of_few_states_refutes_nothing_but_raises_the_doubt(matching: Matching) -> None:
    signs = all_right(lines([0, 0, 0]))
    signs[1][5, :, 0] = 0.5
    drawn = domain(matching, 2.0, signs)
    np.testing.assert_allclose(drawn.right, [2.5 / 3.0 if t == 5 else 1.0 for t in range(11)])
    doubts = drawn.settings.doubts
    np.testing.assert_allclose(drawn.doubt, [doubts[-1] if t == 5 else doubts[0] for t in range(11)])


@pytest.mark.parametrize("count", [10, 100, 1000])
def test_a_place_is_refuted_by_a_share_that_one_in_twenty_of_right_places_would_show(count: int) -> None:
    rng = np.random.default_rng(7)
    right = rng.binomial(1, 0.9, size=(400, count)).astype(float)
    signs = [np.stack([column[:, None], np.ones((400, 1))], axis=2) for column in right.T]
    places = [np.arange(400)] * count
    stated = settings("any").model_copy(update={"least_right": 0.9, "doubts": (0.1,)})
    doubt = calibrate(places, signs, 400, 0, stated)[1]
    assert 0.02 < np.mean(np.isinf(doubt)) < 0.1


@given(
    matching=st.sampled_from(MATCHINGS),
    x=st.floats(-0.05, 0.15),
    y=st.floats(-0.03, 0.03),
    roll=st.floats(-0.1, 0.1),
    step=st.integers(0, 15),
)
def test_a_reason_is_given_exactly_where_trust_ends(
    matching: Matching, x: float, y: float, roll: float, step: int
) -> None:
    signs = all_right(lines([0, 0, 0]))
    signs[0][3, :, 0] = 0.5
    drawn = domain(matching, 3.0, signs)
    point = at(x, y, turn=(roll, 0.0, 0.0))
    reason = drawn.outside(point[0], step)
    assert (reason == "") == bool(drawn.contains(point, np.array([step]))[0])
    if reason:
        assert reason.split()[0] in COMPONENTS or "rewards here are right" in reason


@pytest.mark.parametrize("matching", MATCHINGS)
def test_without_a_floor_and_without_spread_the_reason_is_still_the_distance(matching: Matching) -> None:
    same = lines([0.0, 0.0])
    drawn = drawn_around(same, settings(matching, floor=0.0))
    point = at(0.05, 0.001)
    assert not drawn.contains(point, np.array([5]))[0]
    assert "standard deviations from the demonstrations" in drawn.outside(point[0], 5)


def test_angles_are_those_in_the_frame() -> None:
    """Upside down in the base but still in the frame: no singularity and no wrap near the goal's orientation."""
    left = pose.from_rotation_vector([0.0, np.pi / 2, 0.0])
    frame = np.array([left, FRAME[0]])
    rng = np.random.default_rng(0)
    shown = []
    for trajectory in lines([0.0, 0.001, 0.002]):
        turns = pose.from_rotation_vector(0.01 * rng.normal(size=(len(trajectory), 3)))
        shown.append(pose.make(trajectory[:, :3], pose.multiply(left, turns)))
    drawn = settings("step").fit(shown, all_right(shown), frame)
    assert isinstance(drawn, Box)
    assert np.abs(drawn.mean[:, 3:]).max() < 0.05
    assert drawn.contains(pose.make([0.05, 0.001, 0.0], left)[None], np.array([5]))[0]


@given(x=st.floats(-1, 1), step=st.integers(0, 20))
def test_trust_everywhere_and_nowhere_ask_nothing_of_the_pose(x: float, step: int) -> None:
    shown = lines([-0.004, 0.0, 0.004])
    wrong = [each * [0.0, 1.0] for each in all_right(shown)]
    for matching, trusted in (("everywhere", True), ("nowhere", False)):
        chosen = settings("any").model_copy(update={"matching": matching})
        drawn = chosen.fit(shown, wrong, FRAME)
        assert drawn.contains(at(x), np.array([step]))[0] == trusted
        assert (drawn.outside(at(x)[0], step) == "") == trusted


@given(y=st.floats(-0.03, 0.03), x=st.floats(-0.02, 0.12))
def test_a_distance_of_at_most_one_is_inside(x: float, y: float) -> None:
    drawn = domain("any")
    far = float(drawn.distance(at(x, y))[0])
    if abs(far - 1.0) > 1e-9:
        assert drawn.contains(at(x, y), np.array([0]))[0] == (far < 1.0)


@given(far=st.floats(0.0, 0.03), radius=st.floats(0.005, 0.02))
def test_a_ball_is_trusted_as_far_as_its_radius_and_nothing_else_changes(far: float, radius: float) -> None:
    drawn = domain("any")
    middle, step = at(0.05, 0.2), np.array([0])
    wider = drawn.extended(middle, np.array([radius]))
    if abs(far - radius) > 1e-9:
        assert wider.contains(at(0.05, 0.2 + far), step)[0] == (far < radius)
        assert (wider.distance(at(0.05, 0.2 + far))[0] <= 1.0) == (far < radius)
    assert not wider.contains(at(0.05, 0.2, turn=(0.5, 0.0, 0.0)), step)[0]
    assert not drawn.contains(middle, step)[0]


@pytest.mark.parametrize(("matching", "step"), [("step", 7), ("any", None)])
def test_a_domain_by_steps_knows_the_step_whose_box_is_nearest(matching: Matching, step: int | None) -> None:
    assert domain(matching).nearest_step(pose.make([0.071, 0.001, 0.0], FRAME[0])) == step
