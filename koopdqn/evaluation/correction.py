"""A correction: a stretch of a learned path led through waypoints that a person shows, and what comes of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from koopdqn import pose
from koopdqn.errors import BadInputError, WorkFailedError
from koopdqn.evaluation.metrics import without_stairs
from koopdqn.files import write_text
from koopdqn.intent.bend import Bend
from koopdqn.paths import arc_lengths
from koopdqn.pose import Array
from koopdqn.settings import Name, ReportModel, Settings, Vector3, shown
from koopdqn.tasks.rollout import SUCCESS, Controller, Episode, roll_out
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.workcell import Workcell

# A point of the path that is moved by less [m] is not corrected.
_UNMOVED_M = 1e-4
MOST_WAYPOINTS = 100
"""A correction is shown by so many at most."""


def _to_waypoints(value: object) -> object:
    if isinstance(value, str):
        return read_waypoints(Path(value))
    return tuple(value) if isinstance(value, list) else value


class CorrectionSettings(Settings):
    """What ``koopdqn correct`` is shown."""

    waypoints: Annotated[tuple[Vector3, ...], BeforeValidator(_to_waypoints)] | None = Field(
        min_length=1,
        max_length=MOST_WAYPOINTS,
        description="the better way, in the order in which the path passes it: positions in UR Base, or a CSV file [m];"
        " null: a person at the terminal shows it",
    )


def read_waypoints(path: Path) -> tuple[tuple[float, ...], ...]:
    """Return the positions [m] of a CSV file, x, y, z a line, below a header of these letters or not.

    Raises:
        ValueError: the file is missing, or holds anything else.
    """
    if not path.is_file():
        raise ValueError(f"must be a list of positions or a CSV file of them, found no file {str(path)!r}")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: must hold x,y,z a line, found no text") from error
    rows: list[tuple[float, ...]] = []
    for number, line in enumerate(lines, start=1):
        cells = [cell.strip() for cell in line.partition("#")[0].split(",")]
        if cells == [""] or (not rows and cells == ["x", "y", "z"]):
            continue
        try:
            x, y, z = map(float, cells)
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: must hold x,y,z in m, found {shown(line.strip())}") from error
        rows.append((x, y, z))
    if not rows:
        raise ValueError(f"{path}: must hold x,y,z a line, found none")
    return tuple(rows)


def write_waypoints(path: Path, waypoints: Array) -> None:
    """Write positions (W, 3) [m] as the CSV file that :func:`read_waypoints` reads, digit for digit."""
    write_text(path, "".join(",".join(map(repr, row)) + "\n" for row in waypoints.tolist()))


class CorrectionFile(ReportModel):
    """The content of ``correct.json``."""

    run: Name = Field(description="folder of the run that was corrected")
    task: Name = Field(description="name of the task")
    waypoints: list[list[float]] = Field(description="(W, 3) the positions shown, in UR Base [m]")
    stretch_m: list[float] = Field(description="(2,) where the corrected stretch begins and ends along the path [m]")
    moved_mm: float = Field(description="largest distance by which the path was moved")
    missed_mm: float = Field(description="largest distance of a waypoint from the corrected path")
    followed_mean_mm: float | None = Field(
        description="mean distance of the corrected path from the way shown, in the stretch; null if no pose lies there"
    )
    followed_max_mm: float | None = Field(description="largest of these distances")
    before_mean_mm: float | None = Field(
        description="mean distance of the corrected path from the learned one before the stretch, null likewise"
    )
    before_max_mm: float | None = Field(description="largest of these distances")
    behind_mean_mm: float | None = Field(description="the same behind the stretch")
    behind_max_mm: float | None = Field(description="largest of these distances")
    seconds: float = Field(description="how long it took, without the time in which a person showed the way")


def played(workcell: Workcell, policy: Controller, limit: int) -> Episode:
    """Return a policy's episode from the nominal start; it must succeed.

    Raises:
        WorkFailedError: it does not reach the goal.
    """
    start = workcell.task.nominal_start
    motion = workcell.reachability.enter(start)
    if motion.joints is None:
        raise WorkFailedError(f"the arm must be able to take the nominal start, found {motion.reason}: {motion.detail}")
    episode = roll_out(policy, workcell.task, workcell.reachability, start[None], motion.joints[None], limit)[0]
    if episode.outcome != SUCCESS:
        detail = f" ({episode.detail})" if episode.detail else ""
        raise WorkFailedError(
            f"the path must reach the goal, found {episode.outcome} after {episode.steps} steps at"
            f" {np.round(episode.poses[-1, pose.POSITION], 4).tolist()} m{detail}"
        )
    return episode


def check_clear(workcell: Workcell, corrected: Controller, limit: int) -> None:
    """Raise BadInputError if what stands in a scene that a corrected policy never saw is in the way of its path."""
    try:
        played(workcell, corrected, limit)
    except WorkFailedError as error:
        raise BadInputError(f"obstacles: must not stand in the way of a corrected run, found: {error}") from error


def along(episode: Episode, frame: StartFrame) -> Bend:
    """Return the bend of an episode's path, its stairs smoothed, that moves nothing, in the start frame."""
    local = frame.to_frame(episode.poses, episode.poses[:1])
    return Bend.none(without_stairs(local[:, pose.POSITION]))


