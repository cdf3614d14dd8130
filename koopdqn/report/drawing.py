"""The figures of each task, drawn from its material, with captions."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from koopdqn.errors import BadInputError, KoopdqnError
from koopdqn.report.blocks import Block, Figure, Missing, Panel
from koopdqn.report.figures.components import plot_components, spans
from koopdqn.report.figures.errors import line_distance, plot_errors, plot_line_error, plot_line_fit
from koopdqn.report.figures.poses import best_view, close_view, plot_paths, plot_poses
from koopdqn.report.figures.rewards import WINDOW, plot_rewards
from koopdqn.report.figures.turn import plot_turn, travelled_at_half_turn
from koopdqn.report.figures.workflow import plot_workflow
from koopdqn.report.groups import Group
from koopdqn.report.material import SHOWN, Material
from koopdqn.tasks.knife import KnifeTask

SECOND_CAMERA_DEG = 150.0
"""By how much the knife's second camera stands further round than the first, about the vertical."""

Drawing = Callable[[Material, Path], Figure]


def draw(what: str, drawing: Drawing, material: Material, folder: Path) -> Block:
    """Return a figure drawn into a folder, or what was missing for it."""
    try:
        return drawing(material, folder)
    except KoopdqnError as error:
        return Missing(what, f"{str(error)[:1].upper()}{str(error)[1:]}.")


def workflow(folder: Path) -> Figure:
    """Draw Fig. 1."""
    path = folder / "figure-1.png"
    plot_workflow(path)
    caption = (
        "Drawn anew after §3 and §4. A, B: demonstrations become a Koopman model of the person's intent and a domain in"
        " which it is trusted. C: inside the domain the model's prediction decides the reward, outside it a person is"
        " asked. In the default preset both ends of an action must be trusted; the paper looks at the reached state."
    )
    alt = "Boxes and arrows: demonstrations, intent model and trust domain; the training loop with its reward function"
    return Figure("1", "Workflow", caption, (Panel(path, alt),), wide=True)


def shelf_poses(material: Material, folder: Path) -> Figure:
    """Draw Fig. 2."""
    item = material.demonstrations.items[SHOWN]
    rendered, paths = folder / "figure-2-arm.png", folder / "figure-2-path.png"
    plot_poses(rendered, material.scene, item, best_view(material.scene, item), "Shelf: initial, intermediate, goal")
    plot_paths(paths, material.demonstrations.items, material.task, SHOWN)
    caption = (
        f"Initial, two intermediate and the goal pose of demonstration {SHOWN} of {len(material.demonstrations)}, on"
        " the arm (goal solid, earlier poses seen through) and as paths of the flange in the base frame. The flange's"
        " axes keep their directions: orientation is held."
    )
    panels = (Panel(rendered, "The arm before the shelf in four poses"), Panel(paths, "Paths from above and the side"))
    return Figure("2", "Poses and a demonstration, shelf", caption, panels, (material.run.demonstrations_file,))


def shelf_components(material: Material, folder: Path) -> Figure:
    """Draw Fig. 3."""
    paths = folder / "figure-3-position.png", folder / "figure-3-orientation.png"
    plot_components(paths[0], material.trajectories, material.task, "position", material.sigmas, "Shelf: position")
    plot_components(
        paths[1], material.trajectories, material.task, "orientation", material.sigmas, "Shelf: orientation"
    )
    caption = (
        f"All {len(material.trajectories)} demonstrations, aligned by the share of their path and resampled to the"
        f" agent's step: mean, samples, and the band of {material.sigmas:g} standard deviations; the trust domain adds"
        " floors to them."
        " Roll, pitch and yaw are relative to the goal's orientation and stay at zero."
    )
    panels = (Panel(paths[0], "x, y, z over steps"), Panel(paths[1], "roll, pitch, yaw over steps"))
    return Figure("3", "Distributions of the pose components, shelf", caption, panels, _demonstrations(material))


