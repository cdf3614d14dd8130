"""A guard around any policy: a step that breaks a limit or a rule is refused before it is made, and the arm stops."""

import logging
from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.intent.trust import TrustDomain
from koopdqn.pose import Array
from koopdqn.safety.separation import PersonNear
from koopdqn.settings import NonNegative, NonNegativeInt, Positive, ReportModel, Settings
from koopdqn.tasks.actions import checked_indices, checked_twists
from koopdqn.tasks.rollout import RULE_BROKEN, Controller, Episode, roll_out
from koopdqn.tasks.start_frame import STILL, StartFrame
from koopdqn.tasks.task import breaks_rule
from koopdqn.tasks.workcell import COLLISION, REASONS, Motion, Workcell

SPEED: Final = "speed"
TUBE: Final = "left_tube"
CAUSES: Final = (*REASONS, SPEED, RULE_BROKEN, TUBE)
"""Why a step is refused."""

_LOG: Final = logging.getLogger(__name__)


class GuardSettings(Settings):
    """What the guard allows, and how the arm stops."""

    tool_speed_m_s: Positive = Field(description="most of the flange")
    stretch: float = Field(
        ge=1, description="most that a step may be slowed for the joints' speed limits, in robot.step_seconds"
    )
    clearance_m: NonNegative = Field(
        description="least room between the arm and what stands around [m]: execution strays from its commands by some"
        " tenths of a millimetre; an arm that is nearer already may only come away"
    )
    tube_margin_m: NonNegative | None = Field(
        description="how far outside the trust tube the flange may go [m]; one that begins farther away may only come"
        " nearer. null: the tube is not watched"
    )
    deceleration_rad_s2: Positive = Field(description="most that a joint brakes by when the arm is stopped")
    person: PersonNear | None = Field(description="a person near the arm, with the user's own numbers; null: nobody")


@dataclass(frozen=True)
class Refusal:
    """A step that was refused.

    Attributes:
        step: steps made before it.
        cause: one of :data:`CAUSES`.
        detail: the quantity, the rule and the value, in words.
        pose: (7,) that was not gone to.
    """

    step: int
    cause: str
    detail: str
    pose: Array

    def __str__(self) -> str:
        """Return the refusal in words."""
        place = np.round(self.pose[pose.POSITION], 4).tolist()
        return f"step {self.step + 1} to {place} m refused: {self.cause.replace('_', ' ')}: {self.detail}"


class GuardReport(ReportModel):
    """What the guard refused, as ``eval.json`` says it."""

    stopped: NonNegativeInt = Field(description="paths that the guard stopped; they were executed up to there, to rest")
    causes: dict[str, NonNegativeInt] = Field(description="those by cause; every cause is present")
    first: str | None = Field(description="the first refused step in words; null if none was refused")


