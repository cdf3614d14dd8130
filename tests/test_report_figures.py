from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image
from report_runs import knife_parts, train_report

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.plots.poses import best_view, close_view, joints_of, plot_paths, plot_poses
from koopdqn.plots.steps import (
    Errors,
    half_turn,
    line_distance,
    plot_components,
    plot_errors,
    plot_line_error,
    plot_line_fit,
    plot_turn,
    spans,
)
from koopdqn.plots.style import ASK
from koopdqn.plots.train import WINDOW, plot_rewards, plot_sweep, running_mean
from koopdqn.plots.workflow import plot_workflow

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


def invented(asked: np.ndarray) -> dict[str, Errors]:
    rng = np.random.default_rng(0)
    error, sixty = (rng.uniform(0, 1, count) for count in (len(asked), 59))
    return {name: Errors(error, None if name == "paper" else error, asked, sixty) for name in ("paper", "pose")}


def test_the_workflow(tmp_path: Path) -> None:
    check_drawn(tmp_path, plot_workflow)


@pytest.mark.parametrize("part", [0, 3])
def test_components(tmp_path: Path, trajectories: "list[Array]", shelf_task: "ShelfTask", part: int) -> None:
    check_drawn(tmp_path, lambda path: plot_components(path, trajectories, shelf_task, part, 3.0))


def test_spans_hold_every_pose_and_what_is_held_has_none(trajectories: "list[Array]", shelf_task: "ShelfTask") -> None:
    found = spans(trajectories, shelf_task)
    every = np.concatenate(trajectories)
    for i, name in enumerate("xyz"):
        low, high = found[name]
        assert low == pytest.approx(every[:, i].min(), abs=1e-6)
        assert high == pytest.approx(every[:, i].max(), abs=1e-6)
    assert found["roll"] == found["pitch"] == found["yaw"] == (0.0, 0.0)


@pytest.mark.parametrize("bounds", [True, False])
def test_steps_at_which_the_expert_is_asked_are_shaded(tmp_path: Path, bounds: bool) -> None:
    shares = []
    for count in (0, 50, 100):
        errors = invented(np.arange(100) < count)

        def draw(path: Path, errors: dict[str, Errors] = errors) -> None:
            plot_errors(path, "Errors", errors, "mm", 2.0, bounds=bounds)

        shares.append(share_of(check_drawn(tmp_path, draw), ASK))
    assert shares[0] == 0.0
    assert 0.4 < shares[1] / shares[2] < 0.6


def test_a_straight_even_path_is_its_own_line_fit() -> None:
    straight = np.linspace([0.0, 0.0, 0.0], [0.3, -0.2, 0.1], 40)
    assert line_distance(straight).max() < 1e-12
    bent = straight.copy()
    bent[20, 2] += 0.01
    assert line_distance(bent).argmax() == 20


def test_line_fit(tmp_path: Path, trajectories: "list[Array]") -> None:
    positions = trajectories[0][:, pose.POSITION]
    check_drawn(tmp_path, lambda path: plot_line_fit(path, positions))
    errors = {name: np.linspace(0.1, 1.0, len(positions) - 1) for name in ("paper", "pose")}
    check_drawn(tmp_path, lambda path: plot_line_error(path, positions, errors))


@pytest.mark.parametrize("episodes", [0, WINDOW - 1, 60])
@pytest.mark.parametrize("seeds", [1, 3])
def test_rewards_of_few_and_many_episodes(tmp_path: Path, parts: "Parts", episodes: int, seeds: int) -> None:
    reports = [train_report(parts, seed, episodes + seed * (episodes > 0)) for seed in range(seeds)]
    check_drawn(tmp_path, lambda path: plot_rewards(path, reports, "Rewards"))


def test_the_running_mean_is_the_mean_of_its_window() -> None:
    values = np.random.default_rng(0).normal(size=60)
    means = running_mean(values)
    assert means == pytest.approx([values[i : i + WINDOW].mean() for i in range(60 - WINDOW + 1)])


def test_the_turn_is_half_done_early(tmp_path: Path, handed: "list[Array]", knife: "KnifeTask") -> None:
    check_drawn(tmp_path, lambda path: plot_turn(path, handed, knife, 0))
    for path in handed:
        # Lifting the knife leads away from the goal at first, by a little.
        assert -0.1 < half_turn(path, knife)[1] < 1 / 3


def test_a_sweep_is_drawn_with_quantities_that_nobody_measured(tmp_path: Path) -> None:
    variants = [
        ("intent=paper", {"time [s]": [3.0, 4.0, 8.0], "deviation [mm]": []}),
        # A dollar is no mathematics.
        ("demos=US$5_and_$6.csv", {"time [s]": [2.0]}),
    ]
    variants[1][1]["deviation [mm]"] = []
    check_drawn(tmp_path, lambda path: plot_sweep(path, "Sweep of $a_$b", variants))


@pytest.mark.draws
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