def shelf_errors(material: Material, folder: Path) -> Figure:
    """Draw Fig. 4, left."""
    path = folder / "figure-4-left.png"
    plot_errors(path, material.intents, material.task, "position", "Shelf: Koopman error per step", bounds=True)
    errors = {name: found.held_out for name, found in material.intents.items()}
    caption = (
        f"One-step error of position (Eq. 15) on demonstration {SHOWN}, predicted by models fitted to the others."
        " Shaded: steps outside the trust domain drawn from the others, or where too few rewards are right, so that the"
        " expert is asked. Largest raw error at the agent's step"
        f" {1e3 * errors['paper'].error[:, 0].max():.2f} mm by the paper's lift,"
        f" {1e3 * errors['pose'].error[:, 0].max():.2f} mm by the default. The bounds in the lowest panel are those"
        " that the paper's text states; its curve is not redrawn."
    )
    panels = (Panel(path, "Errors over steps"),)
    return Figure("4, left", "Koopman error, shelf", caption, panels, material.fits, beside="4")


def line_fit(material: Material, folder: Path) -> Figure:
    """Draw Fig. 5."""
    trajectory = material.trajectories[SHOWN]
    paths = folder / "figure-5-left.png", folder / "figure-5-right.png"
    plot_line_fit(paths[0], trajectory)
    plot_line_error(paths[1], trajectory, material.intents)
    largest = 1e3 * line_distance(trajectory).max()
    caption = (
        f"Left: a least-squares line in time through demonstration {SHOWN}. Right: its distance from the line at each"
        f" step, at most {largest:.0f} mm, beside the one-step errors of both lifts on the same demonstration, which"
        " they have not seen. As in the paper, one is a distance from a fit and the others are predictions one step"
        " ahead; the table of intents compares predictions alone."
    )
    panels = (Panel(paths[0], "x, y, z and the line"), Panel(paths[1], "Errors over steps on a logarithmic scale"))
    sources = (*_demonstrations(material), *material.fits)
    return Figure("5", "A line fit instead of the Koopman operator, shelf", caption, panels, sources)


def knife_poses(material: Material, folder: Path) -> Figure:
    """Draw Fig. 6, left."""
    item = material.demonstrations.items[SHOWN]
    first = best_view(material.scene, item)
    paths = folder / "figure-6-left-a.png", folder / "figure-6-left-b.png"
    second = close_view(material.scene, item, first.azimuth + SECOND_CAMERA_DEG)
    views = (first, "Knife, first camera"), (second, "Knife, second camera: the tool")
    for path, (view, title) in zip(paths, views, strict=True):
        plot_poses(path, material.scene, item, view, title)
    caption = (
        f"Initial, two intermediate and the goal pose of demonstration {SHOWN}, from two sides (goal solid, earlier"
        " poses seen through). The blade's edge is red: up at the start, down when the handle reaches the person."
    )
    panels = tuple(Panel(path, "The arm with the knife and the person in four poses") for path in paths)
    return Figure("6, left", "Initial, intermediate and goal poses, knife", caption, panels, _demonstrations(material))


def knife_turn(material: Material, folder: Path) -> Figure:
    """Draw Fig. 6, right."""
    task = material.task
    if not isinstance(task, KnifeTask):
        found = type(task).__name__
        raise BadInputError(f"task {task.name} must be a KnifeTask to draw the blade's turn, found {found}")
    path = folder / "figure-6-right.png"
    plot_turn(path, material.trajectories, task, SHOWN)
    lost = [travelled_at_half_turn(trajectory, task) for trajectory in material.trajectories]
    caption = (
        "Distances to the goal (Eqs. 15, 16) and the edge's angle to straight down. The turn is done earlier than the"
        f" way: when half the turn is done, {min(lost):.0%} to {max(lost):.0%} of the position distance is gone."
    )
    panels = (Panel(path, "Distances over steps"),)
    return Figure("6, right", "Distance to the goal per step, knife", caption, panels, _demonstrations(material))


def knife_positions(material: Material, folder: Path) -> Figure:
    """Draw Fig. 7."""
    path = folder / "figure-7.png"
    plot_components(path, material.trajectories, material.task, "position", material.sigmas, "Knife: position")
    found = spans(material.trajectories, material.task)
    text = ", ".join(f"{name} {low:.3f} to {high:.3f} m" for name, (low, high) in list(found.items())[:3])
    caption = f"As Figure 3. Spans: {text}."
    panels = (Panel(path, "x, y, z over steps"),)
    title = "Span of the position components, knife"
    return Figure("7", title, caption, panels, _demonstrations(material), beside="7, 8")


