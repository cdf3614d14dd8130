"""The person at the terminal: asked by a screen, answering by single keys."""

from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Final

from rich.text import Text

from koopdqn import console
from koopdqn.errors import KoopdqnError
from koopdqn.files import atomic_path
from koopdqn.oracles.base import Answer, Oracle, PauseRequested, Question
from koopdqn.oracles.terminal import screen
from koopdqn.oracles.terminal.device import Graphics
from koopdqn.oracles.terminal.graphics import Picture, Window, lettered, png
from koopdqn.oracles.terminal.picture import Situation, SituationCamera
from koopdqn.oracles.terminal.screen import Shown, compose, status_line
from koopdqn.tasks.workcell import Workcell

_WAIT_SECONDS: Final = 0.1
"""How often the size of the screen is looked at."""
_PROGRESS_SECONDS: Final = 0.1
_REPLAY_FRAMES: Final = 8
_REPLAY_SECONDS: Final = 0.08
_SAVED_SIZE: Final = (1280, 960)
_VERDICTS: Final = {"y": True, "n": False, "s": None}


class TerminalOracle(Oracle):
    """Asks the person at the terminal. From the first question or sign of learning on it owns the screen."""

    def __init__(self, workcell: Workcell, teacher: str, graphics: Graphics, folder: Path) -> None:
        """Prepare for a teacher's answers about a workcell; the run folder takes saved pictures."""
        self._workcell = workcell
        self._teacher = teacher
        self._folder = folder
        self._window: Window[SituationCamera] = Window(graphics, self._repaint)
        self._shown = Shown(workcell.task, teacher)
        self._situation: Situation | None = None
        self._pressed: list[str] = []
        self._answered = ""
        self._shown_at = self._told_at = 0.0

    def answer(self, question: Question) -> Answer:
        """Show the question and return the person's answer."""
        self._open()
        if self._shown.question is None or self._shown.question.number != question.number:
            self._show(question)
        else:
            # The same one once more, after an undo: its picture stands, and keys already pressed are meant for it.
            self._shown = replace(self._shown, question=question)
            self._repaint()
        while True:
            key = self._key()
            answer = None if key is None else self._answer_of(key, question, monotonic() - self._shown_at)
            if answer is not None:
                return answer

    def learning(self, progress: str) -> None:
        """Show how the learning goes, and take the key that pauses."""
        now = monotonic()
        if self._window.device.entered and now - self._told_at < _PROGRESS_SECONDS:
            return
        self._told_at = now
        self._open()
        if self._window.resized():
            self._repaint()
        pressed = self._window.device.keys(0.0)
        if "q" in pressed:
            raise PauseRequested("paused")
        note = "  (nothing is asked now: only q, pause, counts)" if pressed else ""
        self._say(f"Learning: {progress}{note}")

    def close(self) -> None:
        """Restore the terminal."""
        self._window.close()

    def _open(self) -> None:
        if not self._window.device.entered:
            self._window.open()
            self._window.start(partial(SituationCamera, self._workcell))
            self._repaint()

    def _show(self, question: Question) -> None:
        # Nobody can have meant this question before seeing it; the key that pauses means none.
        pressed = [*self._pressed, *self._window.device.keys(0.0)]
        self._pressed.clear()
        if "q" in pressed:
            raise PauseRequested("paused")
        early = len(pressed)
        status = f"{early} typed ahead of the question: passed over" if early else self._answered
        self._shown = replace(self._shown, question=question, status=status, help=False)
        self._situation = None
        # The text first: it can be read while the picture is drawn.
        self._repaint()
        self._situation = self._window.camera.picture(question) if self._window.camera else None
        self._repaint()
        self._shown_at = monotonic()

    def _key(self) -> str | None:
        """Return the next key, or None after a moment without one; the screen follows its size meanwhile."""
        if not self._pressed:
            self._pressed += self._window.device.keys(_WAIT_SECONDS)
        if self._window.resized():
            self._repaint()
        return self._pressed.pop(0) if self._pressed else None

    def _answer_of(self, key: str, question: Question, seconds: float) -> Answer | None:
        """Return the answer that a key gives, or do what else it asks for and return None."""
        if self._shown.help:
            self._shown = replace(self._shown, help=False, status="")
            self._repaint()
            return None
        if key in _VERDICTS:
            return self._acknowledged(Answer(_VERDICTS[key], self._teacher, seconds))
        if len(key) == 1 and key in screen.CHOICE_KEYS[: len(screen.choosable(question, self._workcell.task))]:
            return self._better(screen.CHOICE_KEYS.index(key), question, seconds)
        if key == "u":
            return self._undo(question)
        if key == "q":
            raise PauseRequested("paused")
        if key == "p":
            self._save(question)
        elif key == "r":
            self._replay(question)
        elif key == "?":
            self._shown = replace(self._shown, help=True)
            self._repaint()
        else:
            self._say(f"{key!r} is no key here; ? lists them")
        return None

    def _acknowledged(self, answer: Answer) -> Answer:
        self._answered = f"Answered: {screen.told(answer)}"
        self._say(self._answered)
        return answer

    def _better(self, action: int, question: Question, seconds: float) -> Answer | None:
        choosable = screen.choosable(question, self._workcell.task)
        if not choosable[action]:
            self._say(f"{screen.CHOICE_KEYS[action]}: that action is never right here ({screen.SHORT[action]})")
            return None
        return self._acknowledged(Answer(action == question.action, self._teacher, seconds, action))

    def _undo(self, question: Question) -> Answer | None:
        if not question.earlier:
            self._say("nothing is left to undo")
            return None
        self._say(f"Withdrawn: {screen.recalled(question.earlier[-1])}; it is asked again when it comes up")
        return Answer(None, self._teacher, undo=1, again=True)

    def _save(self, question: Question) -> None:
        self._say("saving the picture ...")
        path = self._folder / "questions" / f"{question.number:04d}.png"
        try:
            with closing(SituationCamera(self._workcell, _SAVED_SIZE, fine=True)) as camera:
                drawn = camera.picture(question)
            with atomic_path(path) as temporary:
                temporary.write_bytes(png(lettered(drawn.image, drawn.marks, screen.legend(drawn.times).plain)))
        except KoopdqnError as error:
            self._say(str(error))
        else:
            self._say(f"saved {console.shown_path(path)}")

    def _replay(self, question: Question) -> None:
        whole, camera = self._situation, self._window.camera
        if whole is None or camera is None:
            self._say("there is no picture to replay")
            return
        before = self._shown.status
        self._shown = replace(self._shown, status="the motion once more")
        for frame in range(_REPLAY_FRAMES):
            until = monotonic() + _REPLAY_SECONDS
            self._situation = camera.picture(question, frame / _REPLAY_FRAMES)
            self._repaint()
            # A key ends it at once.
            if self._window.device.waits(max(until - monotonic(), 0.0)):
                break
        self._situation = whole
        self._shown = replace(self._shown, status=before)
        self._repaint()

    def _say(self, status: str) -> None:
        self._shown = replace(self._shown, status=status)
        if self._window.device.entered:
            self._window.paint_line(status_line(status, self._window.device.size()[0]))

    def _repaint(self) -> None:
        window = self._window
        if not window.device.entered:
            return
        place = window.place()
        drawn = self._situation if place.width and not self._shown.help else None
        picture = None if drawn is None else Picture(drawn.image, drawn.marks, place)
        times = 0.0 if drawn is None else drawn.times

        def lines(picture_lines: list[Text], width: int, height: int) -> list[Text]:
            shown = replace(self._shown, picture=picture_lines, times=times, remark=window.remark)
            return compose(shown, width, height, pictures=window.pictures)

        window.paint(lines, picture)
