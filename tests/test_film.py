"""Films: as many frames as asked for, the arm moving in them, and files that players take."""

from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
import PIL.Image
import pytest
from helpers_shelf import shelf
from helpers_view import motions

from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.pose import position_distance
from koopdqn.view import film
from koopdqn.view.motions import nearest_motion


@pytest.mark.draws
def test_a_film_shows_both_arms_move_and_a_cursor_that_goes_on() -> None:
    learned, demonstrated = motions()[0], motions()[-1]
    first, middle, last = film.film_frames(shelf().scene, learned, demonstrated, 3)
    assert first.shape == (480, 640, 3)
    for part in (slice(0, 320), slice(320, 640)):
        assert (first[30:320, part] != last[30:320, part]).any(axis=2).mean() > 0.02
    columns = [
        np.flatnonzero((frame[370:430, 60:310] == 34).all(axis=(0, 2))).mean() for frame in (first, middle, last)
    ]
    assert np.diff(columns) == pytest.approx([120.0, 120.0], abs=1.5)


@pytest.mark.draws
def test_a_film_is_not_as_somebodys_own_settings_of_matplotlib_have_it() -> None:
    learned, demonstrated = motions()[0], motions()[-1]
    [plain] = film.film_frames(shelf().scene, learned, demonstrated, 1)
    with mpl.rc_context({"savefig.bbox": "tight", "axes.facecolor": "black", "text.usetex": True}):
        [again] = film.film_frames(shelf().scene, learned, demonstrated, 1)
    np.testing.assert_array_equal(plain, again)


@pytest.mark.draws
def test_a_film_says_that_its_policy_fails() -> None:
    learned, demonstrated = motions()[0], motions()[-1]
    said = [
        next(iter(film.film_frames(shelf().scene, replace(learned, fails=fails), demonstrated, 1)))[:30]
        for fails in (True, False)
    ]
    assert (said[0] != said[1]).any()


@pytest.mark.parametrize("name", ["film.mp4", "film.gif"])
@pytest.mark.draws
def test_a_film_lasts_as_long_as_it_says(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "SECONDS", 0.5)
    done: list[float] = []
    path = tmp_path / name
    film.write_film(path, shelf().scene, motions()[0], motions()[-1], done.append)
    rate = film.FRAMES_PER_SECOND[path.suffix]
    assert sum(done) == 0.5 * rate
    if path.suffix == ".gif":
        with PIL.Image.open(path) as shown:
            assert (shown.size, shown.n_frames) == (film.SIZE, 0.5 * rate)  # type: ignore[attr-defined]  # of GIFs
        return
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    about = next(imageio_ffmpeg.read_frames(str(path)))
    assert about["size"] == film.SIZE
    assert about["duration"] == pytest.approx(0.5, abs=0.06)
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_a_film_is_no_other_kind_of_file_and_overwrites_none(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"video: must end in \.mp4 or \.gif, found"):
        film.check_film(tmp_path / "film.avi", "video")
    (tmp_path / "mine.gif").touch()
    with pytest.raises(BadInputError, match="must name a new file"):
        film.check_film(tmp_path / "mine.gif", "video")


def test_a_folder_that_cannot_be_written_is_told_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)
    with pytest.raises(BadInputError, match="video: must name a file in a folder that can be written, found"):
        film.check_film(tmp_path / "film.gif", "video")


def test_a_missing_encoder_is_named_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    film.check_film(tmp_path / "film.gif", "video")
    with pytest.raises(WorkFailedError, match=r"koopdqn\[video\]"):
        film.check_film(tmp_path / "film.mp4", "video")


def test_the_demonstration_beside_is_the_one_that_begins_nearest() -> None:
    shown = [motion for motion in motions() if motion.kind == "demonstration"]
    start = motions()[0].poses[0]
    gaps = [float(position_distance(motion.poses[0], start)) for motion in shown]
    assert nearest_motion(shown, start) is shown[int(np.argmin(gaps))]
    with pytest.raises(WorkFailedError, match="found none"):
        nearest_motion([], start)
