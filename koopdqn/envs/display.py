"""What an environment shows of the arm: pictures, or a window."""

import os
import sys
import time
import warnings
from collections.abc import Sequence
from typing import Any, Final

import mujoco
import numpy as np

from koopdqn.errors import BadInputError, WorkFailedError, unknown_name
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Image
from koopdqn.robot.view import View, choose_view
from koopdqn.tasks.workcell import Workcell

SIZE: Final = (640, 480)
"""Width and height of a picture [pixels]."""


class Pictures:
    """Pictures of the arm in its scene."""

    def __init__(self, workcell: Workcell) -> None:
        """Choose a view from which the way from the nominal start to the goal is seen.

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        task, reachability = workcell.task, workcell.reachability
        ends = [reachability.enter(pose).joints for pose in (task.nominal_start, task.goal)]
        joints = np.array([each for each in ends if each is not None])
        self._view: View = choose_view(workcell.scene, joints, SIZE)
        self._camera = Camera(workcell.scene, SIZE)

    def picture(self, joints: Array) -> Image:
        """Return the picture (480, 640, 3) of the arm at joint angles (6,) [rad]."""
        return self._camera.picture(joints, self._view)

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._camera.close()


class Window:
    """MuJoCo's viewer, in which the arm follows an episode at the pace of a real one."""

    def __init__(self, workcell: Workcell) -> None:
        """Open the window.

        Raises:
            WorkFailedError: the display opens none.
        """
        try_window()
        from mujoco import viewer

        self._scene, self._seconds = workcell.scene, workcell.arm.step_seconds
        # Not the scene's own, which checks of collisions overwrite while the window draws.
        self._data = mujoco.MjData(self._scene.model)
        self._viewer: Any = viewer.launch_passive(self._scene.model, self._data)
        self._due = time.monotonic()

    def show(self, joints: Array) -> None:
        """Show the arm at joint angles (6,) [rad], a step's time after what was shown before."""
        with self._viewer.lock():
            self._data.qpos[self._scene.joint_index] = joints
            mujoco.mj_forward(self._scene.model, self._data)
        self._viewer.sync()
        self._due = max(self._due + self._seconds, time.monotonic())
        time.sleep(self._due - time.monotonic() if self._due > time.monotonic() else 0.0)

    def close(self) -> None:
        """Close the window."""
        self._viewer.close()


def render_modes() -> list[str]:
    """Return the render modes that work here: ``human``, a window, needs a display; ``rgb_array`` gives pictures."""
    return ["human", "rgb_array"] if has_display() else ["rgb_array"]


def has_display() -> bool:
    """Return whether a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def try_window() -> None:
    """Raise WorkFailedError unless a window with OpenGL opens; the viewer would wait for its own for ever."""
    import glfw

    with warnings.catch_warnings():
        # GLFW's reasons come as warnings.
        warnings.simplefilter("ignore")
        opened = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            opened = glfw.create_window(16, 16, "koopdqn", None, None)
            glfw.default_window_hints()
    if not opened:
        raise WorkFailedError("the window cannot be opened: this display opens none with OpenGL; see `koopdqn doctor`")
    glfw.destroy_window(opened)


def check_render_mode(mode: str | None, valid: Sequence[str]) -> None:
    """Check that a render mode is None or one of those that work.

    Raises:
        BadInputError: it is not.
    """
    if mode == "human" and mode not in valid and not has_display():
        raise BadInputError(
            "render_mode: must be rgb_array where there is no display, found human with neither DISPLAY nor"
            " WAYLAND_DISPLAY set"
        )
    if mode is not None and mode not in valid:
        raise unknown_name("render_mode", mode, valid)
