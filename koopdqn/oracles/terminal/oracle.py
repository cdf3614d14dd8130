"""The person at the terminal: asked by a screen, answering by single keys."""

from contextlib import closing
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
from koopdqn.oracles.terminal.picture import SituationCamera, lettered, png
from koopdqn.oracles.terminal.screen import Shown, compose
from koopdqn.oracles.terminal.window import Window
from koopdqn.tasks.workcell import Workcell

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
        self._window = Window(graphics, self._lines, "")
        self._camera: SituationCamera | None = None
        self._question: Question | None = None
        self._pressed: list[str] = []
        self._answered = ""
        self._shown_at = self._told_at = 0.0

    def answer(self, question: Question) -> Answer:
        """Show the question and return the person's answer."""
        self._open()
        if self._question is None or self._question.number != question.number:
            self._show(question)
        else:
            # The same one once more, after an undo: its picture stands, and keys already pressed are meant for it.
            self._question = question
            self._window.paint()
        while True:
            while self._pressed:
                answer = self._answer_of(self._pressed.pop(0), question, monotonic() - self._shown_at)
                if answer is not None:
                    return answer
            self._pressed = self._window.keys()

    def learning(self, progress: str) -> None:
        """Show how the learning goes, and take the key that pauses."""
        now = monotonic()
        if self._window.device.entered and now - self._told_at < _PROGRESS_SECONDS:
            return
        self._told_at = now
        self._open()
        pressed = self._window.keys(0.0)
        if "q" in pressed:
            raise PauseRequested("paused")
        note = "  (nothing is asked now: only q, pause, counts)" if pressed else ""
        self._window.say(f"Learning: {progress}{note}")

    def close(self) -> None:
        """Restore the terminal."""
        self._window.close()

    def _open(self) -> None:
        if not self._window.device.entered:
            self._window.open()
            self._camera = self._window.start(partial(SituationCamera, self._workcell))

    def _show(self, question: Question) -> None:
        window = self._window
        # Nobody can have meant this question before seeing it; the key that pauses means none.
        pressed = [*self._pressed, *window.keys(0.0)]
        self._pressed.clear()
        if "q" in pressed:
            raise PauseRequested("paused")
        early = len(pressed)
        window.status = f"{early} typed ahead of the question: passed over" if early else self._answered
        window.help, window.picture = False, None
        self._question = question
        # The text first: it can be read while the picture is drawn.
        window.paint()
        window.picture = self._camera.picture(question) if self._camera else None
        window.paint()
        self._shown_at = monotonic()

    def _answer_of(self, key: str, question: Question, seconds: float) -> Answer | None:
        """Return the answer that a key gives, or do what else it asks for and return None."""
        window = self._window
        if window.helps(key):
            if not window.help:
                window.status = ""
            window.paint()
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
        else:
            self._window.say(f"{key!r} is no key here; ? lists them")
        return None

    def _acknowledged(self, answer: Answer) -> Answer:
        self._answered = f"Answered: {screen.told(answer)}"
        self._window.say(self._answered)
        return answer

    def _better(self, action: int, question: Question, seconds: float) -> Answer | None:
        choosable = screen.choosable(question, self._workcell.task)
        if not choosable[action]:
            self._window.say(f"{screen.CHOICE_KEYS[action]}: that action is never right here ({screen.SHORT[action]})")
            return None
        return self._acknowledged(Answer(action == question.action, self._teacher, seconds, action))

    def _undo(self, question: Question) -> Answer | None:
        if not question.earlier:
            self._window.say("nothing is left to undo")
            return None
        counts = "" if question.left is None else ", and counts as asked"
        told = screen.recalled(question.earlier[-1])
        self._window.say(f"Withdrawn: {told}; it is asked again when it comes up{counts}")
        return Answer(None, self._teacher, undo=1, again=True)

    def _save(self, question: Question) -> None:
        self._window.say("saving the picture ...")
        path = self._folder / "questions" / f"{question.number:04d}.png"
        try:
            with closing(SituationCamera(self._workcell, _SAVED_SIZE, fine=True)) as camera:
                drawn = camera.picture(question)
            with atomic_path(path) as temporary:
                temporary.write_bytes(png(lettered(drawn.image, drawn.marks, screen.legend(drawn.times).plain)))
        except KoopdqnError as error:
            self._window.say(str(error))
        else:
            self._window.say(f"saved {console.shown_path(path)}")

    def _replay(self, question: Question) -> None:
        window, camera = self._window, self._camera
        whole, before = window.picture, window.status
        if whole is None or camera is None:
            window.say("there is no picture to replay")
            return
        window.status = "the motion once more"
        for frame in range(_REPLAY_FRAMES):
            until = monotonic() + _REPLAY_SECONDS
            window.picture = camera.picture(question, frame / _REPLAY_FRAMES)
            window.paint()
            # A key ends it at once.
            if window.device.waits(max(until - monotonic(), 0.0)):
                break
        window.picture, window.status = whole, before
        window.paint()

    def _lines(self, picture: list[Text], width: int, height: int) -> list[Text]:
        window = self._window
        times = 0.0 if window.picture is None else window.picture.times
        task, question = self._workcell.task, self._question
        shown = Shown(task, self._teacher, question, window.status, picture, times, window.remark, window.help)
        return compose(shown, width, height, pictures=window.pictures)
