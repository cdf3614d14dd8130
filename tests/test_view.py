from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from koopdqn.robot.view import View, choose_view, fitted_view

if TYPE_CHECKING:
    from koopdqn.pose import Array
    from koopdqn.robot.scene import Scene

SIZE = (320, 240)


@pytest.fixture(scope="module")
def view(scene: "Scene", motion: "Array") -> View:
    return choose_view(scene, motion, SIZE)


def test_chosen_view_has_path_and_payload_in_the_picture(scene: "Scene", view: View, motion: "Array") -> None:
    scene.place(motion[-1])
    payload = [i for i in range(scene.model.ngeom) if "payload_" in scene.model.geom(i).name]
    points = np.concatenate([scene.arm.forward(motion)[:, :3], scene.data.geom_xpos[payload]])
    pixels = view.pixels(points, SIZE, scene.model.vis.global_.fovy)
    assert np.all((pixels > 0) & (pixels < SIZE))


@given(
    points=st.lists(st.tuples(*[st.floats(-2, 2)] * 3), min_size=2, max_size=8),
    azimuth=st.floats(-180, 180),
    elevation=st.floats(-80, 80),
)
def test_fitted_view_holds_all_points_and_is_no_farther_off_than_need_be(
    points: list[tuple[float, float, float]], azimuth: float, elevation: float
) -> None:
    cloud = np.array(points)
    fitted = fitted_view(cloud, azimuth, elevation, SIZE, 45.0)
    offset = np.abs(fitted.pixels(cloud, SIZE, 45.0) - np.array(SIZE) / 2) / (np.array(SIZE) / 2)
    nearest = ((cloud - fitted.eye) @ fitted.forward).min()
    assert offset.max() <= 0.9 + 1e-6
    assert offset.max() > 0.9 - 1e-6 or nearest == pytest.approx(0.2)


@given(azimuth=st.floats(-180, 180), elevation=st.floats(-85, 85), distance=st.floats(0.1, 5))
def test_view_axes_are_orthonormal_and_the_point_looked_at_is_the_middle(
    azimuth: float, elevation: float, distance: float
) -> None:
    looking = View((0.3, -0.2, 0.5), distance, azimuth, elevation)
    axes = looking.axes()
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.norm(looking.eye - looking.lookat) == pytest.approx(distance)
    np.testing.assert_allclose(looking.pixels(np.array([looking.lookat]), SIZE, 45.0), [[160, 120]], atol=1e-6)
