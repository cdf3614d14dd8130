"""Showing a better way by keys: what keys make of a learned path, and what stands on the screen."""

from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from helpers_shelf import shelf
from hypothesis import given, settings
from hypothesis import strategies as st

from koopdqn.app.recording.correcting import HELP, Shown, compose
from koopdqn.app.recording.showing import ADD, BACK, ON, PLAY, Showing
from koopdqn.evaluation.correction import MOST_WAYPOINTS, along, read_waypoints
from koopdqn.pose import POSITION
from koopdqn.tasks.rollout import SUCCESS, Episode
from koopdqn.tasks.start_frame import STILL

FEW = settings(max_examples=20, deadline=None)
MIDDLE = ON * 50
"""Keys that lead to the middle of the path: 0.25 m."""


@pytest.fixture(scope="module")
def episode() -> Episode:
    task, reachability = shelf().task, shelf().reachability
    poses = task.demonstrator.roll_out(task.nominal_start, 600)
    joints, reason = reachability.follow(poses)
    assert joints is not None, reason
    return Episode(poses, joints, SUCCESS)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shown")


def begin(episode: Episode, folder: Path, keys: str = "") -> Showing:
    """Press keys on a path that stands at its start."""
    showing = Showing(episode, along(episode, STILL), STILL, shelf(), folder / "waypoints.csv")
    showing.file.unlink(missing_ok=True)
    showing.press(PLAY)
    for key in keys:
        showing.press(key)
    return showing


def test_a_played_path_goes_from_its_start_to_its_end_and_stops_where_it_is_told(
    episode: Episode, folder: Path
) -> None:
    showing = Showing(episode, along(episode, STILL), STILL, shelf(), folder / "waypoints.csv")
    np.testing.assert_allclose(showing.here, episode.poses[0], atol=2e-3)
    showing.play(1.0)
    assert showing.place == pytest.approx(0.1)
    showing.press(PLAY)
    showing.play(1.0)
    assert showing.place == pytest.approx(0.1)
    showing.press(PLAY)
    showing.play(60.0)
    assert not showing.playing
    np.testing.assert_allclose(showing.here, episode.poses[-1], atol=2e-3)
    showing.press(PLAY)
    assert showing.place == 0.0


@FEW
@given(moves=st.text("wsadrf", max_size=12))
def test_the_waypoint_lies_beside_the_path_by_what_the_keys_say(episode: Episode, folder: Path, moves: str) -> None:
    showing = begin(episode, folder, MIDDLE + moves)
    expected = 0.005 * np.array([moves.count(a) - moves.count(b) for a, b in ("ws", "ad", "rf")])
    np.testing.assert_allclose(showing.waypoint - showing.here[POSITION], expected, atol=1e-4)
    assert showing.place == pytest.approx(0.25)
    assert showing.loose == bool(expected.any())


@FEW
@given(keys=st.text("wsadrf+-ux" + ADD + BACK + ON + PLAY, max_size=60))
def test_whatever_is_pressed_the_file_holds_what_is_added(episode: Episode, folder: Path, keys: str) -> None:
    showing = begin(episode, folder, MIDDLE + keys)
    held = np.array(read_waypoints(showing.file)) if showing.file.exists() else np.zeros((0, 3))
    np.testing.assert_array_equal(held, showing.waypoints)
    assert len(held) == len(showing.added)
    if len(held):
        along(episode, STILL).through(held)


def test_waypoints_come_in_the_order_of_the_path_and_the_last_added_is_taken_back_first(
    episode: Episode, folder: Path
) -> None:
    showing = begin(episode, folder, MIDDLE + "rrr" + ADD + BACK * 8 + "r" + ADD)
    later, earlier = showing.added
    np.testing.assert_array_equal(showing.waypoints, [earlier, later])
    showing.press("u")
    np.testing.assert_array_equal(showing.waypoints, [later])
    showing.press("u")
    assert not showing.file.exists()
    assert not showing.press("u").changed


def test_the_path_under_way_is_the_one_that_the_waypoints_give(episode: Episode, folder: Path) -> None:
    showing = begin(episode, folder, MIDDLE)
    assert showing.under_way is None
    showing.press("r")
    moved = showing.under_way
    assert moved is not None
    assert np.linalg.norm(moved - showing.waypoint, axis=1).min() < 1e-6
    showing.press(ADD)
    given = along(episode, STILL).through(showing.waypoints)
    assert showing.under_way is not None
    np.testing.assert_array_equal(showing.under_way, given.bent)


