"""What the guard and the distances to a person add to ``eval.json`` and ``program.json``."""

from pydantic import Field

from koopdqn.safety.separation import Separation
from koopdqn.schema import ReportModel
from koopdqn.settings import NonNegative, NonNegativeInt


class GuardReport(ReportModel):
    """What the guard refused."""

    stopped: NonNegativeInt = Field(description="paths that the guard stopped; they were executed up to there, to rest")
    causes: dict[str, NonNegativeInt] = Field(description="those by cause; every cause is present")
    first: str | None = Field(description="the first refused step in words; null if none was refused")


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
    row, margin = found.worst, found.distance_m - found.required_m
    return SeparationReport(
        distance_m=float(found.distance_m[row]),
        required_m=float(found.required_m[row]),
        margin_m=float(margin[row]),
        speed_m_s=float(found.speed_m_s[row]),
        seconds=seconds[row],
        kept_fraction=float((margin >= 0).mean()),
    )
