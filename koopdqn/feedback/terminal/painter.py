"""The painter: draws questions, as lines of text with a picture beside them."""

from dataclasses import replace

from koopdqn.errors import WorkFailedError
from koopdqn.feedback.oracle import Question
from koopdqn.feedback.situation import Situation, SituationCamera
from koopdqn.feedback.terminal.canvas import PICTURE_SIZE, Canvas, Picture
from koopdqn.feedback.terminal.device import Device
from koopdqn.feedback.terminal.graphics import Drawn
from koopdqn.feedback.terminal.screen import Shown, compose, region, status_line
from koopdqn.workcell import Workcell


class Painter:
    """Paints screens on a terminal. Close it."""

    def __init__(self, device: Device, workcell: Workcell, graphics: Drawn) -> None:
        """Prepare for questions about a workcell; where pictures cannot be drawn, text stands alone and says why."""
        self._device = device
        self._canvas = Canvas(device, graphics)
        self._camera: SituationCamera | None = None
        self.remark = ""
        if graphics != "none":
            try:
                self._camera = SituationCamera(workcell, PICTURE_SIZE[graphics])
            except WorkFailedError as error:
                self.remark = f"No picture: {error}"

    @property
    def pictures(self) -> bool:
        """Whether the screen keeps room for a picture."""
        return self._canvas.graphics != "none"

    def situation(self, question: Question, share: float = 1.0) -> Situation | None:
        """Return the picture of a question, the arm having gone ``share`` of its motion; None without pictures."""
        return None if self._camera is None else self._camera.picture(question, share)

    def paint(self, shown: Shown, situation: Situation | None) -> None:
        """Put a whole screen on the terminal."""
        width, height = self._device.size()
        place = region(width, height, pictures=self.pictures)
        fits = situation is not None and place.width > 0 and not shown.help
        picture = Picture(situation.image, situation.marks, place) if situation is not None and fits else None
        times = situation.times if situation is not None and fits else 0.0
        lines = self._canvas.block_lines(picture)
        content = replace(shown, picture=lines, times=times, remark=self.remark)
        self._canvas.put(compose(content, width, height, pictures=self.pictures), picture)

    def paint_status(self, status: str) -> None:
        """Put only the line at the bottom on the terminal."""
        width, height = self._device.size()
        self._canvas.put_line(status_line(status, width), height)

    def close(self) -> None:
        """Free the camera and take pictures off the screen."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        self._canvas.clear()
