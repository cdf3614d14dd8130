import struct
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
import pytest
from parts import load_parts
from PIL import Image

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.evaluation.evaluate import Evaluation
from koopdqn.evaluation.metrics import wilson_interval
from koopdqn.plots import demos, evaluation, fit, style, train
from koopdqn.plots.demos import plot_demonstrations
from koopdqn.plots.evaluation import plot_evaluation
from koopdqn.plots.fit import plot_fit
from koopdqn.plots.style import SERIES, draw_motion, picture, series_colours
from koopdqn.plots.train import plot_training
from koopdqn.rl.checks import Check, History
from koopdqn.tasks.rollout import STEP_LIMIT, SUCCESS, Episode

if TYPE_CHECKING:
    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.intent.fit import Fitted
    from koopdqn.pose import Array
    from koopdqn.tasks.shelf import ShelfTask
    from koopdqn.tasks.workcell import Workcell

IMAGE = np.full((72, 90, 3), 128, dtype=np.uint8)


def chunks(path: Path) -> set[str]:
    """Return the kinds of chunk of a PNG file."""
    data, at, kinds = path.read_bytes(), 8, set()
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        kinds.add(data[at + 4 : at + 8].decode())
        at += 12 + length
    return kinds


def check_png(path: Path, width: int, height: int) -> np.ndarray:
    """Check that a file is a PNG of a size that says nothing of when or with what it was made; return its pixels."""
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert not chunks(path) & {"tEXt", "iTXt", "zTXt", "tIME"}
    with Image.open(path) as image:
        assert image.size == (width, height)
        return np.asarray(image.convert("RGB"))


@pytest.fixture(scope="module")
def paths(demonstrations: "Demonstrations") -> "list[Array]":
    return [item.poses[:, pose.POSITION] for item in demonstrations.items]


@pytest.fixture(scope="module")
def history() -> History:
    rng = np.random.default_rng(0)
    count = 80
    checks = [Check(250 * i, 9000 * i, 20 * i, min(0.3 * i, 1.0), 9.0 / i, {}) for i in range(1, 5)]
    return History(
        rewards=rng.normal(20, 5, count).tolist(),
        lengths=[100] * count,
        exploring=(rng.random(count) < 0.5).tolist(),
        losses=[0.1, 0.03, 0.01, 0.004],
        checks=checks,
        labelled=np.array([0, 9000, 40, 300, 200]),
        agreed=np.array([0, 8900, 40, 297, 190]),
    )


@pytest.fixture(scope="module")
def train_report() -> dict[str, Any]:
    return {
        "task": "shelf",
        "learned": True,
        "learned_at_env_steps": 36000,
        "env_steps": 40000,
        "episodes": 80,
        "oracle_queries": 40,
    }


@pytest.fixture(scope="module")
def references(shelf_task: "ShelfTask") -> "list[Array]":
    starts = shelf_task.draw_starts(np.random.default_rng(3), 4)
    return [shelf_task.demonstrator.roll_out(start, 600) for start in starts]


