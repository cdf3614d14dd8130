"""Speed and separation along a path near a person: figures from the user's own parameters, no judgement of safety."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from koopdqn import pose
from koopdqn.pose import Array
from koopdqn.settings import NonNegative, ReportModel, Settings, Vector3

if TYPE_CHECKING:
    from koopdqn.robot.scene import Scene


class PersonNear(Settings):
    """A person near the arm, and the parameters of ISO/TS 15066, 5.5.4.2.3, that only the user can know."""

    position_m: Vector3 = Field(description="middle of a ball that holds the person, in the arm's base")
    radius_m: NonNegative = Field(description="of that ball")
    speed_m_s: NonNegative = Field(description="v_h: of the person toward the arm")
    reaction_s: NonNegative = Field(description="T_r: from seeing the person until the arm begins to brake")
    stopping_s: NonNegative = Field(description="T_s: from then until it stands")
    stopping_m: NonNegative = Field(description="S_s: how far it moves while it brakes")
    intrusion_m: NonNegative = Field(description="C: how far a body part reaches before it is seen")
    person_error_m: NonNegative = Field(description="Z_d: of the person's measured position")
    arm_error_m: NonNegative = Field(description="Z_r: of the arm's")
    arm_radius_m: NonNegative = Field(description="how far the links reach from the lines between their joints")
    tool_m: NonNegative = Field(description="how far the tool reaches from the flange along its z axis")


def protective_distance(person: PersonNear, arm_speed: Array) -> Array:
    """Return the protective separation distance S_p (N,) [m] at speeds (N,) [m/s] of the arm toward the person.

    S_p = S_h + S_r + S_s + C + Z_d + Z_r, with S_h = v_h·(T_r + T_s) and S_r = v_r·T_r (ISO/TS 15066:2016, 5.5.4.2.3,
    constant speeds).
    """
    walked = person.speed_m_s * (person.reaction_s + person.stopping_s)
    errors = person.intrusion_m + person.person_error_m + person.arm_error_m
    return np.asarray(walked + np.maximum(arm_speed, 0.0) * person.reaction_s + person.stopping_m + errors)


@dataclass(frozen=True)
class Separation:
    """Distances to a person along a motion.

    Attributes:
        distance_m: (N,) between the person's ball and the arm.
        required_m: (N,) protective separation distance at the arm's speed toward the person there.
        speed_m_s: (N,) that speed, of the arm's fastest point.
    """

    distance_m: Array
    required_m: Array
    speed_m_s: Array


def separation(scene: "Scene", joints: Array, times: Array, person: PersonNear) -> Separation:
    """Return the distances along joint angles (N, 6) [rad] at times (N,) [s], at least two.

    The arm is the lines between its joints, the flange and the end of the tool, ``arm_radius_m`` thick; its speed is
    that of the point among their ends and middles that comes nearer to the person fastest.
    """
    tip = np.array([0.0, 0.0, person.tool_m])
    lines = np.array([scene.link_points(row) for row in joints])  # (N, B, 3)
    flange = scene.arm.forward(joints)
    ends = flange[:, pose.POSITION] + pose.rotate(flange[:, pose.QUATERNION], tip)
    points = np.concatenate([lines, ends[:, None]], axis=1)
    person_at = np.array(person.position_m)
    first, way = points[:, :-1], np.diff(points, axis=1)
    length = np.maximum((way**2).sum(axis=2), 1e-12)
    share = (((person_at - first) * way).sum(axis=2) / length).clip(0.0, 1.0)
    nearest = np.linalg.norm(first + share[..., None] * way - person_at, axis=2).min(axis=1)
    distance = np.maximum(nearest - person.radius_m - person.arm_radius_m, 0.0)
    every = np.concatenate([points, first + 0.5 * way], axis=1)
    away = np.linalg.norm(every - person_at, axis=2)
    toward = -np.gradient(away, times, axis=0).min(axis=1)
    return Separation(distance, protective_distance(person, toward), np.maximum(toward, 0.0))


class SeparationReport(ReportModel):
    """Distance to the person of `guard.person` where it lacks most, with the user's own parameters."""

    distance_m: NonNegative = Field(description="between the arm and the person's ball")
    required_m: NonNegative = Field(
        description="protective separation distance there: S_h + S_r + S_s + C + Z_d + Z_r of ISO/TS 15066, 5.5.4.2.3"
    )
    margin_m: float = Field(description="distance_m less required_m; below 0 the distance is not kept")
    speed_m_s: NonNegative = Field(description="of the arm toward the person there")
    seconds: NonNegative = Field(description="into the path")
    kept_fraction: float = Field(ge=0, le=1, description="share of the samples at which the distance is kept")


def separation_report(found: Separation, seconds: list[float]) -> SeparationReport:
    """Return the report of distances at N times [s]."""
    margin = found.distance_m - found.required_m
    row = int(margin.argmin())
    return SeparationReport(
        distance_m=float(found.distance_m[row]),
        required_m=float(found.required_m[row]),
        margin_m=float(margin[row]),
        speed_m_s=float(found.speed_m_s[row]),
        seconds=seconds[row],
        kept_fraction=float((margin >= 0).mean()),
    )
