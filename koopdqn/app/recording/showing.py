"""Showing a better way by keys: where the path is being played, what is shown, and what each key makes of it."""

from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from koopdqn import pose
from koopdqn.app.recording.recorder import AXES, Reply
from koopdqn.errors import BadInputError
from koopdqn.evaluation.correction import MOST_WAYPOINTS, in_base, in_frame, write_waypoints
from koopdqn.evaluation.metrics import without_stairs
from koopdqn.intent.bend import Bend
from koopdqn.paths import arc_lengths, at_arc_lengths
from koopdqn.pose import Array
from koopdqn.tasks.rollout import Episode
from koopdqn.tasks.start_frame import StartFrame
from koopdqn.tasks.workcell import Workcell

PLAY: Final = " "
BACK: Final = "←"
ON: Final = "→"
ADD: Final = "\n"
_SPEED_M_S: Final = 0.1
# A payload that is farther from everything is told of no more.
_FAR_M: Final = 0.2
_STEP_M: Final = 0.005
_SCALES: Final = (-3, 2)
"""Least and largest power of two by which the step is scaled."""
_DECIMALS: Final = 4
"""Waypoints are shown to a tenth of a millimetre [m], so that the list that says the same is short."""


REFUSED: Final = "CANNOT be there"
NOT_ADDED: Final = "The waypoint under way (w) is not added: Enter adds it, x puts it back on the path"


