"""How a policy is evaluated."""

from pydantic import Field

from koopdqn.settings import Count, Settings, Vector3


class EvaluationSettings(Settings):
    """On which starts a policy is measured, and what is measured beside it."""

    episodes: int = Field(ge=1, le=100_000, description="held-out starts")
    seed: int = Field(ge=0, description="of the starts; their random stream is never one of training's or its checks'")
    start_scale: float = Field(
        gt=0,
        le=100,
        description="half ranges of the start region times this; above 1, starts farther than any demonstrated",
    )
    dynamics: bool = Field(description="also execute paths in MuJoCo dynamics through the arm's actuators")
    dynamics_episodes: Count = Field(description="successful paths executed so, the first ones, if there are as many")
    time_scale: float = Field(
        ge=1, le=1000, description="how many times robot.step_seconds one step takes in that execution"
    )
    baselines: bool = Field(description="also measure methods that learn nothing, from the same starts")
    goal: Vector3 | None = Field(
        default=None, description="where the goal is, for a task whose goal moves; null: drawn anew at every start [m]"
    )
    video: bool = Field(description="also write a film of a learned path beside a demonstration, eval.mp4")
