"""The page: one HTML file that holds everything it shows and opens from disk, with or without a network."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from koopdqn import pose
from koopdqn.files import write_text
from koopdqn.intent.reward import SOURCES
from koopdqn.intent.trust import TrustDomain
from koopdqn.plots import style
from koopdqn.pose import Array
from koopdqn.robot.scene import Scene
from koopdqn.robot.view import View, choose_view, fitted_view
from koopdqn.view.bake import baked_scene, baked_trust, frames_of, rounded
from koopdqn.view.motions import Motion

PAGE: Final = "view.html"
_HERE: Final = Path(__file__).resolve().parent
MOST_TRACKS: Final = 200
"""Demonstrations that are drawn as lines; those that the arm follows are fewer."""
_SIZE: Final = (1280, 720)
_AROUND: Final = 0.2
"""How far around the motions a preset looks [m]: about the length of the tool and of a link beside it."""
COLOURS: Final = {
    "demonstration": style.ORANGE,
    "learned": style.BLUE,
    "intent": style.GREY,
    "trust": style.BLUE,
    "safe": "#8cc63f",
    "unsafe": "#8b0000",
}
"""Of what the page draws, as hexadecimal codes; an edge's two are none of a path's."""


@dataclass(frozen=True)
class Listing:
    """A table above the scene: its title, the names of its columns, and its rows, whose first cells name them."""

    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Shown:
    """What a page shows.

    Attributes:
        title: of the page.
        lines: what is told beside it.
        scene: the arm and what stands around it.
        motions: at least one; the first is shown first, and an ``intent`` follows the ``learned`` it belongs to.
        tracks: demonstrated positions (T, 3) [m], drawn as lines.
        trust: the trust domain, or None.
        goal: pose (7,) of the goal, or None.
        listings: tables above the scene.
    """

    title: str
    lines: Sequence[str]
    scene: Scene
    motions: Sequence[Motion]
    tracks: Sequence[Array]
    trust: TrustDomain | None = None
    goal: Array | None = None
    listings: Sequence[Listing] = ()

    def content(self) -> dict[str, Any]:
        """Return it as JSON values, as the page's script reads them."""
        count = len(self.tracks)
        # Of many, from first to last: of runs that are compared some of each.
        drawn = np.linspace(0, count - 1, min(count, MOST_TRACKS)).round().astype(int)
        some = [f"lines of {len(drawn)} of {count} demonstrations are drawn"] if count > len(drawn) else []
        return {
            "title": self.title,
            "lines": [*self.lines, *some],
            "listings": [asdict(listing) for listing in self.listings],
            "scene": baked_scene(self.scene),
            "motions": [motion.baked(self.scene) for motion in self.motions],
            "tracks": [rounded(self.tracks[index][frames_of(len(self.tracks[index]))]) for index in drawn],
            "trust": None if self.trust is None else baked_trust(self.trust),
            "goal": None if self.goal is None else rounded(self.goal[pose.POSITION]),
            "cameras": cameras(self.scene, self.motions),
            "field_of_view": float(self.scene.model.vis.global_.fovy),
            "sources": [{"name": name, "colour": style.SOURCES[name]} for name in SOURCES],
            "colours": COLOURS,
        }


def cameras(scene: Scene, motions: Sequence[Motion]) -> list[dict[str, Any]]:
    """Return the camera presets: name, eye (3,) and target (3,) [m]; the first shows the first motion best."""
    points = np.concatenate([motion.poses[:, pose.POSITION] for motion in motions])
    low, high = points.min(axis=0) - _AROUND, points.max(axis=0) + _AROUND
    points = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    views: dict[str, View] = {}
    first = next((motion for motion in motions if len(motion.joints)), None)
    if first is not None:
        views["best"] = choose_view(scene, first.joints, _SIZE)
    # Straight down is where an orbiting camera has no upright.
    directions = {"above": (90.0, -89.0), "front": (180.0, -8.0), "left": (-90.0, -8.0), "right": (90.0, -8.0)}
    for name, (azimuth, elevation) in directions.items():
        views[name] = fitted_view(points, azimuth, elevation, _SIZE, scene.model.vis.global_.fovy)
    return [
        {"name": name, "eye": rounded(view.eye), "target": rounded(np.array(view.lookat))}
        for name, view in views.items()
    ]


def render(content: Mapping[str, Any]) -> str:
    """Return the page as HTML text."""
    environment = Environment(
        autoescape=True, loader=PackageLoader("koopdqn", "view"), undefined=StrictUndefined, trim_blocks=True
    )
    # Within a script element no text may end it, nor begin another.
    baked = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return environment.get_template("page.html.j2").render(
        title=content["title"],
        lines=content["lines"],
        listings=content["listings"],
        library=Markup((_HERE / "three.min.js").read_text(encoding="utf-8")),
        licence=Markup((_HERE / "three.LICENSE").read_text(encoding="utf-8").replace("--", "- ")),
        baked=Markup(baked),
    )


def write_page(folder: Path, content: Mapping[str, Any], name: str = PAGE) -> Path:
    """Write the page into a folder, ``view.html`` or by another name, and return its path.

    Raises:
        BadInputError: the file cannot be written.
    """
    write_text(folder / name, render(content))
    return folder / name