class Guard:
    """Checks every step before it is made.

    A step is refused if the arm cannot reach it within its joint limits, if it changes the arm's posture, collides or
    nearly so, is too fast for a joint or for the flange, breaks the task's rule, or leaves the trust tube. Whatever the
    guard refuses and why is logged under ``koopdqn.safety`` and kept in :attr:`refusals`.

    Attributes:
        workcell: task, arm and scene.
        settings: what is allowed.
        refusals: the steps refused so far.
    """

    def __init__(
        self,
        workcell: Workcell,
        settings: GuardSettings,
        trust: TrustDomain | None = None,
        frame: StartFrame = STILL,
        time_scale: float | None = 1.0,
    ) -> None:
        """Guard a workcell.

        Args:
            workcell: task, arm and scene.
            settings: what is allowed.
            trust: whose tube is watched; None for none.
            frame: the start frame of that tube.
            time_scale: how much longer steps take than they can when they are executed; None: they are timed later,
                and the flange's speed is kept there.
        """
        self.workcell = workcell
        self.settings = settings
        self.refusals: list[Refusal] = []
        self._trust = trust
        self._frame = frame
        self._time_scale = time_scale

    def moves(
        self, reached: Array, before: Array, joints: Array, starts: Array, moved: Array | None = None
    ) -> list[Motion]:
        """Return what becomes of one step of N episodes: joints, or None with the cause and the detail.

        Args:
            reached: poses (N, 7) to go to.
            before: poses (N, 7) gone from.
            joints: joint angles (N, 6) [rad] there.
            starts: poses (N, 7) at which the episodes began.
            moved: (3,) [m] by which the goal is moved, and the rule and the tube with it; None for not at all.
        """
        motions = self.workcell.reachability.move_batch(reached, joints)
        away = np.zeros(7) if moved is None else np.concatenate([moved, np.zeros(4)])
        broken = breaks_rule(self.workcell.task, reached - away)
        too_far = self._too_far(reached - away, before - away, starts - away)
        for row, motion in enumerate(motions):
            if motion.joints is None:
                continue
            if fast := self._too_fast(np.array([joints[row], motion.joints]), reached[row], before[row]):
                motions[row] = Motion(None, SPEED, fast)
            elif broken[row]:
                motions[row] = Motion(None, RULE_BROKEN, f"must hold: {self.workcell.task.rule}")
            elif too_far[row]:
                motions[row] = Motion(None, TUBE, too_far[row])
            elif near := self.too_near(motion.joints, joints[row]):
                motions[row] = Motion(None, COLLISION, near)
        return motions

    def _too_fast(self, joints: Array, reached: Array, before: Array) -> str:
        reachability, settings = self.workcell.reachability, self.settings
        seconds = float(reachability.durations(joints)[0])
        most = settings.stretch * reachability.arm.step_seconds
        # Rounding of a quotient is no excess.
        if seconds > most * (1.0 + 1e-9):
            return f"the joints' speed limits must allow it within {most:g} s, found that it takes {seconds:.3g} s"
        if self._time_scale is None:
            return ""
        speed = float(pose.position_distance(reached, before)) / (self._time_scale * seconds)
        if speed > settings.tool_speed_m_s * (1.0 + 1e-9):
            return f"the flange must move at most {settings.tool_speed_m_s:g} m/s, found {speed:.3g} m/s"
        return ""

    def too_near(self, joints: Array, before: Array) -> str:
        """Return why the arm would be too near to what stands around at joint angles (6,) [rad] after others (6,)."""
        least, scene = self.settings.clearance_m, self.workcell.scene
        room = min(scene.rooms(joints, least)) if least else 0.0
        if room >= least or room >= min(scene.rooms(before, least)):
            return ""
        return f"the arm must keep {1e3 * least:g} mm from what stands around, or come away, found {1e3 * room:.2f} mm"

    def _too_far(self, reached: Array, before: Array, starts: Array) -> list[str]:
        margin = self.settings.tube_margin_m
        if self._trust is None or margin is None:
            return [""] * len(reached)
        local, come_from = (self._frame.to_frame(poses, starts) for poses in (reached, before))
        gap, allowed = self._trust.gap(local), np.maximum(self._trust.gap(come_from), margin)
        return [
            f"the flange must stay within {1e3 * margin:g} mm of the tube, or come nearer, found {1e3 * far:.1f} mm"
            if far > most + 1e-9
            else ""
            for far, most in zip(gap.tolist(), allowed.tolist(), strict=True)
        ]

    def roll_out(self, policy: Controller, starts: Array, joints: Array, limit: int) -> list[Episode]:
        """Return the episodes of a policy, each stopped before its first refused step, which its outcome names.

        Args:
            policy: chooses the actions (N,), or twists (N, 3 or 6), from poses (N, 7) and starts (N, 7).
            starts: poses (N, 7) to begin at.
            joints: joint angles (N, 6) [rad] there.
            limit: most steps of an episode.

        Raises:
            ValueError: what the policy chooses are neither indices in Table 1 (N,) nor finite twists (N, 3 or 6).
        """
        cell = self.workcell

        def checked(poses: Array, starts: Array) -> np.ndarray:
            actions, count = np.asarray(policy(poses, starts)), len(poses)
            return checked_twists(actions, count, cell.task) if actions.ndim > 1 else checked_indices(actions, count)

        return roll_out(checked, cell.task, cell.reachability, starts, joints, limit, moves=self._noted)

    def _noted(self, reached: Array, before: Array, joints: Array, starts: Array, steps: np.ndarray) -> list[Motion]:
        motions = self.moves(reached, before, joints, starts)
        for row, motion in enumerate(motions):
            if motion.joints is None:
                self._note(Refusal(int(steps[row]), motion.reason, motion.detail, reached[row]))
        return motions

    def review(self, poses: Array, joints: Array, moved: Array | None = None) -> Refusal | None:
        """Return the first refused step of a path of poses (T, 7) with joint angles (T, 6) [rad]; None if none is.

        Where the goal is ``moved`` (3,) [m], the poses are those in the world all the same.
        """
        away = np.concatenate([np.zeros(3) if moved is None else moved, np.zeros(4)])
        starts = self._frame.begun(poses[:-1] - away) + away
        motions = self.moves(poses[1:], poses[:-1], joints[:-1], starts, moved)
        for step, motion in enumerate(motions):
            if motion.joints is None:
                return self._note(Refusal(step, motion.reason, motion.detail, poses[step + 1]))
        return None

    def _note(self, refusal: Refusal) -> Refusal:
        self.refusals.append(refusal)
        _LOG.warning("%s", refusal)
        return refusal

    def report(self) -> GuardReport:
        """Return what was refused so far."""
        found = Counter(refusal.cause for refusal in self.refusals)
        first = str(self.refusals[0]) if self.refusals else None
        return GuardReport(stopped=len(self.refusals), causes={cause: found[cause] for cause in CAUSES}, first=first)

    def durations(self, joints: Array, time_scale: float = 1.0) -> Array:
        """Return the durations (T − 1,) [s] of the steps along joint angles (T, 6) [rad] that end at rest.

        The last steps take longer, so that the arm brakes within the steps that were allowed, no joint by more than
        ``deceleration_rad_s2``: where d is the largest turn of a joint in a step, the speed before it is at most
        √(2a·Σd) over the steps that are left.
        """
        wanted = time_scale * self.workcell.reachability.durations(joints)
        turn = np.abs(np.diff(joints, axis=0)).max(axis=1)
        left = np.concatenate([np.cumsum(turn[::-1])[::-1], [0.0]])
        speed = np.sqrt(2.0 * self.settings.deceleration_rad_s2 * left)
        slowest = np.maximum(speed[:-1] + speed[1:], 1e-12)
        return np.asarray(np.maximum(wanted, 2.0 * turn / slowest))