class Showing:
    """What a person shows of a learned path.

    The tool follows the path by itself or by keys; the waypoint under way lies beside it by an offset that the axis
    keys change. Waypoints are on disk before the next key.

    Attributes:
        playing: whether the tool moves by itself.
        place: how far along the path the tool is [m].
        offset: (3,) [m] by which the waypoint under way lies beside the path.
        added: the waypoints (3,) [m], in the order in which they were added.
        path: (P, 3) [m] the learned path.
        arc: (P,) [m] how far along the path each of its points is.
        loose: whether the waypoint under way is beside the path and not added.
    """

    def __init__(self, episode: Episode, bend: Bend, frame: StartFrame, workcell: Workcell, file: Path) -> None:
        """Begin at the start of an episode's path, of this bend in the start frame.

        ``file`` takes the waypoints, x,y,z a line, in the base.
        """
        self.file = file
        self.playing = True
        self.place = 0.0
        self.offset = np.zeros(3)
        self.added: list[Array] = []
        self.loose = False
        self._scale = 0
        self._episode = episode
        self._bend = bend
        self._workcell = workcell
        self._frame = frame
        self.path = self._seen(bend.bent)
        self.arc = arc_lengths(self.path)
        passed = arc_lengths(without_stairs(episode.poses[:, pose.POSITION]))
        self._passed = passed * self.length / passed[-1]

    @property
    def length(self) -> float:
        """How long it is [m]."""
        return float(self.arc[-1])

    @property
    def goal(self) -> Array:
        """The task's goal (7,)."""
        return self._workcell.task.goal

    @property
    def step(self) -> float:
        """How far a key moves now [m]."""
        return float(_STEP_M * 2.0**self._scale)

    @property
    def here(self) -> Array:
        """The pose (7,) of the tool on the path."""
        position = at_arc_lengths(self.path, self.arc, np.array([self.place]))[0]
        return pose.make(position, self._episode.poses[self._row, pose.QUATERNION])

    @property
    def waypoint(self) -> Array:
        """The waypoint under way (3,) [m]."""
        return np.round(self.here[pose.POSITION] + self.offset, _DECIMALS)

    @property
    def waypoints(self) -> Array:
        """The waypoints added (W, 3) [m], in the order in which the path passes them."""
        return self._in_order(self.added)

    @property
    def under_way(self) -> Array | None:
        """The path (P, 3) [m] as the waypoints lead it, the one under way among them; None where they move nothing."""
        for points in ([*self.added, self.waypoint] if self.loose else self.added, self.added):
            with suppress(BadInputError):
                return self._seen(self._through(points).bent) if points else None
        return None

    def _through(self, points: list[Array]) -> Bend:
        ordered = self._in_order(points)
        return self._bend.through(in_frame(ordered, self._workcell.task.nominal_start, self._frame), ordered)

    def _seen(self, local: Array) -> Array:
        """Return positions (N, 3) [m] of the start frame in the base."""
        return in_base(local, self._workcell.task.nominal_start, self._frame)

    def standing(self) -> str:
        """Return how the arm would stand at the waypoint under way, or why it cannot."""
        near = self._episode.joints[self._row]
        solutions = self._workcell.arm.solutions(pose.make(self.waypoint, self.here[pose.QUATERNION]), near)
        if not len(solutions):
            return f"{REFUSED}: out of reach"
        scene = self._workcell.scene
        contact = scene.contact(solutions[0])
        if contact:
            return f"{REFUSED}: {contact}"
        clearance = scene.payload_clearance(solutions[0], _FAR_M)
        return "can be there" if clearance >= _FAR_M else f"can be there, payload {1e3 * clearance:.0f} mm clear"

    def play(self, seconds: float) -> None:
        """Let time pass while the path is played; at its end it stops."""
        if self.playing:
            self._go(_SPEED_M_S * seconds)
            self.playing = self.place < self.length

    def press(self, key: str) -> Reply:
        """Do what a key says and return what it did."""
        if key in AXES:
            axis, sense = AXES[key]
            self.offset[axis] = round(self.offset[axis] + sense * self.step, 9)
            self.playing, self.loose = False, bool(self.offset.any())
            return Reply("", changed=True)
        if key in (BACK, ON):
            self.playing = False
            self._go(self.step if key == ON else -self.step)
            self.loose = bool(self.offset.any())
            return Reply("", changed=True)
        if key == PLAY:
            return self._stop_or_go()
        if key in "+=-_":
            scale = int(np.clip(self._scale + (1 if key in "+=" else -1), *_SCALES))
            changed, self._scale = scale != self._scale, scale
            return Reply(f"A key moves {self.step * 1e3:.4g} mm{'' if changed else ', the limit'}", changed)
        others = {ADD: self._add, "u": self._undo, "x": self._put_back}
        if key not in others:
            return Reply(f"{key!r} is no key here; ? lists them", changed=False)
        return others[key]()

    @property
    def _row(self) -> int:
        """The number of the episode's pose that is nearest to the tool, along the path."""
        return int(np.abs(self._passed - self.place).argmin())

    def _in_order(self, points: list[Array]) -> Array:
        rows = np.array(points).reshape(-1, 3)
        place = pose.norm(rows[:, None] - self.path).argmin(axis=1)
        return np.asarray(rows[np.argsort(place, kind="stable")])

    def _go(self, by: float) -> None:
        self.place = float(np.clip(self.place + by, 0.0, self.length))

    def _stop_or_go(self) -> Reply:
        if self.playing:
            self.playing = False
            return Reply("Stopped: w s a d r f show where to go instead", changed=True)
        if self.loose:
            return Reply(NOT_ADDED, changed=False)
        self.playing, self.offset = True, np.zeros(3)
        if self.place == self.length:
            self.place = 0.0
        return Reply("", changed=True)

    def _add(self) -> Reply:
        if len(self.added) == MOST_WAYPOINTS:
            return Reply(f"Refused: there may be {MOST_WAYPOINTS} waypoints", changed=False)
        try:
            self._through([*self.added, self.waypoint])
        except BadInputError as error:
            return Reply(f"Refused: {error}", changed=False)
        self.added.append(self.waypoint)
        self.playing = self.loose = False
        self._write()
        return Reply(f"Added: a waypoint at {self._shown(self.waypoint)} m; on with space or →", changed=True)

    def _undo(self) -> Reply:
        if not self.added:
            return Reply("Nothing is left to undo", changed=False)
        taken = self.added.pop()
        self._write()
        return Reply(f"Taken back: the waypoint at {self._shown(taken)} m", changed=True)

    def _put_back(self) -> Reply:
        self.loose, self.offset = False, np.zeros(3)
        return Reply("The waypoint under way is on the path again", changed=True)

    def _write(self) -> None:
        if self.added:
            write_waypoints(self.file, self.waypoints)
        else:
            self.file.unlink(missing_ok=True)

    @staticmethod
    def _shown(position: Array) -> str:
        return ", ".join(f"{value:.4f}" for value in position)
