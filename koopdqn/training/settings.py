"""Settings of training: when it checks itself and when it stops."""

from typing import Literal

from pydantic import Field

from koopdqn.config.settings import Count, Fraction, Settings


class TrainSettings(Settings):
    """When training checks itself, when it stops. Limits count steps, never seconds."""

    stop: Literal["learned", "limit"] = Field(description="stop when learned, or only at a limit")
    extend: float = Field(ge=1, description="with stop=limit: go on to this many times the actions it took to learn")
    max_steps: Count = Field(description="most actions tried")
    max_episodes: Count = Field(description="most episodes finished")
    check_every: Count = Field(description="updates between two checks")
    check_starts: int = Field(ge=20, le=10_000, description="held-out starts of a check")
    check_seed: int = Field(ge=0, description="of the checks' starts")
    check_success: Fraction = Field(description="success rate that passes a check")
    checks_to_learn: Count = Field(description="passed checks in a row that count as learned")
    step_limit_factor: float = Field(
        ge=3, le=1000, description="step limit of an episode in steps of the longest demonstration"
    )
    threads: int = Field(
        ge=1, le=256, description="torch's threads; more is slower for small networks on a busy machine"
    )
