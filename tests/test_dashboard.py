"""The dashboard of a training: it fits its screen, says what the trainer says, and changes nothing."""

import io
import signal
from pathlib import Path

import numpy as np
import pytest
from helpers_shelf import reward_of, shelf, taught
from helpers_training import assert_same_run, small_trainer
from parts import load_parts
from small_run import SMALL
from terminal_session import Session

from koopdqn.console import LiteralConsole
from koopdqn.rl.algorithm1 import Trainer
from koopdqn.view import dashboard as module
from koopdqn.view.dashboard import LEAST, Dashboard, fits, widest_plane


def trainer() -> Trainer:
    known = taught()
    return small_trainer(load_parts(), shelf(), reward_of(known), known.trajectories)


def terminal(width: int = 80, height: int = 24) -> LiteralConsole:
    return LiteralConsole(file=io.StringIO(), force_terminal=True, width=width, height=height)


def shown(board: Dashboard, console: LiteralConsole) -> list[str]:
    with console.capture() as captured:
        console.print(board.content())
    return [line.rstrip() for line in captured.get().splitlines()]


@pytest.fixture(scope="module")
def trained() -> Trainer:
    made = trainer()
    made.run()
    return made


@pytest.mark.parametrize("size", [LEAST, (140, 40), (300, 100)])
def test_it_fills_the_screen_and_says_what_the_trainer_says(trained: Trainer, size: tuple[int, int]) -> None:
    console = LiteralConsole(file=io.StringIO(), width=size[0], height=size[1])
    board = Dashboard(trained, taught().trajectories, 60, console)
    lines = shown(board, console)
    assert len(lines) == size[1]
    assert max(map(len, lines)) <= size[0]
    text = "\n".join(lines)
    last = trained.history.checks[-1]
    for part in (
        f"success   {last.success_rate:.0%} of",
        f"deviation {1e3 * shelf().task.step_m * last.intent_distance:.1f} mm",
        f"questions {trained.questions} of 60",
        f"actions   {trained.env_steps:,}",
        f"updates   {trained.learner.updates:,}",
        f"loss      {trained.history.losses[-1]:.3g}",
        f"ε         {trained.agent.epsilon(trained.env_steps):.3f}",
        "demonstrated  learned  now",
    ):
        assert part in text
    labelled = trained.history.labelled[1:]
    assert f"trusted {labelled[0] / labelled.sum():.1%}" in text
    assert any("\u2801" <= letter <= "\u28ff" for letter in text)


def test_before_anything_happened_it_says_so() -> None:
    console = LiteralConsole(file=io.StringIO(), width=80, height=24)
    text = "\n".join(shown(Dashboard(trainer(), taught().trajectories, None, console), console))
    assert text.count("no check yet") == 3
    assert text.count("nothing yet") == 2


def test_the_same_seed_learns_the_same_with_and_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_REDRAW_SECONDS", 0.0)
    monkeypatch.setattr(module, "_MOST_OF_TIME", 1.0)
    alone, watched, console = trainer(), trainer(), terminal()
    alone.run()
    with Dashboard(watched, taught().trajectories, None, console) as board:
        watched.run(on_round=board.round)
    assert_same_run(alone, watched)
    assert isinstance(console.file, io.StringIO)
    written = console.file.getvalue()
    # The other screen is entered and left, and a picture begins at the top without erasing.
    assert written.startswith("\x1b[?1049h")
    assert "\x1b[?1049l" in written
    assert written.count("\x1b[H") > 5
    assert "\x1b[2J" not in written


