"""The picture of a recording: the arm where it stands, a ghost of it at the goal, the path so far."""

from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.feedback.situation import AXES, BEFORE, GOAL, WENT
from koopdqn.pose import Array
from koopdqn.recording.recorder import Recorder
from koopdqn.robot.camera import Camera, Ghost, Image, Line, Sphere
from koopdqn.robot.scene import build_scene
from koopdqn.robot.view import View, choose_view
from koopdqn.workcell import Workcell

_AXIS_M: Final = 0.13
_AXIS_SHAFT_M: Final = 0.0025
_PATH_M: Final = 0.005
_TIP_M: Final = 0.014
_GHOST: Final = 0.3


class RecordingCamera:
    """Draws a recording in a scene of its own. Close it."""

    def __init__(self, workcell: Workcell, size: tuple[int, int]) -> None:
        """Prepare for pictures of ``size`` (width, height) [pixels].

        Raises:
            WorkFailedError: OpenGL does not work here.
        """
        self._goal = workcell.task.goal
        self._workcell = workcell
        self._goal_joints = workcell.reachability.enter(self._goal).joints
        scene = build_scene(workcell.task, workcell.arm)
        # Shadows take nine tenths of the time where the processor draws.
        scene.model.vis.quality.shadowsize = scene.model.vis.quality.offsamples = 0
        self._camera = Camera(scene, size)
        self._seen_from: View | None = None

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._camera.close()

    def picture(self, recorder: Recorder) -> tuple[Image, dict[str, tuple[float, float]]]:
        """Return the picture (height, width, 3) of where a recording is, and where things are in it.

        Those are shares (0…1) of width and height: s the start, t the tool, g the goal, x, y and z the ends of the
        base's axes.
        """
        path = np.array(recorder.state.path)[:, pose.POSITION]
        here, goal = path[-1], self._goal[pose.POSITION]
        axes = here + _AXIS_M * np.eye(3)
        view = self._view(recorder)
        lines = [Line(np.array([here, end]), colour, _AXIS_SHAFT_M) for end, colour in zip(axes, AXES, strict=True)]
        if recorder.state.moves:
            lines.append(Line(path, WENT, _PATH_M))
        image = self._camera.picture(
            recorder.joints,
            view,
            lines=lines,
            spheres=[Sphere(path[0], BEFORE, _TIP_M), Sphere(goal, GOAL, _TIP_M), Sphere(here, WENT, _TIP_M)],
            ghosts=[] if self._goal_joints is None else [Ghost(self._goal_joints, _GHOST)],
        )
        size = self._camera.size
        points = np.array([*axes, path[0], goal, here])
        places = view.pixels(points, size, self._camera.scene.model.vis.global_.fovy) / np.array(size)
        return image, {mark: (float(x), float(y)) for mark, (x, y) in zip("xyzsgt", places, strict=True)}

    def _view(self, recorder: Recorder) -> View:
        if self._seen_from is None:
            # One for the whole session, so that left stays left.
            self._seen_from = choose_view(self._camera.scene, self._motion(recorder.joints), self._camera.size)
        return self._seen_from

    def _motion(self, otherwise: Array) -> Array:
        """Return joint angles (N, 6) [rad] of what is about to be shown: the task's own way, or one posture."""
        task = self._workcell.task
        limit = 20 * int(task.nominal_path.length / task.step_m)
        joints, _ = self._workcell.reachability.follow(task.demonstrator.roll_out(task.nominal_start, limit))
        return otherwise[None] if joints is None else joints