@pytest.fixture(scope="module")
def episodes(references: "list[Array]") -> list[Episode]:
    """The references, each moved sideways a little; the last ends half-way."""
    moved = [pose.make(path[:, :3] + [0.0, 0.004, 0.0], path[:, 3:]) for path in references]
    moved[-1] = moved[-1][: len(moved[-1]) // 2]
    outcomes = [SUCCESS] * 3 + [STEP_LIMIT]
    return [Episode(path, np.zeros((len(path), 6)), outcome) for path, outcome in zip(moved, outcomes, strict=True)]


def method(successes: int, mean: float | None) -> dict[str, Any]:
    deviation = {"mean": mean, "max": mean and 3 * mean, "p95_of_max": mean and 2 * mean, "frechet": mean}
    interval = list(wilson_interval(successes, 4))
    return {"success_rate": successes / 4, "success_interval_95": interval, "path_deviation_mm": deviation}


@pytest.fixture(scope="module")
def eval_report() -> dict[str, Any]:
    baselines = {"straight_line": method(0, None), "greedy": method(4, 5.5), "nearest_demonstration": method(4, 20.0)}
    return {**method(3, 4.0), "baselines": baselines}


@pytest.mark.parametrize("image", [None, IMAGE])
def test_demonstrations_with_and_without_the_rendered_scene(
    tmp_path: Path, demonstrations: "Demonstrations", shelf_task: "ShelfTask", image: np.ndarray | None
) -> None:
    first, second = tmp_path / "a.png", tmp_path / "b.png"
    plot_demonstrations(first, demonstrations, shelf_task, image)
    plot_demonstrations(second, demonstrations, shelf_task, image)
    pixels = check_png(first, demos.WIDTH, demos.HEIGHT)
    assert first.read_bytes() == second.read_bytes()
    # A grey panel is there if and only if an image is given.
    assert ((pixels == 128).all(axis=2).mean() > 0.05) == (image is not None)


def test_every_demonstration_is_drawn_in_its_own_colour(
    tmp_path: Path, demonstrations: "Demonstrations", shelf_task: "ShelfTask"
) -> None:
    path = tmp_path / "demos.png"
    plot_demonstrations(path, demonstrations, shelf_task, None)
    pixels = check_png(path, demos.WIDTH, demos.HEIGHT).reshape(-1, 3)
    for colour in series_colours(len(demonstrations)):
        assert (np.abs(pixels - 255 * np.array(mpl.colors.to_rgb(colour))).max(axis=1) < 3).sum() > 200


@pytest.mark.parametrize("count", [1, len(SERIES), len(SERIES) + 1, 20])
def test_of_so_many_demonstrations_no_two_have_one_colour(count: int) -> None:
    assert len(set(series_colours(count))) == count


def test_fit(tmp_path: Path, fitted: "Fitted", demonstrations: "Demonstrations", shelf_task: "ShelfTask") -> None:
    first, second = tmp_path / "a.png", tmp_path / "b.png"
    plot_fit(first, fitted, demonstrations, shelf_task)
    plot_fit(second, fitted, demonstrations, shelf_task)
    check_png(first, fit.WIDTH, fit.HEIGHT)
    assert first.read_bytes() == second.read_bytes()


def test_fit_shades_the_steps_at_which_the_expert_is_asked(
    tmp_path: Path, fitted: "Fitted", demonstrations: "Demonstrations", shelf_task: "ShelfTask"
) -> None:
    shade = np.array(mpl.colors.to_rgb(style.ASK)) * 255
    shares = []
    for doubt in (0.1, np.inf):
        trust = replace(fitted.trust, doubt=np.full_like(fitted.trust.doubt, doubt))
        path = tmp_path / "fit.png"
        plot_fit(path, replace(fitted, trust=trust), demonstrations, shelf_task)
        pixels = check_png(path, fit.WIDTH, fit.HEIGHT)
        shares.append((np.abs(pixels - shade).max(axis=2) < 2).mean())
    assert shares[0] == 0.0
    assert shares[1] > 0.1


@pytest.mark.parametrize(("matching", "asked"), [("nowhere", True), ("everywhere", False)])
def test_a_domain_without_a_place_is_not_drawn(
    tmp_path: Path, demonstrations: "Demonstrations", matching: str, asked: bool
) -> None:
    from koopdqn.intent.fit import fit as fit_intent

    chosen, path = load_parts(f"trust={matching}"), tmp_path / "fit.png"
    fitted = fit_intent(demonstrations, chosen.task, chosen.intent, chosen.trust, chosen.reward)
    plot_fit(path, fitted, demonstrations, chosen.task)
    pixels = check_png(path, fit.WIDTH, fit.HEIGHT)

    def share(colour: str) -> float:
        return float((np.abs(pixels - np.array(mpl.colors.to_rgb(colour)) * 255).max(axis=2) < 2).mean())

    # The legend alone names what is trusted.
    assert share(style.TRUST) < 0.001
    assert (share(style.ASK) > 0.1) == asked


def test_training(tmp_path: Path, history: History, train_report: dict[str, Any]) -> None:
    first, second = tmp_path / "a.png", tmp_path / "b.png"
    plot_training(first, history, train_report)
    plot_training(second, history, train_report)
    check_png(first, train.WIDTH, train.HEIGHT)
    assert first.read_bytes() == second.read_bytes()


def test_training_that_was_stopped_before_anything_happened(tmp_path: Path, train_report: dict[str, Any]) -> None:
    path = tmp_path / "train.png"
    plot_training(path, History(), {**train_report, "learned": False, "learned_at_env_steps": None})
    check_png(path, train.WIDTH, train.HEIGHT)


@pytest.mark.parametrize("image", [None, IMAGE])
def test_evaluation_with_and_without_the_rendered_scene(
    tmp_path: Path,
    eval_report: dict[str, Any],
    episodes: list[Episode],
    references: "list[Array]",
    demonstrations: "Demonstrations",
    shelf_task: "ShelfTask",
    image: np.ndarray | None,
) -> None:
    first, second = tmp_path / "a.png", tmp_path / "b.png"
    for path in (first, second):
        done = Evaluation(eval_report, episodes, episodes, references)
        plot_evaluation(path, done, demonstrations, shelf_task, image)
    check_png(first, evaluation.WIDTH, evaluation.HEIGHT)
    assert first.read_bytes() == second.read_bytes()


def test_evaluation_in_which_nothing_moved_and_nothing_is_compared(
    tmp_path: Path, references: "list[Array]", demonstrations: "Demonstrations", shelf_task: "ShelfTask"
) -> None:
    path = tmp_path / "eval.png"
    still = [Episode(reference[:1], np.zeros((1, 6)), STEP_LIMIT) for reference in references]
    done = Evaluation({**method(0, None), "baselines": None}, still, still, references)
    plot_evaluation(path, done, demonstrations, shelf_task, None)
    check_png(path, evaluation.WIDTH, evaluation.HEIGHT)


def test_the_users_own_matplotlib_settings_play_no_part(
    tmp_path: Path, history: History, train_report: dict[str, Any]
) -> None:
    plain, styled = tmp_path / "a.png", tmp_path / "b.png"
    plot_training(plain, history, train_report)
    with mpl.rc_context({"font.size": 30, "lines.linewidth": 9, "savefig.facecolor": "black"}):
        plot_training(styled, history, train_report)
        assert mpl.rcParams["font.size"] == 30
    assert plain.read_bytes() == styled.read_bytes()


def test_a_picture_that_fails_leaves_nothing_and_keeps_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "kept.png"
    path.write_bytes(b"old")

    def fail() -> None:
        with picture(path, "title", 300, 200):
            raise ValueError("no picture")

    with pytest.raises(ValueError, match="no picture"):
        fail()
    assert [file.name for file in tmp_path.iterdir()] == ["kept.png"]
    assert path.read_bytes() == b"old"


def test_a_file_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInputError, match="must be writable"), picture(tmp_path / "file" / "a.png", "t", 300, 200):
        pass