def test_it_draws_four_times_a_second_and_takes_a_hundredth_of_the_time_at_most(
    trained: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, took, drawn = 100.0, 0.001, []

    def content(board: Dashboard) -> str:
        nonlocal now
        now += took
        drawn.append(now)
        return "drawn"

    monkeypatch.setattr(module, "monotonic", lambda: now)
    monkeypatch.setattr(Dashboard, "content", content)
    with Dashboard(trained, taught().trajectories, None, terminal()) as board:
        for seconds, most in ((0.001, 41), (0.1, 3)):
            took = seconds
            drawn.clear()
            end = now + 10.0
            while now < end:
                board.round()
                now += 0.01
            assert most - 2 <= len(drawn) <= most


def test_ctrl_z_gives_the_screen_back_until_it_comes_back(monkeypatch: pytest.MonkeyPatch, trained: Trainer) -> None:
    stopped: list[bool] = []
    with Dashboard(trained, taught().trajectories, None, terminal()) as board:
        live = board._live
        assert live is not None
        monkeypatch.setattr("os.kill", lambda process, number: stopped.append(live.is_started))
        signal.raise_signal(signal.SIGTSTP)
        assert not stopped
        board.round()
        assert stopped == [False]
        assert live.is_started
    assert signal.getsignal(signal.SIGTSTP) == signal.SIG_DFL


def test_time_left_comes_from_the_pace_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(module, "monotonic", lambda: now)
    watched = trainer()
    watched.settings = watched.settings.model_copy(
        update={"stop": "learned", "max_steps": 10_000, "checks_to_learn": 2, "check_every": 10}
    )
    board = Dashboard(watched, taught().trajectories, None, terminal())
    assert board._left() == "–"
    now += 10.0
    watched.env_steps, watched.learner.updates = 1_000, 5
    # 15 updates to two checks at one in 2 s, and 9,000 actions at 100 a second.
    assert board._left() == "0:30 to 1:30"
    # Three of four episodes in those 10 s, or all.
    watched.history.rewards.extend([0.0] * 3)
    watched.settings = watched.settings.model_copy(update={"max_episodes": 4})
    assert board._left().endswith("to 0:03")
    watched.history.rewards.clear()
    watched.progress.learned_at = 1_000
    watched.settings = watched.settings.model_copy(update={"stop": "limit", "extend": 3.0})
    assert board._left() == "0:20"


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"force_terminal": True, "width": 80, "height": 24}, True),
        ({"force_terminal": True, "width": 79, "height": 24}, False),
        ({"force_terminal": True, "width": 80, "height": 23}, False),
        ({"force_terminal": False, "width": 80, "height": 24}, False),
        ({"force_terminal": True, "width": 80, "height": 24, "_environ": {"TERM": "dumb"}}, False),
    ],
)
def test_it_needs_a_terminal_with_room(options: dict[str, object], expected: bool) -> None:
    assert fits(LiteralConsole(file=io.StringIO(), **options)) is expected


@pytest.mark.parametrize(("flat", "plane"), [(0, (1, 2)), (1, (0, 2)), (2, (0, 1))])
def test_paths_are_seen_from_where_they_cover_most(flat: int, plane: tuple[int, int]) -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    points[:, flat] *= 0.01
    assert widest_plane(points) == plane


def test_at_a_terminal_it_stands_while_it_learns_and_then_gives_the_screen_back(tmp_path: Path) -> None:
    arguments = ("train", *SMALL, "train.max_steps=4000", f"out={tmp_path}/run")
    with Session(*arguments) as session:
        text = session.wait("Ctrl-C stops", 120.0)
        assert "not learned yet" in text
        assert "where rewards came from" in text
        assert session.finish() == 1
        assert session.raw.rindex(b"\x1b[?1049l") > session.raw.rindex(b"\x1b[?1049h")
        assert session.raw.rindex(b"Learning: done in") > session.raw.rindex(b"\x1b[?1049l")


def test_a_terminal_too_small_for_it_has_a_bar(tmp_path: Path) -> None:
    with Session("train", *SMALL, "train.max_steps=2000", f"out={tmp_path}/run", size=(70, 24)) as session:
        session.finish()
        assert b"\x1b[?1049h" not in session.raw
        assert b"Learning: done in" in session.raw
