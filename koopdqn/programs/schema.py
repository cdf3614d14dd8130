"""What ``program.json`` holds, key by key, unit by unit."""

from typing import Literal

from pydantic import Field

from koopdqn.safety.separation import SeparationReport
from koopdqn.settings import ReportModel, Sha256


class LimitsUsed(ReportModel):
    """How much of each limit the fastest sample uses."""

    joint_speed: float = Field(ge=0, le=1, description="of `program.speed_share` of the arm's limits")
    joint_acceleration: float = Field(ge=0, le=1, description="of `program.acceleration_rad_s2`")
    joint_jerk: float = Field(ge=0, le=1, description="of `program.jerk_rad_s3`")
    tool_speed: float = Field(ge=0, le=1, description="of `program.tool_speed_m_s`")


class ProgramDynamics(ReportModel):
    """The program played in MuJoCo's dynamics."""

    tracking_error_mm: float = Field(ge=0, description="largest distance of the flange from its sample [mm]")
    peak_joint_speed_ratio: float = Field(ge=0, le=1, description="largest joint speed over the joint's limit")
    peak_joint_torque_ratio: float = Field(ge=0, le=1, description="the same of torque")
    sag_mm: float = Field(ge=0, description="distance of the flange from the path's end at rest [mm]")


class ProgramFile(ReportModel):
    """The content of ``program.json``."""

    task: str = Field(description="name of the task")
    arm: str = Field(description="name of the arm")
    policy: Sha256 = Field(description="SHA-256 of the policy file")
    frame: Literal["recorded", "placed"] = Field(
        description="where demonstrations were recorded, or where `demos.place` moved them"
    )
    start: list[float] = Field(description="(7,) pose of the flange at the first sample")
    start_joints: list[float] = Field(description="(n,) joint angles there [rad]")
    seconds: float = Field(gt=0, description="how long the motion takes [s]")
    period_seconds: float = Field(gt=0, description="between two samples [s]")
    samples: int = Field(ge=2, description="samples written")
    steps: int = Field(ge=1, description="steps of the learned path")
    path_length_m: float = Field(ge=0, description="length of the flange's path [m]")
    smoothing_mm: float = Field(ge=0, description="most that smoothing moved a pose of the learned path [mm]")
    smoothing_deg: float = Field(ge=0, description="most that it turned one [deg]")
    limits_used: LimitsUsed = Field(description="share of each limit that the fastest sample uses")
    dynamics: ProgramDynamics = Field(description="the program played in MuJoCo's dynamics")
    separation: SeparationReport | None = Field(
        default=None, description="distance to the person where it lacks most; null without `guard.person`"
    )
    files: dict[str, str] = Field(description="the file of each format")


class StreamFile(ReportModel):
    """The content of ``stream.json``."""

    task: str = Field(description="name of the task")
    arm: str = Field(description="name of the arm")
    policy: Sha256 = Field(description="SHA-256 of the policy file")
    host: str | None = Field(description="address of the controller; null if none was asked")
    moved: bool = Field(description="whether the arm was moved; else nothing was sent")
    seconds: float = Field(gt=0, description="how long the whole motion takes [s]")
    samples: int = Field(ge=1, description="samples of the whole motion after its start")
    sent: int = Field(ge=0, description="samples sent")
    stopped: str | None = Field(description="why it ended before its last sample; null if it did not")
    late_seconds: float = Field(ge=0, description="most that a sample was sent late [s]")
    joint_error_rad: float = Field(ge=0, description="most that a joint was off the sample sent before [rad]")
    start_joints: list[float] = Field(description="(n,) joint angles at which it starts [rad]")
