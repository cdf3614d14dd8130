"""Speed and separation: the formula of ISO/TS 15066, and distances of a real arm to a person."""

import numpy as np
import pytest
from helpers_shelf import shelf
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.safety import PersonNear, protective_distance, separation
from koopdqn.safety.separation import separation_report

NUMBERS = {
    "speed_m_s": 1.6,
    "reaction_s": 0.1,
    "stopping_s": 0.3,
    "stopping_m": 0.05,
    "intrusion_m": 0.2,
    "person_error_m": 0.03,
    "arm_error_m": 0.002,
}
BODY = {"position_m": [1.5, 0.0, 0.3], "radius_m": 0.2, "arm_radius_m": 0.06, "tool_m": 0.1}
PERSON = PersonNear.model_validate({**NUMBERS, **BODY})


def test_the_formula_by_hand() -> None:
    # 1.6·(0.1 + 0.3) + 0.5·0.1 + 0.05 + 0.2 + 0.03 + 0.002
    assert protective_distance(PERSON, np.array([0.5]))[0] == pytest.approx(0.972)


@given(slow=st.floats(0, 5), more=st.floats(0, 5))
def test_a_faster_arm_must_stay_farther_away_and_one_that_leaves_counts_as_still(slow: float, more: float) -> None:
    near = protective_distance(PERSON, np.array([slow, slow + more, 0.0, -slow]))
    assert near[1] >= near[0] >= near[2] == near[3]


def motion() -> tuple[np.ndarray, np.ndarray]:
    """Joint angles that swing the arm about its base, past a person, and times."""
    joints = np.tile(np.array(shelf().arm.home), (41, 1))
    joints[:, 0] = np.linspace(-1.0, 1.0, 41)
    return joints, np.linspace(0.0, 2.0, 41)


def test_distances_are_those_of_the_arm() -> None:
    joints, times = motion()
    scene = shelf().scene
    flange = scene.arm.forward(joints)[:, :3]
    links = np.array([scene.link_points(row) for row in joints])
    np.testing.assert_allclose(links[:, -1], flange, atol=1e-6)
    bare = PERSON.model_copy(update={"radius_m": 0.0, "arm_radius_m": 0.0, "tool_m": 0.0})
    found = separation(scene, joints, times, bare)
    nodes = np.linalg.norm(links - np.array(PERSON.position_m), axis=2).min(axis=1)
    assert (found.distance_m <= nodes + 1e-9).all()
    assert (found.distance_m >= nodes - 0.4).all()
    thick = separation(scene, joints, times, PERSON.model_copy(update={"tool_m": 0.0}))
    np.testing.assert_allclose(thick.distance_m, found.distance_m - 0.26, atol=1e-9)


def test_speed_is_that_toward_the_person() -> None:
    joints, times = motion()
    found, slower = (separation(shelf().scene, joints, each, PERSON) for each in (times, 4.0 * times))
    np.testing.assert_allclose(found.speed_m_s, 4.0 * slower.speed_m_s, atol=1e-9)
    assert found.speed_m_s.max() > 0.1
    assert (separation(shelf().scene, np.tile(joints[:1], (5, 1)), times[:5], PERSON).speed_m_s < 1e-9).all()


def test_an_arm_that_comes_nearer_is_fast_and_one_that_leaves_is_not() -> None:
    joints, times = np.tile(np.array(shelf().arm.home), (21, 1)), np.linspace(0.0, 1.0, 21)
    joints[:, 0] = np.linspace(0.0, 0.6, 21)
    x, y, *_ = shelf().arm.forward(joints[:1])[0]
    # The arm swings toward where the person stands: every part of it comes nearer.
    beside = np.arctan2(y, x) + 1.4
    person = PERSON.model_copy(update={"position_m": (1.5 * np.cos(beside), 1.5 * np.sin(beside), 0.3)})
    nearer, leaving = (separation(shelf().scene, rows, times, person) for rows in (joints, joints[::-1]))
    assert nearer.speed_m_s[1:-1].min() > 0.1
    # But for the shoulder's own width.
    assert leaving.speed_m_s.max() < 0.02


def test_the_report_is_of_the_worst_moment() -> None:
    joints, times = motion()
    found = separation(shelf().scene, joints, times, PERSON)
    report, margin = separation_report(found, times.tolist()), found.distance_m - found.required_m
    assert report.margin_m == pytest.approx(margin.min())
    assert report.seconds == times[margin.argmin()]
    assert report.kept_fraction == pytest.approx((margin >= 0).mean())
    assert report.margin_m == pytest.approx(report.distance_m - report.required_m)
    assert (report.kept_fraction < 1) == (report.margin_m < 0)
