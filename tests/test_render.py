import os
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pytest
from conftest import NO_OPENGL

from koopdqn.errors import WorkFailedError
from koopdqn.robot import DISABLED, VARIABLE
from koopdqn.robot.render import Camera, Ghost, Line, Sphere, draw
from koopdqn.robot.view import View, choose_view

if TYPE_CHECKING:
    from koopdqn.pose import Array
    from koopdqn.robot.scene import Scene

SIZE = (320, 240)
RED = (1.0, 0.0, 0.0, 1.0)


@pytest.fixture(scope="module")
def view(scene: "Scene", motion: "Array") -> View:
    return choose_view(scene, motion, SIZE)


@pytest.fixture(scope="module")
def camera(scene: "Scene") -> Iterator[Camera]:
    if os.environ.get(VARIABLE) == DISABLED:
        pytest.skip(NO_OPENGL)
    with closing(Camera(scene, SIZE)) as opened:
        yield opened


def changed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.asarray(np.abs(first.astype(int) - second.astype(int)).max(axis=2) > 25)


def test_picture_has_the_size_asked_for_and_shows_something(camera: Camera, view: View, motion: "Array") -> None:
    image = camera.picture(motion[-1], view)
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert image.dtype == np.uint8
    assert image.std() > 20


def test_same_call_gives_the_same_picture(camera: Camera, scene: "Scene", view: View, motion: "Array") -> None:
    line = Line(scene.arm.forward(motion)[:, :3], RED)
    first = camera.picture(motion[-1], view, [line], ghosts=[Ghost(motion[0])])
    camera.picture(motion[0], view)
    np.testing.assert_array_equal(first, camera.picture(motion[-1], view, [line], ghosts=[Ghost(motion[0])]))


def test_moving_the_arm_changes_the_picture(camera: Camera, view: View, motion: "Array") -> None:
    assert changed(camera.picture(motion[0], view), camera.picture(motion[-1], view)).mean() > 0.02


def test_line_colours_the_pixels_it_projects_to(camera: Camera, scene: "Scene", view: View, motion: "Array") -> None:
    path = scene.arm.forward(motion)[:, :3]
    plain, drawn = camera.picture(motion[-1], view), camera.picture(motion[-1], view, [Line(path, RED, 0.006)])
    redder = drawn[..., 0].astype(int) - drawn[..., 1] > plain[..., 0].astype(int) - plain[..., 1] + 25
    columns, rows = np.rint(view.pixels(path, SIZE, scene.model.vis.global_.fovy) - 0.5).astype(int).T
    # All of it shows, also what is behind the arm.
    assert redder[rows, columns].mean() > 0.95
    rows_changed, columns_changed = np.nonzero(redder)
    gap = np.hypot(rows_changed[:, None] - rows, columns_changed[:, None] - columns).min(axis=1)
    assert np.median(gap) < 4


def test_hidden_part_of_a_line_is_fainter_than_the_open_part(
    camera: Camera, scene: "Scene", view: View, motion: "Array"
) -> None:
    # From the upper arm's inside to the open air above it.
    scene.place(motion[-1])
    inside = scene.data.xipos[scene.model.body("ur5/upper_arm_link").id].copy()
    up = np.array([0.0, 0.0, 1.0])
    image = camera.picture(motion[-1], view, [Line(np.array([inside, inside + 0.45 * up]), (0, 1, 0, 1), 0.008)])
    ends = np.array([inside, inside + 0.40 * up])
    (hidden_x, hidden_y), (open_x, open_y) = np.rint(view.pixels(ends, SIZE, 45.0)).astype(int)
    greenness = image[..., 1].astype(int) - image[..., 0]
    assert 10 < greenness[hidden_y, hidden_x] < greenness[open_y, open_x] - 20


def test_sphere_is_drawn_where_it_is(camera: Camera, view: View, motion: "Array") -> None:
    # Between the eye and the middle of the picture, so that nothing hides it.
    center = view.eye + 0.3 * view.forward
    image = camera.picture(motion[-1], view, spheres=[Sphere(center, RED, 0.02)])
    middle = image[SIZE[1] // 2, SIZE[0] // 2].astype(int)
    assert middle[0] > 120
    assert middle[0] > 2 * middle[1]


def test_ghost_is_fainter_than_the_arm(camera: Camera, view: View, motion: "Array") -> None:
    plain, there = camera.picture(motion[-1], view), camera.picture(motion[0], view)
    ghosted = camera.picture(motion[-1], view, ghosts=[Ghost(motion[0], 0.3)])
    differs = changed(plain, there)
    toward = np.abs(ghosted.astype(float) - plain).max(axis=2)[differs]
    whole = np.abs(there.astype(float) - plain).max(axis=2)[differs]
    assert (toward > 5).mean() > 0.2
    assert np.all(toward <= 0.3 * whole + 2)


def test_a_ghost_paints_over_nothing_that_is_nearer(camera: Camera, view: View, motion: "Array") -> None:
    mark = [Sphere(view.eye + 0.3 * view.forward, RED, 0.02)]
    plain = camera.picture(motion[-1], view, spheres=mark)
    ghosted = camera.picture(motion[-1], view, spheres=mark, ghosts=[Ghost(motion[-1], 0.5), Ghost(motion[0], 0.5)])
    middle = (SIZE[1] // 2, SIZE[0] // 2)
    np.testing.assert_array_equal(ghosted[middle], plain[middle])


def test_many_short_lines_get_coarser_before_one_is_left_out() -> None:
    drawn = SimpleNamespace(maxgeom=100, ngeom=0, geoms=[mujoco.MjvGeom() for _ in range(100)])
    long, short = np.linspace([0, 0, 0], [1, 0, 0], 40), np.array([[0, 0, 0], [0.001, 0, 0]])
    draw(drawn, [*(Line(long, RED, 0.002) for _ in range(9)), *(Line(short, RED, 0.01) for _ in range(40))])
    last = drawn.geoms[drawn.ngeom - 1]
    assert drawn.ngeom < 100
    assert last.size[0] == pytest.approx(0.01)


def test_more_lines_than_there_is_room_for_are_thinned_not_refused(
    camera: Camera, scene: "Scene", view: View, motion: "Array", monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("koopdqn.robot.render._MAX_GEOMS", 120)
    path = scene.arm.forward(motion)[:, :3]
    with closing(Camera(scene, SIZE)) as small:
        plain, drawn = small.picture(motion[-1], view), small.picture(motion[-1], view, [Line(path, RED, 0.006)])
    columns, rows = np.rint(view.pixels(path[[0, -1]], SIZE, 45.0) - 0.5).astype(int).T
    assert changed(plain, drawn)[rows, columns].all()


@pytest.mark.parametrize(
    ("backend", "told"),
    [
        ("egl", "tried MUJOCO_GL=egl: Cannot initialize a EGL device display.; see `koopdqn doctor`"),
        ("disable", "tried MUJOCO_GL=disable: it was asked for, or the libraries of neither egl nor osmesa were found"),
        ("", "tried the system's default: Cannot initialize"),
    ],
)
def test_rendering_that_fails_names_the_backend_and_the_doctor(
    scene: "Scene", monkeypatch: pytest.MonkeyPatch, backend: str, told: str
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise ImportError("Cannot initialize a EGL device display.\nMore words.")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    monkeypatch.setenv(VARIABLE, backend)
    with pytest.raises(WorkFailedError) as caught:
        Camera(scene, SIZE)
    assert told in str(caught.value)
    assert str(caught.value).endswith("see `koopdqn doctor`")