@pytest.mark.draws
def test_motion_is_drawn_with_its_paths_in_the_colours_of_the_plots(
    workcell: "Workcell", demonstrations: "Demonstrations", paths: "list[Array]"
) -> None:
    joints = demonstrations.items[0].joints
    assert joints is not None
    plain = draw_motion(workcell.scene, joints, [], size=(240, 180)).astype(int)
    blue, orange = (
        draw_motion(workcell.scene, joints, paths[:1], [colour], (240, 180)).astype(int) for colour in SERIES[:2]
    )
    assert plain.shape == (180, 240, 3)
    drawn = np.abs(blue - orange).max(axis=2) > 40
    assert drawn.sum() > 30
    # Single pixels at edges may be lit otherwise.
    assert np.mean((blue - orange)[drawn][:, 2] > 0) > 0.95


@pytest.mark.parametrize(
    ("extent", "planes"),
    [
        ((0.3, 0.2, 0.1), ("top", "side")),
        ((0.1, 0.3, 0.2), ("top", "side")),
        ((0.0, 0.2, 0.2), ("side", "front")),
        ((0.01, 0.3, 0.2), ("top", "front")),
        ((0.01, 0.2, 0.3), ("side", "front")),
        ((0.3, 0.2, 0.0), ("top", "side")),
        ((0.0, 0.0, 0.3), ("top", "side")),
    ],
)
def test_no_path_is_shown_edge_on_where_the_front_shows_more(
    extent: tuple[float, float, float], planes: tuple[str, str]
) -> None:
    from koopdqn.plots.style import two_planes

    paths = [np.zeros((1, 3)), np.array([extent])]
    assert two_planes(paths) == planes


@pytest.mark.parametrize(("value", "text"), [(0.423, "0.42"), (4.2, "4.2"), (14.04, "14"), (102.6, "100"), (0.0, "0")])
def test_a_number_in_a_picture_has_two_digits_and_no_exponent(value: float, text: str) -> None:
    assert style.two_digits(value) == text
