"""The dashboard: how a training goes, on a whole screen, redrawn in place."""

import os
import signal
import threading
from collections import deque
from time import monotonic
from types import FrameType, TracebackType
from typing import Any, Final

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.layout import Layout
from rich.live import Live
from rich.panel import Panel
from rich.style import Style
from rich.table import Table
from rich.text import Text

from koopdqn.console import percent
from koopdqn.intent.reward import ASKED, CERTIFIED, REMEMBERED, SOURCES, TRUSTED
from koopdqn.pose import POSITION, Array
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.view.characters import Curve, Picture, Track, bars

LEAST: Final = (80, 24)
"""Columns and rows below which there is no room for it."""
_REDRAW_SECONDS: Final = 0.25
_MOST_OF_TIME: Final = 0.01
"""Most of the time that redrawing may take; what is slower is done less often."""
_RECENT_SECONDS: Final = 3.0
_NUMBERS_WIDTH: Final = 40
_SPARK: Final = 7

_DIM: Final = Style(dim=True)
_LEARNED: Final = Style(color="cyan", bold=True)
_SHOWN: Final = Style(color="yellow")
_NOW: Final = Style(color="magenta", bold=True)
_GOAL: Final = Style(color="green", bold=True)
# Of each source a shade of its own, too, for whoever cannot tell the colours apart.
_BARS: Final = {TRUSTED: ("█", "green"), CERTIFIED: ("▓", "cyan"), REMEMBERED: ("▒", "magenta"), ASKED: ("░", "red")}
_PLANES: Final = {(0, 1): "from above: x right, y up", (0, 2): "x right, z up", (1, 2): "y right, z up"}


def fits(console: Console) -> bool:
    """Return whether a console is a terminal with room for the dashboard."""
    able = console.is_terminal and console.is_interactive and not console.is_dumb_terminal
    try:
        # A console of ours is never told to be narrower than its tables.
        width, height = os.get_terminal_size(console.file.fileno())
    except OSError:
        width, height = console.size
    return able and width >= LEAST[0] and height >= LEAST[1]


