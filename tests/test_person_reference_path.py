import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.tasks.person import ReferencePath

UPRIGHT = np.array([0.0, 1.0, 0.0, 0.0])
MARGIN = 0.0005


def shown(positions: Array) -> ReferencePath:
    return ReferencePath.along(pose.make(positions, UPRIGHT))


STRAIGHT = shown(np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]]))
THERE_AND_BACK = shown(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0001, 0.0]]))


@given(x=st.floats(0, 0.4), y=st.floats(-0.05, 0.05))
def test_on_a_straight_path_the_place_is_the_foot_of_the_perpendicular(x: float, y: float) -> None:
    arc = STRAIGHT.nearest(np.array([[x, y, 0.0]]), MARGIN)[0]
    assert abs(arc - x) <= 0.51 * STRAIGHT.places.spacing


@given(x=st.floats(0.005, 0.195), y=st.floats(-0.05, 0.05))
def test_where_a_path_passes_twice_the_later_place_is_taken(x: float, y: float) -> None:
    arc = THERE_AND_BACK.nearest(np.array([[x, y, 0.0]]), MARGIN)[0]
    assert abs(arc - (0.4 - x)) <= 1.1 * THERE_AND_BACK.places.spacing


def test_orientations_are_those_at_the_places() -> None:
    turns = pose.from_rotation_vector(np.linspace(0.0, 1.0, 50)[:, None] * [1.0, 0.0, 0.0])
    positions = np.linspace(0.0, 0.3, 50)[:, None] * [0.0, 0.0, 1.0]
    path = ReferencePath.along(pose.make(positions, turns))
    arc = np.array([-1.0, 0.0, 0.06, 0.15, 0.3, 1.0])
    wanted = pose.from_rotation_vector(np.clip(arc / 0.3, 0, 1)[:, None] * [1.0, 0.0, 0.0])
    found = pose.make(np.zeros(3), path.turned_at(arc))
    np.testing.assert_allclose(pose.rotation_distance(found, pose.make(np.zeros(3), wanted)), 0.0, atol=2e-3)
