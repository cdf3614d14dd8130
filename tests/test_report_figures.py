from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
import pytest
from parts import straight_poses
from PIL import Image
from report_runs import knife_parts, train_report

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.plots.style import ASK
from koopdqn.report.figures.components import plot_components, spans
from koopdqn.report.figures.errors import line_distance, plot_errors, plot_line_error, plot_line_fit
from koopdqn.report.figures.poses import best_view, close_view, joints_of, plot_paths, plot_poses
from koopdqn.report.figures.rewards import WINDOW, plot_rewards, running_mean
from koopdqn.report.figures.turn import plot_turn, travelled_at_half_turn
from koopdqn.report.figures.workflow import plot_workflow
from koopdqn.report.intents import HeldOut, IntentStudy
from koopdqn.report.runs import Run

if TYPE_CHECKING:
    from collections.abc import Callable

    from parts import Parts

    from koopdqn.demonstrations.dataset import Demonstrations
    from koopdqn.pose import Array
    from koopdqn.tasks.knife import KnifeTask
    from koopdqn.tasks.shelf import ShelfTask
    from koopdqn.tasks.workcell import Workcell


def check_drawn(tmp_path: Path, draw: "Callable[[Path], None]") -> np.ndarray:
    """Check that drawing twice gives the same PNG, which is not blank; return its pixels."""
    files = tmp_path / "a.png", tmp_path / "b.png"
    for file in files:
        draw(file)
    assert files[0].read_bytes() == files[1].read_bytes()
    with Image.open(files[0]) as image:
        pixels = np.asarray(image.convert("RGB"))
    assert (pixels < 128).any()
    return pixels


def share_of(pixels: np.ndarray, colour: str) -> float:
    wanted = np.array(mpl.colors.to_rgb(colour)) * 255
    return float((np.abs(pixels - wanted).max(axis=2) < 2).mean())


@pytest.fixture(scope="module")
def knife() -> "KnifeTask":
    return knife_parts().task  # type: ignore[return-value]  # the parts are typed for the shelf


@pytest.fixture(scope="module")
def handed(knife: "KnifeTask") -> "list[Array]":
    """Two paths of the knife demonstrator."""
    starts = knife.draw_starts(np.random.default_rng(0), 2)
    return [knife.demonstrator.roll_out(start, 600) for start in starts]


def invented(parts: "Parts", asked: np.ndarray) -> dict[str, IntentStudy]:
    rng = np.random.default_rng(0)
    error, sixty = (rng.uniform(0, 1e-3, (count, 2)) for count in (len(asked), 59))
    held_out = HeldOut(0, error, error, asked, sixty)
    return {name: IntentStudy(name, parts.reward, {}, held_out) for name in ("paper", "pose")}


def test_the_workflow(tmp_path: Path) -> None:
    check_drawn(tmp_path, plot_workflow)


@pytest.mark.parametrize("part", ["position", "orientation"])
def test_components(tmp_path: Path, trajectories: "list[Array]", shelf_task: "ShelfTask", part: str) -> None:
    check_drawn(tmp_path, lambda path: plot_components(path, trajectories, shelf_task, part, 3.0, "Shelf"))  # type: ignore[arg-type]  # one of the two literals


def test_spans_hold_every_pose_and_what_is_held_has_none(trajectories: "list[Array]", shelf_task: "ShelfTask") -> None:
    found = spans(trajectories, shelf_task)
    every = np.concatenate(trajectories)
    for i, name in enumerate("xyz"):
        low, high = found[name]
        assert low == pytest.approx(every[:, i].min(), abs=1e-6)
        assert high == pytest.approx(every[:, i].max(), abs=1e-6)
    assert found["roll"] == found["pitch"] == found["yaw"] == (0.0, 0.0)


@pytest.mark.parametrize("quantity", ["position", "rotation"])
def test_steps_at_which_the_expert_is_asked_are_shaded(
    tmp_path: Path, parts: "Parts", shelf_task: "ShelfTask", quantity: str
) -> None:
    shares = []
    for count in (0, 50, 100):
        studies = invented(parts, np.arange(100) < count)
        pixels = check_drawn(
            tmp_path,
            lambda path, studies=studies: plot_errors(path, studies, shelf_task, quantity, "Errors", bounds=True),  # type: ignore[arg-type,misc]  # one of the two literals; a default that is no constant
        )
        shares.append(share_of(pixels, ASK))
    assert shares[0] == 0.0
    assert 0.4 < shares[1] / shares[2] < 0.6


def test_a_straight_even_path_is_its_own_line_fit(shelf_task: "ShelfTask") -> None:
    quaternion = shelf_task.goal[pose.QUATERNION]
    straight = straight_poses(np.zeros(3), np.array([0.3, -0.2, 0.1]), 40, quaternion)
    assert line_distance(straight).max() < 1e-12
    bent = straight.copy()
    bent[20, 2] += 0.01
    assert line_distance(bent).argmax() == 20


def test_line_fit(tmp_path: Path, trajectories: "list[Array]", parts: "Parts") -> None:
    check_drawn(tmp_path, lambda path: plot_line_fit(path, trajectories[0]))
    studies = invented(parts, np.zeros(len(trajectories[0]) - 1, dtype=bool))
    check_drawn(tmp_path, lambda path: plot_line_error(path, trajectories[0], studies))


@pytest.mark.parametrize("episodes", [0, WINDOW - 1, 60])
@pytest.mark.parametrize("seeds", [1, 3])
def test_rewards_of_few_and_many_episodes(tmp_path: Path, parts: "Parts", episodes: int, seeds: int) -> None:
    reports = [train_report(parts, seed, episodes + seed * (episodes > 0)) for seed in range(seeds)]
    runs = [Run(tmp_path, report, {}, parts.task, parts.arm) for report in reports]
    check_drawn(tmp_path, lambda path: plot_rewards(path, runs, "Rewards"))


def test_the_running_mean_is_the_mean_of_its_window() -> None:
    values = np.random.default_rng(0).normal(size=60)
    means = running_mean(values)
    assert means == pytest.approx([values[i : i + WINDOW].mean() for i in range(60 - WINDOW + 1)])


def test_the_turn_is_half_done_early(tmp_path: Path, handed: "list[Array]", knife: "KnifeTask") -> None:
    check_drawn(tmp_path, lambda path: plot_turn(path, handed, knife, 0))
    for path in handed:
        # Lifting the knife leads away from the goal at first, by a little.
        assert -0.1 < travelled_at_half_turn(path, knife) < 1 / 3


def test_poses_on_the_arm(tmp_path: Path, workcell: "Workcell", demonstrations: "Demonstrations") -> None:
    item = demonstrations.items[0]
    view = best_view(workcell.scene, item)
    near = close_view(workcell.scene, item, view.azimuth + 150)
    assert near.distance < view.distance
    check_drawn(tmp_path, lambda path: plot_poses(path, workcell.scene, item, near, "Shelf"))
    check_drawn(tmp_path, lambda path: plot_paths(path, demonstrations.items, workcell.task, 0))


def test_a_demonstration_without_joints_cannot_be_drawn_on_the_arm(demonstrations: "Demonstrations") -> None:
    from dataclasses import replace

    with pytest.raises(BadInputError, match="must hold joint angles to be drawn on the arm, found none"):
        joints_of(replace(demonstrations.items[0], joints=None))
