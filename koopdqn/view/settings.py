"""What ``koopdqn view`` shows."""

from pydantic import Field

from koopdqn.settings import PathText, Settings


class ViewSettings(Settings):
    """What ``koopdqn view`` shows."""

    starts: int = Field(ge=1, le=12, description="held-out starts, the first of those that eval measures")
    video: PathText | None = Field(description="also a film of the first start: a new .mp4 or .gif; null: none")
