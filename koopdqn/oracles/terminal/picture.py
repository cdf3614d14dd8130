"""The picture of a question: the arm where it went, and where the model would have gone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.oracles.base import Question
from koopdqn.pose import Array
from koopdqn.robot.render import Camera, Ghost, Image, Line, Rgba, Sphere
from koopdqn.robot.view import View, choose_view, fitted_view
from koopdqn.tasks.workcell import Workcell, build_scene

WENT: Final[Rgba] = (0.90, 0.62, 0.0, 1.0)
MEANT: Final[Rgba] = (0.34, 0.71, 0.91, 1.0)
GOAL: Final[Rgba] = (0.0, 0.62, 0.45, 1.0)
BEFORE: Final[Rgba] = (0.95, 0.95, 0.95, 1.0)
AXES: Final[tuple[Rgba, ...]] = ((0.84, 0.37, 0.0, 1.0), (0.0, 0.45, 0.70, 1.0), (0.80, 0.47, 0.65, 1.0))
"""Of the base's x, y and z axis, as drawn at the flange."""

_AXIS_M: Final = 0.13
_AXIS_SHAFT_M: Final = 0.0025
_TIP_M: Final = 0.014

Marks = Mapping[str, tuple[float, float]]
"""Characters and the shares (0…1) of a picture's width and height where they are."""


class WorkcellCamera:
    """Draws a workcell in a scene of its own. Close it."""

    def __init__(self, workcell: Workcell, size: tuple[int, int], *, fine: bool = False) -> None:
        """Prepare for pictures of ``size`` (width, height) [pixels]; WorkFailedError where OpenGL does not work.

        ``fine`` ones have shadows and smooth edges, which take a few tenths of a second each.
        """
        self.workcell = workcell
        scene = build_scene(workcell.task, workcell.arm)
        if not fine:
            # Shadows take nine tenths of the time where the processor draws.
            scene.model.vis.quality.shadowsize = scene.model.vis.quality.offsamples = 0
        self.camera = Camera(scene, size)

    def close(self) -> None:
        """Free what OpenGL holds."""
        self.camera.close()

    def drawn(
        self,
        joints: Array,
        view: View,
        here: Array,
        lines: Sequence[Line],
        points: Mapping[str, tuple[Array, Rgba]],
        ghosts: Sequence[Ghost],
    ) -> tuple[Image, Marks]:
        """Return the picture (height, width, 3) of the arm at joints (6,) [rad], and where things are in it.

        The base's axes are drawn from ``here`` (3,) [m], their ends marked x, y and z, and dots at points (3,) [m],
        under their marks and in their colours; where several are at one place, the last is seen.
        """
        ends = here + _AXIS_M * np.eye(3)
        axes = [Line(np.array([here, end]), colour, _AXIS_SHAFT_M) for end, colour in zip(ends, AXES, strict=True)]
        spheres = [Sphere(point, colour, _TIP_M) for point, colour in points.values()]
        image = self.camera.picture(joints, view, lines=[*axes, *lines], spheres=spheres, ghosts=ghosts)
        places = np.array([*ends, *(point for point, _ in points.values())])
        size, angle = self.camera.size, self.camera.scene.model.vis.global_.fovy
        shares = (view.pixels(places, size, angle) / np.array(size)).tolist()
        return image, {mark: (x, y) for mark, (x, y) in zip(["x", "y", "z", *points], shares, strict=True)}


_SHOWN_M: Final = 0.08
_SHOWN_RAD: Final = 0.8
"""How far a motion is drawn: one of 2 mm or 1° would be less than a pixel."""
_AROUND_M: Final = 0.16
_SHAFT_M: Final = 0.006
_GHOST: Final = 0.45
_SAME_DIRECTION_M: Final = 0.1
"""How far the flange may go before it is looked at from another direction."""


@dataclass(frozen=True)
class Situation:
    """A picture (height, width, 3), where things are in it, and how many times as far as they are motions are drawn."""

    image: Image
    marks: Marks
    times: float


class SituationCamera(WorkcellCamera):
    """Draws questions of one workcell."""

    _direction: View | None = None
    _seen_from: Array = np.zeros(3)

    def picture(self, question: Question, share: float = 1.0) -> Situation:
        """Return the picture of a question, the arm having gone ``share`` (0…1) of its motion."""
        times = magnification(question)
        reached, meant = (magnified(question.pose, end, times) for end in (question.reached, question.predicted))
        here = magnified(question.pose, question.reached, share * times)
        before, goal = question.pose[pose.POSITION], self.workcell.task.goal[pose.POSITION]
        # All from one posture, or the elbow might be up in one and down in the other.
        posture = self._entered(question.pose)
        joints = self._joints(here, question.pose, posture)
        ends = ((reached[pose.POSITION], WENT), (meant[pose.POSITION], MEANT))
        image, marks = self.drawn(
            joints,
            self._view(question, joints, np.array([before, goal])),
            before,
            [Line(np.array([before, end]), colour, _SHAFT_M) for end, colour in ends],
            {"g": (goal, GOAL), "m": ends[1], "b": (before, BEFORE), "r": ends[0]},
            [Ghost(self._joints(meant, question.predicted, posture), _GHOST)],
        )
        return Situation(image, marks, times)

    def _joints(self, wished: Array, otherwise: Array, near: Array) -> Array:
        """Return joints (6,) [rad], near others, of a pose drawn too far, or of the true one if it is out of reach."""
        for target in (wished, otherwise):
            solutions = self.workcell.arm.solutions(target, near)
            if len(solutions):
                return np.asarray(solutions[0])
        return near

    def _entered(self, pose_: Array) -> Array:
        joints = self.workcell.reachability.enter(pose_).joints
        return np.array(self.workcell.arm.home) if joints is None else joints

    def _view(self, question: Question, joints: Array, points: Array) -> View:
        scene = self.camera.scene
        far = self._direction is None or np.linalg.norm(points[0] - self._seen_from) > _SAME_DIRECTION_M
        if far:
            # Kept while the flange is about there, so that no one has to find their bearings anew each time.
            self._direction = choose_view(scene, np.array([self._entered(question.pose), joints]), self.camera.size)
            self._seen_from = points[0]
        around = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * _AROUND_M
        seen = np.concatenate([points, points[0] + around])
        assert self._direction is not None  # chosen above
        azimuth, elevation = self._direction.azimuth, self._direction.elevation
        return fitted_view(seen, azimuth, elevation, self.camera.size, scene.model.vis.global_.fovy)


def magnification(question: Question) -> float:
    """Return how many times as far as they are a question's motions are drawn, 1 or more."""
    ends = np.array([question.reached, question.predicted])
    far = float(pose.position_distance(ends, question.pose).max())
    turn = float(pose.rotation_distance(ends, question.pose).max())
    limits = [shown / size for shown, size in ((_SHOWN_M, far), (_SHOWN_RAD, turn)) if size > 0]
    return max(1.0, min(limits, default=1.0))


def magnified(before: Array, after: Array, times: float) -> Array:
    """Return the pose (7,) that continues the motion between two poses (7,) to ``times`` its length and turn."""
    position = before[pose.POSITION] + times * (after - before)[pose.POSITION]
    turn = pose.to_rotation_vector(pose.multiply(after[pose.QUATERNION], pose.conjugate(before[pose.QUATERNION])))
    return pose.make(position, pose.multiply(pose.from_rotation_vector(times * turn), before[pose.QUATERNION]))
