"""Recording at the terminal: the loop that takes keys and shows what they do."""

from dataclasses import replace
from typing import Final

from koopdqn.app.recording.recorder import Recording
from koopdqn.app.recording.screen import RecordingCamera, Shown, compose
from koopdqn.errors import WorkFailedError
from koopdqn.oracles.terminal.device import Device, Graphics, check_graphics, choose_graphics, require_terminal
from koopdqn.oracles.terminal.picture import PICTURE_SIZE, Canvas, Picture
from koopdqn.oracles.terminal.screen import region
from koopdqn.tasks.workcell import Workcell

_WAIT_SECONDS: Final = 0.1
"""How often the size of the screen is looked at."""


def check_keyboard(graphics: Graphics) -> None:
    """Say before any work whether a person can demonstrate here.

    Raises:
        BadInputError: there is no terminal, or it cannot show pictures the wanted way.
    """
    require_terminal("source=keyboard", "use source=scripted, or koopdqn import demos=FILE for demonstrations of yours")
    check_graphics(graphics, "demo.keyboard.graphics")


class RecordingScreen:
    """Shows a recording on the terminal and takes the keys, until the person finishes."""

    def __init__(self, recording: Recording, workcell: Workcell, graphics: Graphics, file: str) -> None:
        """Prepare.

        Args:
            recording: what the keys drive.
            workcell: task, arm and scene.
            graphics: how pictures are drawn.
            file: where the demonstrations are, for people.
        """
        self._recording = recording
        self._workcell = workcell
        self._graphics = graphics
        self._device = Device(self._repaint)
        self._canvas: Canvas | None = None
        self._camera: RecordingCamera | None = None
        self._shown = Shown(recording.recorder, file, "Drive the tool to the goal; ? lists the keys")
        self._picture: Picture | None = None

    def run(self) -> None:
        """Take keys until the person finishes; whatever happens, the terminal is restored.

        Raises:
            PauseRequested: the terminal is gone, or the person ended the input (Ctrl-D).
        """
        try:
            self._open()
            size = self._device.size()
            while True:
                keys = self._device.keys(_WAIT_SECONDS)
                changed = False
                for key in keys:
                    if key == "q" and not self._shown.help:
                        return
                    changed |= self._take(key)
                before, size = size, self._device.size()
                if keys or size != before:
                    self._show(anew=changed or size != before)
        finally:
            self._close()

    def _open(self) -> None:
        self._device.enter()
        graphics = choose_graphics(self._graphics, self._device)
        self._canvas = Canvas(self._device, graphics)
        # The text first: it can be read while the first picture is drawn.
        self._repaint()
        if graphics != "none":
            try:
                self._camera = RecordingCamera(self._workcell, PICTURE_SIZE[graphics])
            except WorkFailedError as error:
                self._shown = replace(self._shown, remark=f"No picture: {error}")
        self._show(anew=True)

    def _take(self, key: str) -> bool:
        """Do what a key says; return whether the picture is another now."""
        if self._shown.help or key == "?":
            self._shown = replace(self._shown, help=not self._shown.help)
            return False
        reply = self._recording.press(key)
        self._shown = replace(self._shown, status=reply.text)
        return reply.changed

    def _show(self, *, anew: bool) -> None:
        width, height = self._device.size()
        place = region(width, height, pictures=self._camera is not None)
        if self._camera is None or not place.width:
            self._picture = None
        elif anew or self._picture is None or self._picture.place != place:
            self._picture = Picture(*self._camera.picture(self._recording.recorder), place)
        self._repaint()

    def _repaint(self) -> None:
        if self._canvas is None:
            return
        width, height = self._device.size()
        place = region(width, height, pictures=self._canvas.graphics != "none")
        # After a change of size the old picture would not fit.
        fits = self._picture is not None and self._picture.place == place and not self._shown.help
        picture = self._picture if fits else None
        content = replace(self._shown, picture=self._canvas.block_lines(picture))
        self._canvas.put(compose(content, place, width, height), picture)

    def _close(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None
        if self._canvas is not None:
            self._canvas.clear()
            self._canvas = None
        self._device.leave()
