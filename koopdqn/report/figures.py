"""The paper's figures, redrawn: one function a figure, which writes its PNGs and returns it with its caption."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np

from koopdqn import pose
from koopdqn.errors import BadInputError
from koopdqn.plots import poses, steps
from koopdqn.plots.train import WINDOW, plot_rewards
from koopdqn.plots.workflow import plot_workflow
from koopdqn.report.data import SHOWN, Material
from koopdqn.report.runs import DEFAULT, Run
from koopdqn.tasks.knife import KnifeTask

SECOND_CAMERA_DEG: Final = 150.0
"""By how much the knife's second camera stands further round than the first, about the vertical."""
_MM, _DEGREES = 1e3, float(np.degrees(1.0))


@dataclass(frozen=True)
class Figure:
    """A figure with its caption.

    Attributes:
        number: as the paper counts.
        title: in a few words.
        caption: what is seen, with the numbers that matter.
        files: names of its PNGs, which lie beside the page.
        sources: the files that it was drawn from.
        layout: its share of the page's width if it is one picture; halves that follow each other share a row.
    """

    number: str
    title: str
    caption: str
    files: Sequence[str]
    sources: Sequence[Path] = ()
    layout: Literal["narrow", "half", "wide", "full"] = "narrow"


def workflow(folder: Path) -> Figure:
    """Draw Fig. 1."""
    plot_workflow(folder / "figure-1.png")
    caption = (
        "Drawn anew after §3 and §4. A, B: demonstrations become a Koopman model of the person's intent and a domain in"
        " which it is trusted. C: inside the domain the model's prediction decides the reward, outside it a person is"
        " asked. In the default preset both ends of an action must be trusted; the paper looks at the reached state."
    )
    return Figure("1", "Workflow", caption, ["figure-1.png"], layout="wide")


def shelf_poses(material: Material, folder: Path) -> Figure:
    """Draw Fig. 2."""
    items, scene = material.demonstrations.items, material.scene
    view, title = poses.best_view(scene, items[SHOWN]), "Shelf: initial, intermediate, goal"
    poses.plot_poses(folder / "figure-2-arm.png", scene, items[SHOWN], view, title)
    poses.plot_paths(folder / "figure-2-path.png", items, material.run.task, SHOWN)
    caption = (
        f"Initial, two intermediate and the goal pose of demonstration {SHOWN} of {len(items)}, on the arm (goal solid,"
        " earlier poses seen through) and as paths of the flange in the base frame. The flange's axes keep their"
        " directions: orientation is held."
    )
    files = ["figure-2-arm.png", "figure-2-path.png"]
    return Figure("2", "Poses and a demonstration, shelf", caption, files, [material.run.demonstrations_file])


def shelf_components(material: Material, folder: Path) -> Figure:
    """Draw Fig. 3."""
    trajectories, task = material.trajectories, material.run.task
    for first, what in ((0, "position"), (3, "orientation")):
        steps.plot_components(folder / f"figure-3-{what}.png", trajectories, task, first, material.sigmas)
    caption = (
        f"All {len(trajectories)} demonstrations, aligned by the share of their path and resampled to the agent's step:"
        f" mean, samples, and the band of {material.sigmas:g} standard deviations. Roll, pitch and yaw are relative to"
        " the goal's orientation and stay at zero."
    )
    title, files = "Distributions of the pose components, shelf", ["figure-3-position.png", "figure-3-orientation.png"]
    return Figure("3", title, caption, files, [material.run.demonstrations_file])


def shelf_errors(material: Material, folder: Path) -> Figure:
    """Draw Fig. 4, left."""
    errors, tolerance = _errors(material, 0, _MM), _MM * material.run.task.position_tolerance_m
    title = "Shelf: Koopman error per step"
    steps.plot_errors(folder / "figure-4-left.png", title, errors, "mm", tolerance, bounds=True)
    caption = (
        f"One-step error of position (Eq. 15) on demonstration {SHOWN}, predicted by models fitted to the others."
        " Shaded: steps outside the trust domain drawn from the others, or where too few rewards are right, so that the"
        f" expert is asked. Largest raw error at the agent's step {errors['paper'].raw.max():.2f} mm by the paper's"
        f" lift, {errors['pose'].raw.max():.2f} mm by the default. The bounds in the lowest panel are those that the"
        " paper's text states; its curve is not redrawn."
    )
    return Figure("4, left", "Koopman error, shelf", caption, ["figure-4-left.png"], _fits(material), "half")