def in_frame(positions: Array, start: Array, frame: StartFrame) -> Array:
    """Return positions (N, 3) [m] of a path from a start (7,), in the start frame."""
    poses = pose.make(positions, start[pose.QUATERNION])
    return np.asarray(frame.to_frame(poses, start[None])[:, pose.POSITION])


def in_base(local: Array, start: Array, frame: StartFrame) -> Array:
    """Return the inverse of :func:`in_frame`."""
    poses = pose.make(local, start[pose.QUATERNION])
    return np.asarray(frame.from_frame(poses, start[None], poses)[:, pose.POSITION])


@dataclass(frozen=True)
class Followed:
    """How a corrected path lies to the way shown and to the path before.

    Attributes:
        stretch: (2,) [m] arc lengths between which the path was moved.
        moved: (P,) [m] by how much each of its points was.
        inside: (N,) [m] distances of the corrected path from the way shown, in the stretch.
        before: (N,) [m] distances of the corrected path from the learned one, before the stretch.
        behind: (N,) [m] the same behind it.
        missed: (W,) [m] distances of the waypoints from the corrected path.
    """

    stretch: Array
    moved: Array
    inside: Array
    before: Array
    behind: Array
    missed: Array

    @classmethod
    def of(cls, old: Episode, new: Episode, was: Bend, now: Bend, waypoints: Array, frame: StartFrame) -> "Followed":
        """Compare the episodes before and after a correction from one bend to another through waypoints (W, 3).

        The bends are in the start frame, waypoints in the base.
        """
        from scipy.spatial import KDTree

        moved = pose.norm(now.offsets - was.offsets)
        corrected = np.flatnonzero(moved > _UNMOVED_M)
        if not len(corrected):
            raise BadInputError("waypoints: must lie beside the learned path, found all of them on it")
        first, last = int(corrected[0]), int(corrected[-1])
        here = new.poses[:, pose.POSITION]
        off, place = KDTree(now.bent).query(frame.to_frame(new.poses, new.poses[:1])[:, pose.POSITION])
        away = _from_polyline(here, old.poses[:, pose.POSITION])
        return cls(
            arc_lengths(was.bent)[[first, last]],
            moved,
            off[(place >= first) & (place <= last)],
            away[place < first],
            away[place > last],
            _from_polyline(waypoints, here),
        )


def _from_polyline(points: Array, line: Array) -> Array:
    """Return the distances (N,) [m] of points (N, 3) from a polyline (M, 3)."""
    first, way = line[:-1], np.diff(line, axis=0)
    share = ((points[:, None] - first) * way).sum(axis=2) / np.maximum((way**2).sum(axis=1), 1e-18)
    foot = first + np.clip(share, 0.0, 1.0)[..., None] * way
    return np.asarray(pose.norm(points[:, None] - foot).min(axis=1))