class Dashboard:
    """Shows a training on the whole screen of a terminal while it is entered. It reads the trainer and changes nothing.

    Call :meth:`round` after every round of the training.
    """

    def __init__(
        self, trainer: Trainer, demonstrations: list[Array], budget: int | None, console: Console, seconds: float = 0.0
    ) -> None:
        """Prepare to show a training that has taken ``seconds`` so far, beside demonstrated poses (N, 7).

        ``budget`` is the most questions that may be asked; None for no limit.
        """
        self._trainer = trainer
        self._budget = budget
        self._console = console
        self._tracks = [poses[:, POSITION] for poses in demonstrations]
        task = trainer.workcell.task
        half, middle = np.array(task.start_half_range_m), task.nominal_start[POSITION]
        self._frame = np.concatenate([*self._tracks, [middle - half, middle + half, task.goal[POSITION]]])
        self._plane = widest_plane(self._frame)
        self._began = monotonic() - seconds
        self._from = monotonic(), trainer.env_steps, trainer.learner.updates, len(trainer.history.rewards)
        self._recent: deque[tuple[float, int]] = deque([self._from[:2]])
        self._due = 0.0
        self._live: Live | None = None
        self._handler: Any = None
        self._stop_asked = False

    def __enter__(self) -> "Dashboard":
        """Take the screen."""
        apart: dict[str, Any] = {"auto_refresh": False, "redirect_stdout": False, "redirect_stderr": False}
        self._live = Live(self.content(), console=self._console, screen=True, **apart)
        self._live.start(refresh=True)
        # Only the main thread may set handlers.
        if hasattr(signal, "SIGTSTP") and threading.current_thread() is threading.main_thread():
            self._handler = signal.signal(signal.SIGTSTP, self._ask_to_stop)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the screen back as it was."""
        if self._handler is not None:
            signal.signal(signal.SIGTSTP, self._handler)
            self._handler = None
        if self._live is not None:
            self._live.stop()
            self._live = None

    def round(self) -> None:
        """Draw anew if it is time to."""
        if self._stop_asked and self._live is not None:
            self._suspend(self._live)
        now = monotonic()
        if self._live is None or now < self._due:
            return
        self._recent.append((now, self._trainer.env_steps))
        while now - self._recent[0][0] > _RECENT_SECONDS and len(self._recent) > 2:
            self._recent.popleft()
        self._live.update(self.content(), refresh=True)
        took = monotonic() - now
        self._due = now + max(_REDRAW_SECONDS, took / _MOST_OF_TIME)

    def content(self) -> RenderableType:
        """Return what stands on the screen now."""
        trainer = self._trainer
        exploring = np.array(trainer.history.exploring, dtype=bool)
        # Whole episodes tell more, but the first of them ends late.
        kind = "a short, exploring episode" if exploring.all() else "a whole episode"
        rewards = np.array(trainer.history.rewards, dtype=float)[exploring == exploring.all()]
        page = Layout()
        page.split_column(
            Layout(self._head(), size=1),
            Layout(name="top", ratio=3, minimum_size=13),
            Layout(Panel(Curve(rewards, _LEARNED), title=f"reward of {kind} ({len(rewards)} so far)"), minimum_size=5),
            Layout(Panel(self._sources(), title="where rewards came from"), size=4),
            Layout(Text(" Ctrl-C stops; koopdqn train run=FOLDER goes on from the last check", _DIM), size=1),
        )
        page["top"].split_row(
            Layout(Panel(self._numbers(), title="learning"), size=_NUMBERS_WIDTH),
            Layout(Panel(self._picture(), title=f"paths ({_PLANES[self._plane]})", subtitle=_legend())),
        )
        return page

    def _ask_to_stop(self, number: int, frame: FrameType | None) -> None:
        # Rich may just be writing: the next round stops.
        self._stop_asked = True

    def _suspend(self, live: Live) -> None:
        """Stop as Ctrl-Z asks, with the shell's own screen, and come back to this one."""
        self._stop_asked = False
        live.stop()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTSTP)
        signal.signal(signal.SIGTSTP, self._ask_to_stop)
        live.start()

    def _head(self) -> Text:
        trainer = self._trainer
        state = "learned" if trainer.learned else "not learned yet"
        text = f" koopdqn  {trainer.workcell.task.name}   {state}   {_clock(monotonic() - self._began)}"
        return Text(text.ljust(self._console.width), Style(reverse=True, bold=True), no_wrap=True, overflow="crop")

    def _numbers(self) -> Table:
        trainer, settings = self._trainer, self._trainer.settings
        history, checks = trainer.history, trainer.history.checks
        success = np.array([check.success_rate for check in checks])
        distance = 1e3 * trainer.workcell.task.step_m * np.array([check.intent_distance for check in checks])
        losses = np.array(history.losses)
        (began, steps), now = self._recent[0], monotonic()
        none = "no check yet"
        rows = [
            ("time left", self._left(), ""),
            (
                "success",
                f"{percent(success[-1])} of {settings.check_starts} starts" if checks else none,
                _spark(success),
            ),
            ("deviation", f"{distance[-1]:.1f} mm" if checks else none, _spark(distance)),
            ("passed", f"{trainer.progress.passed} of {settings.checks_to_learn} checks", ""),
            ("questions", f"{trainer.questions:,}" + ("" if self._budget is None else f" of {self._budget:,}"), ""),
            ("actions", f"{trainer.env_steps:,}", ""),
            ("a second", f"{(trainer.env_steps - steps) / max(now - began, 1e-9):,.0f}", ""),
            ("episodes", f"{len(history.rewards):,}", ""),
            ("updates", f"{trainer.learner.updates:,}", ""),
            ("loss", f"{losses[-1]:.3g}" if len(losses) else none, _spark(losses)),
            ("ε", f"{trainer.agent.epsilon(trainer.env_steps):.3f}", ""),
        ]
        table = Table.grid(padding=(0, 1))
        table.add_column(style=_DIM, width=9)
        table.add_column(no_wrap=True, overflow="crop", width=17)
        table.add_column(style=_LEARNED, no_wrap=True)
        for row in rows:
            table.add_row(*row)
        return table

    def _left(self) -> str:
        """Return how long the training still takes, at least and at most, at the pace so far."""
        trainer, settings = self._trainer, self._trainer.settings
        began, steps, updates, episodes = self._from
        seconds = monotonic() - began
        done = trainer.env_steps - steps
        if not done:
            return "–"

        def until(end: int) -> str:
            left, finished = max(end - trainer.env_steps, 0) * seconds / done, len(trainer.history.rewards)
            if finished > episodes:
                left = min(left, max(settings.max_episodes - finished, 0) * seconds / (finished - episodes))
            return _clock(left)

        end = settings.max_steps
        if trainer.learned:
            # What stops at once when it has learned is shown no more.
            if settings.extend is not None:
                end = min(end, int(settings.extend * trainer.progress.learned_at))
            return until(end)
        most = until(end)
        made = trainer.learner.updates - updates
        if not made or settings.stop == "limit":
            return f"at most {most}"
        checks = settings.checks_to_learn - trainer.progress.passed
        wanted = checks * settings.check_every - trainer.learner.updates % settings.check_every
        return f"{_clock(wanted * seconds / made)} to {most}"

    def _sources(self) -> RenderableType:
        labelled = self._trainer.history.labelled
        total = int(labelled[list(_BARS)].sum())
        if not total:
            return Text("nothing yet", _DIM)
        width = self._console.width - 4
        ends = np.rint(width * np.cumsum([labelled[source] for source in _BARS]) / total).astype(int)
        bar, words, begin = Text(), Text(), 0
        for (source, (letter, colour)), end in zip(_BARS.items(), ends.tolist(), strict=True):
            bar.append(letter * (end - begin), Style(color=colour))
            words.append(f"{letter} ", Style(color=colour))
            words.append(f"{SOURCES[source]} {labelled[source] / total:.1%}  ")
            begin = end
        return Group(bar, words)

    def _picture(self) -> Picture:
        trainer, plane = self._trainer, list(self._plane)
        tracks = [Track(track[:, plane], _SHOWN) for track in self._tracks]
        if len(trainer.checked_path):
            tracks.append(Track(trainer.checked_path[:, POSITION][:, plane], _LEARNED))
        tracks.append(Track(trainer.env.episodes.poses[:, POSITION][:, plane], _NOW, joined=False))
        return Picture(self._frame[:, plane], tracks, [("g", trainer.workcell.task.goal[POSITION][plane], _GOAL)])


def widest_plane(points: Array) -> tuple[int, int]:
    """Return the two of three coordinates in which points (N, 3) cover the largest area."""
    extent = points.max(axis=0) - points.min(axis=0)
    return max(_PLANES, key=lambda plane: float(extent[list(plane)].prod()))


def _legend() -> Text:
    return Text.assemble(
        ("demonstrated", _SHOWN), "  ", ("learned", _LEARNED), "  ", ("now", _NOW), "  ", ("g goal", _GOAL)
    )


def _spark(values: Array) -> str:
    return bars(values[-_SPARK:], _SPARK)[0]


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