def _errors(material: Material, column: int, scale: float) -> dict[str, steps.Errors]:
    """Return the errors of the drawn intents, of position (``column`` 0) or orientation (1), scaled."""
    drawn = {}
    for name in steps.NAMES:
        found = material.intents[name]
        raw, rescaled, sixty = (scale * rows[:, column] for rows in (found.error, found.rescaled, found.sixty))
        compared = column == 0 and found.reward.prediction == "rescaled"
        drawn[name] = steps.Errors(raw, rescaled if compared else None, found.asked, sixty)
    return drawn


def _fits(material: Material) -> list[Path]:
    return [material.intents[name].file for name in steps.NAMES]


def line_fit(material: Material, folder: Path) -> Figure:
    """Draw Fig. 5."""
    positions = material.trajectories[SHOWN][:, pose.POSITION]
    errors = {name: found.raw for name, found in _errors(material, 0, _MM).items()}
    steps.plot_line_fit(folder / "figure-5-left.png", positions)
    steps.plot_line_error(folder / "figure-5-right.png", positions, errors)
    caption = (
        f"Left: a least-squares line in time through demonstration {SHOWN}. Right: its distance from the line at each"
        f" step, at most {_MM * steps.line_distance(positions).max():.0f} mm, beside the one-step errors of both"
        " lifts on the same demonstration, which they have not seen. As in the paper, one is a distance from a fit and"
        " the others are predictions one step ahead; the table of intents compares predictions alone."
    )
    title, files = "A line fit instead of the Koopman operator, shelf", ["figure-5-left.png", "figure-5-right.png"]
    return Figure("5", title, caption, files, [material.run.demonstrations_file, *_fits(material)])


def knife_poses(material: Material, folder: Path) -> Figure:
    """Draw Fig. 6, left."""
    item, scene = material.demonstrations.items[SHOWN], material.scene
    first = poses.best_view(scene, item)
    second = poses.close_view(scene, item, first.azimuth + SECOND_CAMERA_DEG)
    poses.plot_poses(folder / "figure-6-left-a.png", scene, item, first, "Knife, first camera")
    poses.plot_poses(folder / "figure-6-left-b.png", scene, item, second, "Knife, second camera: the tool")
    caption = (
        f"Initial, two intermediate and the goal pose of demonstration {SHOWN}, from two sides (goal solid, earlier"
        " poses seen through). The blade's edge is red: up at the start, down when the handle reaches the person."
    )
    title, files = "Initial, intermediate and goal poses, knife", ["figure-6-left-a.png", "figure-6-left-b.png"]
    return Figure("6, left", title, caption, files, [material.run.demonstrations_file])


def knife_turn(material: Material, folder: Path) -> Figure:
    """Draw Fig. 6, right."""
    task = material.run.task
    if not isinstance(task, KnifeTask):
        found = type(task).__name__
        raise BadInputError(f"task {task.name} must be a KnifeTask to draw the blade's turn, found {found}")
    steps.plot_turn(folder / "figure-6-right.png", material.trajectories, task, SHOWN)
    gone = [steps.half_turn(trajectory, task)[1] for trajectory in material.trajectories]
    caption = (
        "Distances to the goal (Eqs. 15, 16) and the edge's angle to straight down. The turn is done earlier than the"
        f" way: when half the turn is done, {min(gone):.0%} to {max(gone):.0%} of the position distance is gone."
    )
    title, files = "Distance to the goal per step, knife", ["figure-6-right.png"]
    return Figure("6, right", title, caption, files, [material.run.demonstrations_file])