def test_what_cannot_be_a_waypoint_is_refused_and_why(episode: Episode, folder: Path) -> None:
    showing = begin(episode, folder, "r")
    assert "at least 0.02 m of path from its start" in showing.press(ADD).text
    showing = begin(episode, folder, MIDDLE + "+" * 9 + "r" * 15)
    assert "within 0.2 m of the learned path" in showing.press(ADD).text
    assert not showing.added
    showing.added = [np.zeros(3)] * MOST_WAYPOINTS
    assert f"there may be {MOST_WAYPOINTS} waypoints" in showing.press(ADD).text


def test_a_path_does_not_go_on_from_a_waypoint_that_is_not_added(episode: Episode, folder: Path) -> None:
    showing = begin(episode, folder, MIDDLE + "r")
    assert "Enter adds it" in showing.press(PLAY).text
    assert not showing.playing
    showing.press("x")
    showing.press(PLAY)
    assert showing.playing


def test_it_is_told_whether_the_arm_can_be_at_the_waypoint(episode: Episode, folder: Path) -> None:
    free = begin(episode, folder, MIDDLE)
    assert "can be there, payload" in free.standing()
    with patch.object(type(shelf().scene), "payload_clearance", lambda self, joints, at_most: at_most):
        # Nothing is carried, or nothing is near.
        assert free.standing() == "can be there"
    # Into the side wall of the shelf.
    assert "shelf" in begin(episode, folder, MIDDLE + "++" + "w" * 8).standing()
    assert "out of reach" in begin(episode, folder, MIDDLE + "++" + "r" * 60).standing()


@settings(max_examples=40, deadline=None)
@given(
    width=st.integers(20, 200), height=st.integers(8, 70), helps=st.booleans(), keys=st.text("wrd" + ADD, max_size=9)
)
def test_a_screen_fits_its_terminal(
    episode: Episode, folder: Path, width: int, height: int, helps: bool, keys: str
) -> None:
    showing = begin(episode, folder, MIDDLE + keys)
    lines = compose(Shown(showing, "shelf", "runs/shelf", "a status " * 40, helps), width, height)
    assert len(lines) == height
    assert all(line.cell_len <= width for line in lines)
    assert lines[-1].cell_len < width, "a full last line would scroll"


@pytest.mark.parametrize(("width", "height"), [(80, 24), (120, 40)])
def test_a_screen_says_all_that_showing_needs(episode: Episode, folder: Path, width: int, height: int) -> None:
    showing = begin(episode, folder, MIDDLE + "rrrr" + ADD + ON * 4 + "a")
    lines = [line.plain for line in compose(Shown(showing, "shelf", "runs/new", "done"), width, height)]
    text = " ".join(" ".join(lines).split())
    words = ("0.270 of", "stopped", "aside +0.0 +5.0 +20.0 mm", "1 waypoint", "payload", "into runs/new", "moved 2")
    for word in (*words, "from above", "z up", "Enter add", "q quit"):
        assert word in text, word
    picture = "".join(line[: width - 42] for line in lines[1:-4])
    for mark in "sgt1w":
        assert mark in picture, mark
    assert lines[-1] == "done"


def test_the_help_is_whole_on_a_small_screen(episode: Episode, folder: Path) -> None:
    lines = compose(Shown(begin(episode, folder), "shelf", "runs/new", help=True), 80, 24)
    text = "\n".join(line.plain for line in lines)
    assert all(line in text for line in HELP)


def test_a_waypoint_on_the_path_moves_nothing_and_is_shown(episode: Episode, folder: Path) -> None:
    showing = begin(episode, folder, MIDDLE)
    showing.added = [showing.path[len(showing.path) // 2]]
    assert showing.under_way is not None
    text = "\n".join(line.plain for line in compose(Shown(showing, "shelf", "runs/new"), 80, 24))
    assert "1 waypoint" in text
    assert "moved" not in text


def test_an_unknown_key_is_told(episode: Episode, folder: Path) -> None:
    reply = begin(episode, folder).press("z")
    assert not reply.changed
    assert "'z' is no key here" in reply.text


def test_waypoints_of_a_file_may_have_a_header_and_a_wrong_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "shown.csv"
    path.write_text("x,y,z\n0.1, 0.2,0.3\n\n0.4,0.5,0.6 # aside\n", encoding="utf-8")
    assert read_waypoints(path) == ((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))
    for content, words in (
        ("0.1,0.2,0.3\n0.4,abc,0.6\n", r"line 2: must hold x,y,z in m, found '0\.4,abc,0\.6'"),
        ("0.1,0.2\n", "line 1: must hold x,y,z in m"),
        ("x,y,z\n\n", "must hold x,y,z a line, found none"),
    ):
        path.write_text(content, encoding="utf-8")
        with pytest.raises(ValueError, match=words):
            read_waypoints(path)