def knife_orientations(material: Material, folder: Path) -> Figure:
    """Draw Fig. 8."""
    path = folder / "figure-8.png"
    plot_components(path, material.trajectories, material.task, "orientation", material.sigmas, "Knife: orientation")
    found = spans(material.trajectories, material.task)
    text = ", ".join(f"{name} {low:.1f}° to {high:.1f}°" for name, (low, high) in list(found.items())[3:])
    caption = (
        "As Figure 3. Roll, pitch and yaw are taken in a frame of the task in which the turn is roll and the angles"
        f" stay away from their singularity and from ±180°. Spans: {text}."
    )
    panels = (Panel(path, "roll, pitch, yaw over steps"),)
    title = "Span of the orientation components, knife"
    return Figure("8", title, caption, panels, _demonstrations(material), beside="7, 8")


def knife_errors(material: Material, folder: Path) -> Figure:
    """Draw Fig. 9, left."""
    path = folder / "figure-9-left.png"
    plot_errors(path, material.intents, material.task, "rotation", "Knife: orientation error per step", bounds=False)
    errors = {name: found.held_out for name, found in material.intents.items()}
    largest = [
        f"{np.degrees(errors[name].error[:, 1].max()):.2f}° and"
        f" {1e3 * errors[name].error[:, 0].max():.2f} mm by the {who}"
        for name, who in (("paper", "paper's lift"), ("pose", "default"))
    ]
    caption = (
        f"One-step error of orientation (Eq. 16) on demonstration {SHOWN}, predicted by models fitted to the others;"
        f" shaded as in Figure 4. Largest at the agent's step, orientation and position: {largest[0]}, {largest[1]}."
    )
    panels = (Panel(path, "Errors over steps"),)
    return Figure("9, left", "Orientation error, knife", caption, panels, material.fits, beside="9")


def rewards(number: str, group: Group, folder: Path) -> Figure:
    """Draw Fig. 4, right, or Fig. 9, right, from a group's runs."""
    stem = f"figure-{number.split(',', maxsplit=1)[0]}-right"
    path = folder / (f"{stem}.png" if group.preset == "default" else f"{stem}-{group.preset}.png")
    plot_rewards(path, group.runs, f"{group.task.capitalize()}, {group.preset} preset: reward per episode")
    exploring = [np.mean(run.train["exploring_episode"] or [0.0]) for run in group.runs]
    seeds = ", ".join(str(run.seed) for run in group.runs)
    spread = f"seeds {seeds}" if len(group.runs) > 1 else f"seed {seeds} alone, so that no spread is drawn"
    caption = (
        f"Sum of rewards in each episode ({spread}). A running mean covers {WINDOW} episodes; mean and spread over"
        " seeds end with the seed that learned first. Episodes run side by side, and most are short ones that explore"
        f" ({np.mean(exploring):.0%} of them), so that sums depend on length as well as on what is right; the checks"
        " below, of the policy alone, show learning more plainly."
    )
    files = tuple(run.train_file for run in group.runs)
    title = f"Reward per episode, {group.task}, {group.preset} preset"
    panels = (Panel(path, "Rewards over episodes, success of checks"),)
    return Figure(number, title, caption, panels, files, beside=number.split(",", maxsplit=1)[0])


def _demonstrations(material: Material) -> tuple[Path, ...]:
    return (material.run.demonstrations_file,)


SHELF: Sequence[tuple[str, Drawing]] = (
    ("Figure 2", shelf_poses),
    ("Figure 3", shelf_components),
    ("Figure 4, left", shelf_errors),
    ("Figure 5", line_fit),
)
KNIFE: Sequence[tuple[str, Drawing]] = (
    ("Figure 6, left", knife_poses),
    ("Figure 6, right", knife_turn),
    ("Figure 7", knife_positions),
    ("Figure 8", knife_orientations),
    ("Figure 9, left", knife_errors),
)
"""Each task's figures in the paper's order, but for the rewards."""