def knife_positions(material: Material, folder: Path) -> Figure:
    """Draw Fig. 7."""
    trajectories, task = material.trajectories, material.run.task
    steps.plot_components(folder / "figure-7.png", trajectories, task, 0, material.sigmas)
    found = list(steps.spans(trajectories, task).items())[:3]
    caption = f"As Figure 3. Spans: {', '.join(f'{name} {low:.3f} to {high:.3f} m' for name, (low, high) in found)}."
    title, files = "Span of the position components, knife", ["figure-7.png"]
    return Figure("7", title, caption, files, [material.run.demonstrations_file], "half")


def knife_orientations(material: Material, folder: Path) -> Figure:
    """Draw Fig. 8."""
    trajectories, task = material.trajectories, material.run.task
    steps.plot_components(folder / "figure-8.png", trajectories, task, 3, material.sigmas)
    found = list(steps.spans(trajectories, task).items())[3:]
    caption = (
        "As Figure 3. Roll, pitch and yaw are taken in a frame of the task in which the turn is roll and the angles"
        " stay away from their singularity and from ±180°. Spans:"
        f" {', '.join(f'{name} {low:.1f}° to {high:.1f}°' for name, (low, high) in found)}."
    )
    title, files = "Span of the orientation components, knife", ["figure-8.png"]
    return Figure("8", title, caption, files, [material.run.demonstrations_file], "half")


def knife_errors(material: Material, folder: Path) -> Figure:
    """Draw Fig. 9, left."""
    errors, tolerance = _errors(material, 1, _DEGREES), _DEGREES * material.run.task.rotation_tolerance_rad
    title = "Knife: orientation error per step"
    steps.plot_errors(folder / "figure-9-left.png", title, errors, "°", tolerance, bounds=False)
    moved = _errors(material, 0, _MM)
    paper, default = (f"{errors[name].raw.max():.2f}° and {moved[name].raw.max():.2f} mm" for name in steps.NAMES)
    caption = (
        f"One-step error of orientation (Eq. 16) on demonstration {SHOWN}, predicted by models fitted to the others;"
        f" shaded as in Figure 4. Largest at the agent's step, orientation and position: {paper} by the paper's lift,"
        f" {default} by the default."
    )
    return Figure("9, left", "Orientation error, knife", caption, ["figure-9-left.png"], _fits(material), "half")


def rewards(number: str, task: str, preset: str, runs: Sequence[Run], folder: Path) -> Figure:
    """Draw Fig. 4, right, or Fig. 9, right, from the runs of a preset, one a seed."""
    name = f"figure-{number.replace(', ', '-')}{'' if preset == DEFAULT else f'-{preset}'}.png"
    title = f"{task.capitalize()}, {preset} preset: reward per episode"
    plot_rewards(folder / name, [run.train for run in runs], title)
    exploring = np.mean([np.mean(run.train["exploring_episode"] or [0.0]) for run in runs])
    seeds = ", ".join(str(run.seed) for run in runs)
    spread = f"seeds {seeds}" if len(runs) > 1 else f"seed {seeds} alone, so that no spread is drawn"
    short = (
        f" Episodes run side by side, and {exploring:.0%} of them are short ones that explore, so that sums depend on"
        " length as well as on what is right."
    )
    caption = (
        f"Sum of rewards in each episode ({spread}). A running mean covers {WINDOW} episodes; mean and spread over"
        f" seeds end with the seed of fewest episodes.{short if exploring else ''} The checks below, of the policy"
        " alone, show learning more plainly."
    )
    title, sources = f"Reward per episode, {task}, {preset} preset", [run.train_file for run in runs]
    return Figure(number, title, caption, [name], sources, "half")


Drawing = Callable[[Material, Path], Figure]
FIGURES: Final[Mapping[str, Mapping[str, Drawing]]] = {
    "shelf": {"2": shelf_poses, "3": shelf_components, "4, left": shelf_errors, "5": line_fit},
    "knife": {
        "6, left": knife_poses,
        "6, right": knife_turn,
        "7": knife_positions,
        "8": knife_orientations,
        "9, left": knife_errors,
    },
}
"""Each task's figures by their number, in the paper's order, but for the rewards."""
REWARDS: Final = {"shelf": "4, right", "knife": "9, right"}
"""Number of each task's figure of rewards, which follows the left one."""
